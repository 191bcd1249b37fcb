//! The page without a trace, where it comes from, and how what it opens is put into it.

use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use cantap_address::Address;
use cantap_work::databases::{DatabaseOptions, DatabasePath};
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use serde_json::{Value, json};

/// The page that this build carries, compressed; empty if it carries none (see `build.rs`).
const BUILT_IN: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/page.html.gz"));
/// Names a page at run time.
const VARIABLE: &str = "CANTAP_PAGE";
/// The page's name beside the program.
const BESIDE: &str = "cantap-page.html";
/// Where what it opens goes: the page has this once before its script.
pub const MARK: &str = "<!--cantap-report-->";
/// A file is compressed if that saves at least a fiftieth of it; those of compressed formats stay as they are.
const WORTHWHILE: usize = 50;

/// Finds the page: the one of the environment, the one in the program, the one beside it.
pub fn find() -> anyhow::Result<String> {
    let read = |path: PathBuf| {
        std::fs::read_to_string(&path).with_context(|| format!("cannot read the page {}", path.display()))
    };
    let page = if let Some(path) = std::env::var_os(VARIABLE) {
        read(path.into())?
    } else if !BUILT_IN.is_empty() {
        let mut page = String::new();
        GzDecoder::new(BUILT_IN).read_to_string(&mut page).context("the page in this program is damaged")?;
        page
    } else {
        let beside = std::env::current_exe().ok().map(|program| program.with_file_name(BESIDE));
        match beside.filter(|path| path.is_file()) {
            Some(path) => read(path)?,
            None => bail!(
                "this build of cantap has no page in it; run cargo xtask web and set {VARIABLE} to the file that it names, or use a \
                 released binary"
            ),
        }
    };
    if !page.contains(MARK) {
        bail!("what {VARIABLE} names is no page of cantap without a report; make one with cargo xtask web");
    }
    Ok(page)
}

/// What a page is told of conversations, besides databases.
#[derive(Default)]
pub struct Described {
    /// Files that describe what is on the bus.
    pub files: Vec<Carried>,
    /// Who talks to whom: `Connections` in the page's `api.ts`; null if nothing is known.
    pub connections: Value,
}

/// The element with a report: a trace with its databases.
pub const REPORT: &str = "cantap-report";
/// The element with what a server has for the page.
pub const LIVE: &str = "cantap-live";

/// Puts an object into the page, as the element of this name. Whatever its texts are, they stay text: the element's content is JSON without `<`.
pub fn with(page: &str, element: &str, object: &Value) -> anyhow::Result<String> {
    let (before, after) = page.split_once(MARK).context("the page has no place for a report")?;
    let object = serde_json::to_string(object)?.replace('<', "\\u003c");
    Ok(format!("{before}<script type=\"application/json\" id=\"{element}\">{object}</script>{after}"))
}

/// What a page is told that is live from devices, served by `command`, with descriptions besides the databases.
pub fn about_devices(
    addresses: &[Address],
    options: &DatabaseOptions,
    described: Described,
    command: &str,
) -> anyhow::Result<Value> {
    let mut databases = databases(&options.paths)?;
    if options.car {
        let car = Carried::new("car.dbc", cantap_virtual::car::DATABASE.as_bytes())?;
        databases.push(car.with("channel", Value::Null));
    }
    databases.extend(described.files);
    let names: Vec<_> = addresses.iter().map(ToString::to_string).collect();
    let databases: Vec<_> = databases.into_iter().map(Carried::into_object).collect();
    Ok(json!({
        "version": 1,
        "kind": "device",
        "name": names.join(" + "),
        "command": command,
        "databases": databases,
        "connections": described.connections,
    }))
}

/// A path's last part.
pub fn file_name(path: &Path) -> Option<String> {
    Some(path.file_name()?.to_string_lossy().into_owned())
}

/// Databases inside the page, each with its channel.
pub fn databases(paths: &[DatabasePath]) -> anyhow::Result<Vec<Carried>> {
    let carried = |database: &DatabasePath| {
        let path = &database.path;
        let bytes = std::fs::read(path).with_context(|| {
            format!("cannot read {}; a page takes whole files, so leave out what follows a #", path.display())
        })?;
        let carried = Carried::new(&file_name(path).unwrap_or_default(), &bytes)?;
        Ok(carried.with("channel", database.channel.into()))
    };
    paths.iter().map(carried).collect()
}

/// A file inside the page.
pub struct Carried(Value, usize);

impl Carried {
    /// Packs the bytes of a file of this name.
    pub fn new(name: &str, bytes: &[u8]) -> anyhow::Result<Self> {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
        encoder.write_all(bytes)?;
        let packed = encoder.finish()?;
        let is_worthwhile = packed.len() < bytes.len() - bytes.len() / WORTHWHILE;
        let (encoding, content) = if is_worthwhile { ("gzip", &packed[..]) } else { ("none", bytes) };
        let data = BASE64.encode(content);
        let length = data.len();
        Ok(Self(json!({ "name": name, "encoding": encoding, "size": bytes.len(), "data": data }), length))
    }

    /// Adds a member to its object.
    pub fn with(mut self, member: &str, value: Value) -> Self {
        self.0[member] = value;
        self
    }

    /// Its length in the page, in bytes.
    pub const fn len(&self) -> usize {
        self.1
    }

    /// Its object in the report.
    pub fn into_object(self) -> Value {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_from_outside_never_end_the_element() {
        let evil = "</script><script>alert(1)</script><!--<script>";
        let page = format!("<body>{MARK}<script>x</script></body>");
        let report = json!({ "title": evil, "trace": Carried::new(evil, b"x").unwrap().into_object() });
        let made = with(&page, REPORT, &report).unwrap();
        let begin = made.find("id=\"cantap-report\">").unwrap() + "id=\"cantap-report\">".len();
        let end = made[begin..].find('<').unwrap() + begin;
        assert!(made[end..].starts_with("</script><script>x</script></body>"), "{made}");
        let read: Value = serde_json::from_str(&made[begin..end]).unwrap();
        assert_eq!(read, report);
    }

    #[test]
    fn a_file_comes_out_as_it_went_in() {
        for bytes in [&b"(1.0) can0 123#11\n".repeat(100)[..], b"", b"x"] {
            let object = Carried::new("a.log", bytes).unwrap().into_object();
            let data = BASE64.decode(object["data"].as_str().unwrap()).unwrap();
            let mut content = Vec::new();
            match object["encoding"].as_str().unwrap() {
                "gzip" => {
                    GzDecoder::new(&data[..]).read_to_end(&mut content).unwrap();
                }
                _ => content = data,
            }
            assert_eq!((content.as_slice(), &object["size"]), (bytes, &json!(bytes.len())));
        }
    }
}
