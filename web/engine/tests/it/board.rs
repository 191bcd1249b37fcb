//! A board's session as the page has it: bytes in, bytes out, over the virtual device.

use std::io::{Read, Write};
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use cantap::device::is_idle;
use cantap_virtual::Witness;
use cantap_web_engine::{Engine, message};
use serde_json::{Value, json};

/// The page: an engine, and the port.
struct Page {
    engine: Engine,
    port: cantap::device::Link,
    witness: Arc<Witness>,
}

fn now_ms() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64() * 1e3
}

impl Page {
    fn new(options: &str) -> Self {
        let connection = cantap_virtual::start(options.parse().unwrap()).unwrap();
        let witness = Arc::clone(&connection.witness);
        Self { engine: Engine::default(), port: connection.into_link(), witness }
    }

    fn try_ask(&mut self, request: &str, parameters: Value, bytes: Option<&[u8]>) -> Result<Value, String> {
        let answer = self.engine.ask(&message::request(request, parameters, bytes));
        let length = u32::from_le_bytes(answer[..4].try_into().unwrap()) as usize;
        let head: Value = serde_json::from_slice(&answer[4..4 + length]).unwrap();
        let sections = answer.get((4 + length).next_multiple_of(8)..).unwrap_or_default();
        if let Some(error) = head["error"].as_str() {
            return Err(error.to_owned());
        }
        if let Some(place) = head["ok"]["board"]["write"]["$u8"].as_array() {
            let [offset, len] = [0, 1].map(|at| place[at].as_u64().unwrap() as usize);
            self.port.writer.write_all(&sections[offset..offset + len]).unwrap();
        }
        Ok(head["ok"].clone())
    }

    fn ask(&mut self, request: &str, parameters: Value) -> Value {
        self.try_ask(request, parameters, None).unwrap()
    }

    fn open(&mut self, bitrates: [Option<u32>; 2], again: bool) -> Result<Value, String> {
        let parameters = json!({ "name": "drive", "bitrates": bitrates, "now": now_ms(), "again": again });
        self.try_ask("boardOpen", parameters, None)
    }

    /// Carries bytes until an answer is enough.
    fn until(&mut self, enough: impl Fn(&Value) -> bool) -> Value {
        let mut bytes = vec![0; 4096];
        loop {
            let len = match self.port.reader.read(&mut bytes) {
                Ok(len) => len,
                Err(error) if is_idle(&error) => 0,
                Err(error) => panic!("{error}"),
            };
            let piece = json!({ "bytes": { "$u8": [0, len] }, "at": now_ms() });
            let parameters = json!({ "pieces": [piece], "now": now_ms() });
            let answer = self.try_ask("boardTake", parameters, Some(&bytes[..len])).unwrap();
            if enough(&answer) {
                return answer;
            }
        }
    }
}

fn records(answer: &Value) -> u64 {
    answer["summary"]["records"].as_u64().unwrap()
}

fn is_over(answer: &Value) -> bool {
    answer["board"]["stage"] == "over"
}

#[test]
fn what_the_board_sends_is_the_trace_and_another_session_goes_on_in_it() {
    let mut page = Page::new("load=50,frames=mix");
    assert_eq!(page.ask("boardUsb", json!({})), json!({ "vendorId": 0x1209, "productId": 1 }));
    page.open([Some(500_000), Some(250_000)], false).unwrap();
    page.until(|answer| records(answer) > 500);
    // No other trace takes its place meanwhile, and no second session.
    let open = json!({ "name": "a.log", "more": false, "size": 1 });
    assert!(page.try_ask("open", open, Some(b"x")).unwrap_err().contains("close it first"));
    assert!(page.open([Some(500_000), None], true).unwrap_err().contains("close it first"));
    page.ask("boardStop", json!({}));
    let end = page.until(is_over);
    assert_eq!(end["board"]["error"], Value::Null);
    let heard = page.witness.activity();
    assert_eq!(heard.driven, [0, 0]);
    let channels = end["board"]["channels"].as_array().unwrap();
    let mut sum = 0;
    for (channel, bitrate) in channels.iter().zip([500_000, 250_000]) {
        assert_eq!((&channel["bitrate"], &channel["mode"]), (&json!(bitrate), &json!("listen-only")));
        assert_eq!((&channel["received"], &channel["lost"]), (&channel["counted"], &json!(0)));
        sum += channel["counted"].as_u64().unwrap();
    }
    assert_eq!(sum, heard.frames.iter().sum::<u64>());
    assert_eq!((end["summary"]["frames"].as_u64().unwrap(), records(&end)), (sum, sum));
    assert_eq!(end["summary"]["channels"][0]["bitrate"], 500_000);
    // Between the two sessions nothing is known of either channel.
    page.open([Some(125_000), None], true).unwrap();
    let more = page.until(|answer| records(answer) > sum + 100);
    assert_eq!(more["summary"]["channels"][0]["bitrate"], 125_000);
    let gaps = page.ask("gaps", json!({ "from": null, "to": null }));
    assert_eq!(gaps.as_array().unwrap().len(), 2);
    page.ask("boardVanished", json!({ "reason": "The device has been lost" }));
    let lost = page.until(is_over);
    assert_eq!(lost["board"]["error"], "the device at 'USB' vanished (The device has been lost)");
    assert!(page.open([Some(3), None], false).unwrap_err().contains("impossible"));
}

#[test]
fn without_a_board_there_is_nothing_to_take() {
    let mut page = Page::new("load=0");
    for (request, parameters) in [
        ("boardStop", json!({})),
        ("boardVanished", json!({ "reason": "" })),
        ("boardTake", json!({ "pieces": [], "now": 0.0 })),
    ] {
        assert!(
            page.try_ask(request, parameters, None).unwrap_err().contains("no board is open"),
            "{request}"
        );
    }
}
