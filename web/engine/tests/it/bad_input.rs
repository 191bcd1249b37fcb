//! What cannot be is refused, with what to do.

use serde_json::json;

use crate::page::{DBC, Page, log};

#[test]
fn bad_requests_and_bad_files_are_refused_with_what_to_do() {
    let mut page = Page::default();
    assert!(page.error("summary", json!({})).contains("open one"));
    assert!(page.error("rows", json!({ "view": 0, "from": 0, "count": 1 })).contains("open one"));
    assert!(page.error("fly", json!({})).contains("one build"));
    assert!(page.open("a.xyz", b"nonsense\n").unwrap_err().contains("format"));
    assert!(page.open("a.log", b"nonsense\n").unwrap_err().contains("nothing in a.log could be read"));
    assert!(page.open("a.blf", b"LOGG").is_err());
    let bad = page
        .try_ask("database", json!({ "name": "a.dbc", "channel": null }), Some(b"BO_ nonsense"))
        .unwrap_err();
    assert!(bad.contains("a.dbc"), "{bad}");
    let bad = page.try_ask("database", json!({ "name": "a.txt", "channel": null }), Some(b"")).unwrap_err();
    assert!(bad.contains(".dbc"), "{bad}");
    // What is open stays open when a database is refused.
    page.open("drive.log", log().as_bytes()).unwrap();
    assert!(page.error("decode", json!({ "index": 20 })).contains("no record"));
    assert!(
        page.error("series", json!({ "signal": 7, "from": null, "to": null, "columns": 5 }))
            .contains("messages again")
    );
    assert!(
        page.error("bits", json!({ "channel": 1, "id": 0x800, "extended": false, "from": null, "to": null }))
            .contains("identifier")
    );
    let cut = &log().into_bytes()[..150];
    let summary = page.open("cut.log", cut).unwrap();
    assert!(
        summary["records"].as_u64().unwrap() > 0 && !summary["issues"].as_array().unwrap().is_empty(),
        "{summary}"
    );
}

/// No bytes make the engine panic: in the page that would be its end.
#[test]
fn random_damage_never_panics() {
    let mut random = fastrand::Rng::with_seed(7);
    let mut source = Page::default();
    source.open("drive.log", log().as_bytes()).unwrap();
    for format in ["candump", "asc", "blf", "trc", "csv", "pcapng", "mf4", "dif"] {
        let (answer, sections) = source
            .try_ask("export", json!({ "view": 0, "format": format, "from": null, "to": null }), None)
            .unwrap();
        let whole = &sections[..answer["bytes"]["$u8"][1].as_u64().unwrap() as usize];
        let name = answer["name"].as_str().unwrap();
        for _ in 0..100 {
            let mut bytes = whole.to_vec();
            for _ in 0..random.usize(1..8) {
                let at = random.usize(..bytes.len());
                bytes[at] = random.u8(..);
            }
            bytes.truncate(random.usize(..=bytes.len()));
            let mut page = Page::default();
            if page.open(name, &bytes).is_err() {
                continue;
            }
            page.database("car.dbc", DBC);
            for (request, parameters) in [
                ("rows", json!({ "view": 0, "from": 0, "count": 100 })),
                ("ids", json!({ "at": null })),
                ("findings", json!({})),
                ("conversations", json!({ "from": null, "to": null, "limit": 100 })),
                ("load", json!({ "channel": 1, "from": null, "to": null, "columns": 100 })),
                ("periods", json!({ "channel": 1, "id": 0x123, "extended": false })),
                ("gaps", json!({ "from": null, "to": null })),
                ("export", json!({ "view": 0, "format": "asc", "from": null, "to": null })),
            ] {
                page.ask(request, parameters);
            }
        }
    }
}

/// A file of 20 GB whose format must be there as a whole is refused while little of it has come, in words, and the engine goes on.
#[test]
fn a_file_that_cannot_be_read_in_pieces_and_is_too_large_is_refused_early() {
    let mut page = Page::default();
    page.open("drive.log", log().as_bytes()).unwrap();
    let export = json!({ "view": 0, "format": "mf4", "from": null, "to": null });
    let (saved, sections) = page.try_ask("export", export, None).unwrap();
    let length = saved["bytes"]["$u8"][1].as_u64().unwrap() as usize;
    let piece = [&sections[..length], &vec![0; (8 << 20) - length]].concat();
    let whole = json!({ "name": "long.mf4", "more": true, "size": 20_u64 << 30 });
    let mut answer = page.try_ask("open", whole, Some(&piece));
    let mut pieces = 1;
    while answer.is_ok() {
        answer = page.try_ask("append", json!({ "more": true }), Some(&piece));
        pieces += 1;
    }
    let error = answer.unwrap_err();
    assert!(error.contains("as a whole") && error.contains("cantap convert"), "{error}");
    assert!(pieces <= 16, "{pieces} pieces of 8 MiB");
    assert_eq!(page.open("drive.log", log().as_bytes()).unwrap()["frames"], 20);
}
