//! A trace instead of a device.

use std::sync::Arc;

use cantap_ui::{Server, Site, Source};
use cantap_work::report::Reporter;

use crate::client::{PAGE, Running};

#[test]
fn a_trace_is_served_byte_for_byte_to_its_page_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("drive.log");
    let bytes: Vec<u8> = (0..1_000_000_u32).map(|n| (n * 7 % 251) as u8).collect();
    std::fs::write(&path, &bytes).unwrap();
    let server = Running::start(Source::Trace(path.clone()));
    let (head, body) = server.get(&format!("/trace?token={}", server.token));
    assert!(
        head.starts_with("HTTP/1.1 200 OK\r\n") && head.contains("Content-Length: 1000000\r\n"),
        "{head}"
    );
    assert!(body == bytes);
    let (head, body) = server.get("/trace");
    assert!(head.starts_with("HTTP/1.1 403 "), "{head}");
    assert!(String::from_utf8(body).unwrap().contains("token"));
    // There is nothing live.
    let (head, _) = server.get(&format!("/live?token={}", server.token));
    assert!(head.starts_with("HTTP/1.1 403 "), "{head}");
    std::fs::remove_file(&path).unwrap();
    assert!(server.get(&format!("/trace?token={}", server.token)).0.starts_with("HTTP/1.1 404 "));
    let site = || Site::new(PAGE).unwrap();
    let at = "127.0.0.1:0".parse().unwrap();
    for source in [path, folder.path().to_owned()] {
        assert!(
            Server::open(site(), Source::Trace(source), at, Reporter::silent(), Arc::new(|_, _| ())).is_err()
        );
    }
}
