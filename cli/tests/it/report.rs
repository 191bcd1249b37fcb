//! `cantap report` as users run it; the page that it is put into is a stand-in with the real one's mark.

use std::path::{Path, PathBuf};
use std::process::Command;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use cantap_formats::ReadOptions;
use serde_json::Value;

const PAGE: &str = "<!doctype html><body><!--cantap-report--><script>page()</script></body>";
const DATABASE: &str = "BO_ 291 Engine: 8 A\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"km/h\" A\n\nCM_ \"</script><script>alert(1)</script>\";\n";

fn directory(test: &str) -> PathBuf {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("report").join(test);
    let _ = std::fs::remove_dir_all(&directory);
    std::fs::create_dir_all(&directory).unwrap();
    std::fs::write(directory.join("page.html"), PAGE).unwrap();
    directory
}

fn cantap(directory: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(arguments)
        .env("CANTAP_PAGE", directory.join("page.html"))
        .current_dir(directory)
        .output()
        .unwrap();
    (output.status.code(), String::from_utf8(output.stderr).unwrap())
}

/// What is in a page's report, and the whole page.
fn report(path: &Path) -> (Value, String) {
    let page = std::fs::read_to_string(path).unwrap();
    let (_, rest) = page.split_once("<script type=\"application/json\" id=\"cantap-report\">").unwrap();
    let (report, _) = rest.split_once("</script>").unwrap();
    (serde_json::from_str(report).unwrap(), page)
}

/// A file in the report, as it was.
fn content(file: &Value) -> Vec<u8> {
    let packed = BASE64.decode(file["data"].as_str().unwrap()).unwrap();
    let mut content = Vec::new();
    match file["encoding"].as_str().unwrap() {
        "gzip" => {
            std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&packed[..]), &mut content).unwrap();
        }
        _ => content = packed,
    }
    assert_eq!(content.len() as u64, file["size"].as_u64().unwrap());
    content
}

fn log(frames: u32, period_ms: u32) -> String {
    (0..frames)
        .map(|n| {
            format!("({:.6}) can0 123#{:08X}\n", f64::from(n * period_ms) / 1e3, n.wrapping_mul(0x9E37_79B9))
        })
        .collect::<Vec<_>>()
        .concat()
}

#[test]
fn trace_and_databases_are_in_the_page_byte_for_byte_and_no_text_becomes_markup() {
    let directory = directory("whole");
    let name = "</script><script>x<!--.log";
    // A slash cannot be in a name.
    let name = name.replace('/', "_");
    std::fs::write(directory.join(&name), log(500, 10)).unwrap();
    std::fs::write(directory.join("car.dbc"), DATABASE).unwrap();
    let note = "</script><script>alert(2)</script>";
    let (code, text) = cantap(
        &directory,
        &["report", &name, "--db", "1:car.dbc", "-b", "500k", "--note", note, "-o", "out.html"],
    );
    assert_eq!(code, Some(0), "{text}");
    let (report, page) = report(&directory.join("out.html"));
    assert_eq!(page.matches("<script").count(), 2, "{page}");
    assert!(page.ends_with("</script><script>page()</script></body>"), "{page}");
    assert_eq!((report["version"].as_u64(), report["title"].as_str()), (Some(1), Some(name.as_str())));
    assert_eq!(report["notes"][0], note);
    assert_eq!(content(&report["trace"]), log(500, 10).as_bytes());
    assert_eq!(content(&report["databases"][0]), DATABASE.as_bytes());
    assert_eq!(report["databases"][0]["channel"], 1);
    assert_eq!(
        report["bitrates"],
        serde_json::json!([{ "channel": 1, "bitrate": 500_000, "dataBitrate": null }])
    );
    assert_eq!(report["thinned"], serde_json::json!([]));
}

