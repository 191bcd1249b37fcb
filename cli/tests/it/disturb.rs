//! `cantap disturb`: refused where it must be, and on the emulated board with a firmware that was built for it.

use std::path::{Path, PathBuf};

use crate::in_folder::cantap;

fn directory(test: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("disturb").join(test);
    std::fs::create_dir_all(&directory).unwrap();
    directory
}

#[test]
fn nothing_is_disturbed_by_accident_or_by_a_device_that_cannot() {
    let directory = directory("refused");
    let (code, _, err) = cantap(&directory, "disturb -d virtual -b 500k --at 1ms");
    assert!(code == Some(2) && err.contains("--yes-on-a-test-bench"), "{code:?} {err}");
    let (code, _, err) = cantap(&directory, "disturb -d virtual -b 500k --yes-on-a-test-bench");
    assert!(code == Some(2) && err.contains("--at"), "{code:?} {err}");
    let (code, out, err) = cantap(&directory, "disturb -d virtual -b 500k --at 1ms --yes-on-a-test-bench");
    assert!(code == Some(1) && out.is_empty() && err.contains("firmware built for it"), "{code:?} {err}");
    for length in ["0", "13"] {
        let line = format!("disturb -d virtual -b 500k --at 1ms --length {length} --yes-on-a-test-bench");
        assert_eq!(cantap(&directory, &line).0, Some(2));
    }
}

#[cfg(feature = "emu")]
mod emulated {
    use super::{cantap, directory};
    use crate::common;
    use crate::schema::Schema;
    use serde_json::Value;

    fn device() -> String {
        format!("emu:{}", common::elf().with_file_name("cantap-olimex-p405-disturb.elf").display())
    }

    fn objects(test: &str, line: &str) -> Vec<Value> {
        let (code, out, err) = cantap(&directory(test), &format!("{line} --yes-on-a-test-bench --json"));
        assert_eq!(code, Some(0), "{out} {err}");
        let schema = Schema::new(include_str!("../../../docs/json.schema.json"));
        let objects: Vec<Value> = out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        for object in &objects {
            assert_eq!(schema.faults("disturb", object), [""; 0], "{object}");
        }
        objects
    }

    #[test]
    #[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
    fn a_planned_level_is_on_record_with_its_length_and_the_error_that_it_caused() {
        let line = format!("disturb -d {},load=0 -b 500k --at 50ms -n 3 --every 30ms", device());
        let objects = objects("planned", &line);
        assert_eq!(objects.len(), 3);
        for object in &objects {
            assert_eq!((&object["length_us"], &object["errors"]), (&12.0.into(), &1.into()), "{object}");
        }
        let at = |n: usize| objects[n]["at_ticks"].as_u64().unwrap();
        assert!(at(1) - at(0) >= 12_000 * 30 && at(2) - at(1) >= 12_000 * 30);
    }

    /// The frame that was to be hit comes again after the error, so that the identifier's next frame is late by less than two frames.
    #[test]
    #[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
    fn a_periodic_frame_is_hit_at_its_predicted_time() {
        let directory = directory("periodic");
        let line = |at: u32| format!("({}.{:06}) can0 123#1122\n", 1 + at / 100, at % 100 * 10_000);
        std::fs::write(directory.join("bus.log"), (0..500).map(line).collect::<String>()).unwrap();
        let log = directory.join("bus.log");
        let line = format!("disturb -d {},channels=1,log={} -b 500k --id 123 -n 3", device(), log.display());
        for object in objects("periodic", &line) {
            let late_us = object["late_us"].as_f64().unwrap();
            assert!(object["errors"] == 1 && (50.0..400.0).contains(&late_us), "{object}");
        }
    }
}
