//! What descriptions of ECUs (ODX) have: layers, services, trouble codes.

use std::io::Write;
use std::path::PathBuf;

use cantap_protocols::odx::{Ecu, Odx};
use cantap_trace::counted;
use serde_json::{Value, json};

/// Lists the content of files, or what is not understood in them.
pub fn run(files: &[PathBuf], warnings: bool, json: bool, out: &mut impl Write) -> anyhow::Result<()> {
    let mut objects = Vec::new();
    for (at, path) in files.iter().enumerate() {
        let (odx, name) = (cantap_work::odx::read(path)?, path.display().to_string());
        match (warnings, json) {
            (true, false) => write_warnings(&odx, &name, out)?,
            (true, true) => objects.extend(odx.issues.iter().map(|issue| {
                json!({ "file": issue.file, "line": issue.line, "symbol": null, "warning": issue.what })
            })),
            (false, true) => objects.push(object(&odx, &name)?),
            (false, false) => {
                if at > 0 {
                    writeln!(out)?;
                }
                write_layers(&odx, &name, out)?;
            }
        }
    }
    if json {
        let key = if warnings { "warnings" } else { "descriptions" };
        writeln!(out, "{}", json!({ key: objects }))?;
    }
    Ok(())
}

fn write_warnings(odx: &Odx, name: &str, out: &mut impl Write) -> anyhow::Result<()> {
    for issue in &odx.issues {
        // Of a package, also which of its documents.
        if name.ends_with(&issue.file) {
            writeln!(out, "{issue}")?;
        } else {
            writeln!(out, "{name}: {issue}")?;
        }
    }
    if odx.issues_left_out > 0 {
        writeln!(out, "{name}: and {} more", odx.issues_left_out)?;
    }
    Ok(())
}

fn write_layers(odx: &Odx, name: &str, out: &mut impl Write) -> anyhow::Result<()> {
    let issues = match odx.issues.len() + odx.issues_left_out {
        0 => String::new(),
        count => format!(", {} (--warnings lists them)", counted(count, "warning")),
    };
    writeln!(out, "{name}: {}{issues}", counted(odx.layers().len(), "layer"))?;
    for (kind, layer) in odx.layers() {
        let ecu = odx.ecu(layer)?;
        let pairs: Vec<_> = ecu.pairs().iter().map(ToString::to_string).collect();
        let pairs = if pairs.is_empty() { String::new() } else { format!(", {}", pairs.join(" ")) };
        let codes = match ecu.trouble_codes().len() {
            0 => String::new(),
            count => format!(", {}", counted(count, "trouble code")),
        };
        let long_name =
            if ecu.long_name().is_empty() { String::new() } else { format!(" ({})", ecu.long_name()) };
        let services = counted(ecu.service_count(), "service");
        writeln!(out, "\n{} {layer}{long_name}{pairs}: {services}{codes}", kind.name())?;
        if kind.is_ecu() {
            write_requests(&ecu, out)?;
        }
    }
    Ok(())
}

fn write_requests(ecu: &Ecu, out: &mut impl Write) -> anyhow::Result<()> {
    let requests = ecu.requests();
    let width = requests.iter().map(|request| request.name.chars().count()).max().unwrap_or(0).clamp(7, 48);
    for request in requests {
        let bytes = hex(&request.bytes);
        let open =
            if request.open.is_empty() { String::new() } else { format!("+ {}", request.open.join(", ")) };
        let line = format!("  {bytes:<12} {:<width$} {} {open}", request.name, request.long_name);
        writeln!(out, "{}", line.trim_end())?;
    }
    Ok(())
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}

fn object(odx: &Odx, name: &str) -> anyhow::Result<Value> {
    let layers = odx.layers().map(|(kind, layer)| {
        let ecu = odx.ecu(layer)?;
        let pairs: Vec<_> = ecu.pairs().iter().map(ToString::to_string).collect();
        let requests = ecu.requests().into_iter().map(|request| {
            let bytes = hex(&request.bytes).replace(' ', "");
            json!({ "name": request.name, "long_name": request.long_name, "bytes": bytes, "parameters": request.open })
        });
        let codes = ecu.trouble_codes().map(|(code, text)| json!({ "code": code, "text": text }));
        Ok(json!({
            "kind": kind.name(), "name": layer, "long_name": ecu.long_name(), "pairs": pairs,
            "requests": requests.collect::<Vec<_>>(), "trouble_codes": codes.collect::<Vec<_>>(),
        }))
    });
    let layers = layers.collect::<anyhow::Result<Vec<_>>>()?;
    Ok(json!({ "file": name, "warnings": odx.issues.len() + odx.issues_left_out, "layers": layers }))
}