/// Descriptions of conversations go with the databases, under the names by which the page's engine knows them.
#[test]
fn descriptions_are_in_the_page() {
    let directory = directory("described");
    std::fs::write(directory.join("a.log"), log(50, 10)).unwrap();
    std::fs::create_dir_all(directory.join("types/own")).unwrap();
    std::fs::write(directory.join("types/own/20991.Gear.uavcan"), "uint8 gear_pct\n").unwrap();
    let ecu = cantap_virtual::ecu::DESCRIPTION;
    std::fs::write(directory.join("ecu.a2l"), ecu).unwrap();
    let (code, text) = cantap(&directory, &["report", "a.log", "--a2l", "ecu.a2l", "--dsdl", "types"]);
    assert_eq!(code, Some(0), "{text}");
    let (report, _) = report(&directory.join("a.html"));
    let databases = report["databases"].as_array().unwrap();
    let names: Vec<_> = databases.iter().map(|file| file["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["ecu.a2l", "own/20991.Gear.uavcan"]);
    assert_eq!(content(&databases[0]), ecu.as_bytes());
    let (code, text) = cantap(&directory, &["report", "a.log", "--a2l", "a.log"]);
    assert!(code == Some(1) && text.contains("a.log"), "{text}");
}

/// Who talks to whom, where the trace does not show it, goes with them, as in other commands.
#[test]
fn connections_are_in_the_page() {
    let directory = directory("connections");
    std::fs::write(directory.join("a.log"), log(50, 10)).unwrap();
    let voltage = "1620=uavcan.si.sample.voltage.Scalar.1.0";
    let named = [
        "--pair",
        "6F1/12:612/F1",
        "--pair",
        "bmw",
        "--xcp",
        "7F0:7F1",
        "--ccp",
        "123:124",
        "--subject",
        voltage,
    ];
    let (code, text) = cantap(&directory, &[&["report", "a.log"][..], &named].concat());
    assert_eq!(code, Some(0), "{text}");
    let (report, _) = report(&directory.join("a.html"));
    let expected = serde_json::json!({
        "pairs": ["6F1/12:612/F1", "bmw"], "xcp": ["7F0:7F1"], "ccp": ["123:124"], "subjects": [voltage],
    });
    assert_eq!(report["connections"], expected);
    let (code, text) = cantap(&directory, &["report", "a.log", "--subject", "1620=uavcan.Nothing.1.0"]);
    assert!(code == Some(1) && text.contains("uavcan.Nothing.1.0"), "{text}");
}

#[test]
fn what_has_changed_against_another_trace_is_a_finding() {
    let directory = directory("against");
    std::fs::write(directory.join("old.log"), log(500, 10)).unwrap();
    std::fs::write(directory.join("new.log"), log(500, 20)).unwrap();
    let (code, text) = cantap(&directory, &["report", "new.log", "--against", "old.log"]);
    assert_eq!(code, Some(0), "{text}");
    let (report, _) = report(&directory.join("new.html"));
    let texts: Vec<_> =
        report["findings"].as_array().unwrap().iter().map(|one| one["text"].as_str().unwrap()).collect();
    assert!(texts[0].contains("1 changed"), "{texts:?}");
    assert!(texts[1].contains("period 20.0 ms instead of 10.0 ms"), "{texts:?}");
}

#[test]
fn of_a_trace_that_is_too_large_the_beginning_is_in_the_page_and_that_is_said() {
    let directory = directory("large");
    std::fs::write(directory.join("large.log"), log(300_000, 1)).unwrap();
    let (code, text) = cantap(&directory, &["report", "large.log", "--size-limit", "1"]);
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("Only the first") && text.contains("of 300000 records"), "{text}");
    let page = directory.join("large.html");
    assert!(std::fs::metadata(&page).unwrap().len() <= 1_000_000);
    let (report, _) = report(&page);
    assert!(report["thinned"][0].as_str().unwrap().contains("Only the first"));
    assert_eq!(report["trace"]["name"], "large-beginning.blf");
    let bytes = content(&report["trace"]);
    let reader = cantap_formats::open_source(
        "large-beginning.blf",
        std::io::Cursor::new(bytes),
        &ReadOptions::default(),
    );
    let records = reader.unwrap().readable().count();
    let said = format!("Only the first {records} of 300000 records");
    assert!(records > 10_000 && text.contains(&said), "{records}: {text}");
}

#[test]
fn without_a_page_or_a_trace_it_says_what_to_do() {
    let directory = directory("refused");
    std::fs::write(directory.join("a.log"), log(5, 1)).unwrap();
    std::fs::write(directory.join("b.log"), "nonsense\n").unwrap();
    for (arguments, reason) in [
        (&["report", "none.log"][..], "none.log"),
        (&["report", "b.log"], "nothing in b.log could be read"),
        (&["report", "-"], "write standard input into one first"),
        (&["report", "a.log", "-o", "a.log"], "another name"),
        (&["report", "a.log", "--db", "none.dbc"], "none.dbc"),
    ] {
        let (code, text) = cantap(&directory, arguments);
        assert!(code == Some(1) && text.contains(reason), "{arguments:?}: {text}");
    }
    std::fs::write(directory.join("page.html"), "<html></html>").unwrap();
    let (code, text) = cantap(&directory, &["report", "a.log"]);
    assert!(code == Some(1) && text.contains("cargo xtask web"), "{text}");
    assert_eq!(std::fs::read_to_string(directory.join("a.log")).unwrap(), log(5, 1));
}

#[test]
fn the_page_itself_is_written_and_replaces_nothing_else() {
    let directory = directory("page");
    let (code, text) = cantap(&directory, &["page"]);
    assert!(code == Some(0) && text.contains("cantap.html"), "{text}");
    let page = std::fs::read(directory.join("page.html")).unwrap();
    assert_eq!(std::fs::read(directory.join("cantap.html")).unwrap(), page);
    // A newer one takes its place, and no other file's.
    let (code, _) = cantap(&directory, &["page", "-o", "cantap.html"]);
    assert_eq!(code, Some(0));
    std::fs::write(directory.join("notes.html"), "mine").unwrap();
    let (code, text) = cantap(&directory, &["page", "-o", "notes.html"]);
    assert!(code == Some(1) && text.contains("give another name"), "{text}");
    assert_eq!(std::fs::read(directory.join("notes.html")).unwrap(), b"mine");
}
