//! What the page's worker is to an engine, and what most tests open.

use cantap_web_engine::{Engine, message};
use serde_json::{Value, json};

/// An engine and what the worker does with its answers.
#[derive(Default)]
pub struct Page(Engine);

impl Page {
    pub fn try_ask(
        &mut self,
        request: &str,
        parameters: Value,
        bytes: Option<&[u8]>,
    ) -> Result<(Value, Vec<u8>), String> {
        let answer = self.0.ask(&message::request(request, parameters, bytes));
        let length = u32::from_le_bytes(answer[..4].try_into().unwrap()) as usize;
        let head: Value = serde_json::from_slice(&answer[4..4 + length]).unwrap();
        let sections = answer.get((4 + length).next_multiple_of(8)..).unwrap_or_default().to_vec();
        match head.get("error") {
            Some(error) => Err(error.as_str().unwrap().to_owned()),
            None => Ok((head["ok"].clone(), sections)),
        }
    }

    pub fn ask(&mut self, request: &str, parameters: Value) -> Value {
        self.try_ask(request, parameters, None).unwrap().0
    }

    pub fn error(&mut self, request: &str, parameters: Value) -> String {
        self.try_ask(request, parameters, None).unwrap_err()
    }

    pub fn open(&mut self, name: &str, bytes: &[u8]) -> Result<Value, String> {
        let parameters = json!({ "name": name, "more": false, "size": bytes.len() });
        self.try_ask("open", parameters, Some(bytes)).map(|(summary, _)| summary)
    }

    pub fn database(&mut self, name: &str, text: &str) -> Value {
        self.try_ask("database", json!({ "name": name, "channel": null }), Some(text.as_bytes())).unwrap().0
    }

    /// The numbers of a `Float64Array` in an answer.
    pub fn floats(&mut self, request: &str, parameters: Value, member: &str) -> Vec<f64> {
        let (answer, sections) = self.try_ask(request, parameters, None).unwrap();
        let place = &answer[member]["$f64"];
        let (offset, length) = (place[0].as_u64().unwrap() as usize, place[1].as_u64().unwrap() as usize);
        sections[offset..offset + length * 8]
            .chunks(8)
            .map(|bytes| f64::from_le_bytes(bytes.try_into().unwrap()))
            .collect()
    }
}

/// A database of the identifier 123, with script in a comment.
pub const DBC: &str = "BO_ 291 Engine: 8 X\n SG_ Speed : 0|16@1+ (0.1,0) [0|250] \"km/h\" X\n SG_ Gear : 16|3@1+ (1,0) [0|0] \"\" X\n\n\
                   CM_ BO_ 291 \"</script><script>alert(1)</script>\";\nVAL_ 291 Gear 3 \"Drive\" ;\n";

/// Ten frames of 123 every 10 ms, each followed by one of 7E8 on the other channel.
pub fn log() -> String {
    (0..10)
        .map(|n| {
            let time = 1_700_000_000.0 + f64::from(n) * 0.01;
            format!(
                "({time:.6}) can0 123#{:02X}00030000000000\n({:.6}) can1 7E8#0102\n",
                n * 10,
                time + 0.001
            )
        })
        .collect::<Vec<_>>()
        .concat()
}
