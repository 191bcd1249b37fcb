//! Sheets in XML (XDD and XDC, CiA 311), read into the same form as those of CiA 306.
//!
//! The places of attributes are those that CANopenNode's documentation describes (doc/objectDictionary.md). An object has its data type, access and
//! value itself, or a parameter of the file has them.

use std::collections::{BTreeMap, HashMap};

use cantap_trace::clean;
use roxmltree::{Document, Node};

use super::eds::{Eds, Entry, Object};

/// Names of data types of parameters (IEC 61131-3), and their numbers in CiA 301.
const TYPES: [(&str, u16); 18] = [
    ("BOOL", 0x01),
    ("SINT", 0x02),
    ("INT", 0x03),
    ("DINT", 0x04),
    ("LINT", 0x15),
    ("USINT", 0x05),
    ("BYTE", 0x05),
    ("CHAR", 0x05),
    ("UINT", 0x06),
    ("WORD", 0x06),
    ("UDINT", 0x07),
    ("DWORD", 0x07),
    ("ULINT", 0x1B),
    ("LWORD", 0x1B),
    ("REAL", 0x08),
    ("LREAL", 0x11),
    ("STRING", 0x09),
    ("WSTRING", 0x0B),
];

impl Eds {
    /// Reads a sheet in XML.
    pub(super) fn of_xml(text: &str) -> Self {
        read(text)
    }
}

fn read(text: &str) -> Eds {
    let mut eds = Eds::default();
    let document = match Document::parse(text) {
        Ok(document) => document,
        Err(error) => {
            eds.issues.push(clean::line(&error.to_string()).into_owned());
            return eds;
        }
    };
    let named = |name: &'static str| document.descendants().filter(move |node| is(*node, name));
    let first_text = |name| named(name).next().and_then(|node| node.text()).map(shown).unwrap_or_default();
    (eds.product, eds.vendor) = (first_text("productName"), first_text("vendorName"));
    let commissioned =
        named("deviceCommissioning").filter_map(|node| attribute(node, "nodeID")?.parse().ok());
    eds.node = commissioned.into_iter().find(|node| (1..=127).contains(node));
    let parameters: HashMap<_, _> =
        named("parameter").filter_map(|node| Some((attribute(node, "uniqueID")?, node))).collect();
    for node in named("CANopenObject") {
        let Some(index) = hexadecimal(node, "index") else {
            eds.issues.push(format!("{}: an object without a number", place(&document, node)));
            continue;
        };
        let name = attribute(node, "name").map(shown).unwrap_or_default();
        let code = attribute(node, "objectType").and_then(|code| code.parse().ok()).unwrap_or(7);
        let mut entries = BTreeMap::new();
        for sub in node.children().filter(|sub| is(*sub, "CANopenSubObject")) {
            match hexadecimal(sub, "subIndex").and_then(|sub| u8::try_from(sub).ok()) {
                Some(number) => {
                    entries.insert(number, entry(sub, &parameters));
                }
                None => eds
                    .issues
                    .push(format!("{}: an entry of {index:04X} without a number", place(&document, sub))),
            }
        }
        if entries.is_empty() && !matches!(code, 8 | 9) {
            entries.insert(0, entry(node, &parameters));
        }
        for (sub, entry) in &entries {
            if entry.data_type.is_none() {
                eds.issues.push(format!("{index:04X}:{sub:02X} has no data type that is known"));
            }
        }
        eds.objects.insert(index, Object { name, code, entries });
    }
    eds
}

fn is(node: Node<'_, '_>, name: &str) -> bool {
    node.is_element() && node.tag_name().name() == name
}

fn attribute<'a>(node: Node<'a, '_>, name: &str) -> Option<&'a str> {
    node.attribute(name).map(str::trim)
}

fn shown(text: &str) -> String {
    clean::line(text.trim()).into_owned()
}

fn hexadecimal(node: Node<'_, '_>, name: &str) -> Option<u16> {
    let text = attribute(node, name)?;
    u16::from_str_radix(text.trim_start_matches("0x"), 16).ok()
}

fn place(document: &Document<'_>, node: Node<'_, '_>) -> String {
    format!("line {}", document.text_pos_at(node.range().start).row)
}

/// What an object or an entry says of its value, or the parameter that it refers to.
fn entry(node: Node<'_, '_>, parameters: &HashMap<&str, Node<'_, '_>>) -> Entry {
    let parameter = attribute(node, "uniqueIDRef").and_then(|id| parameters.get(id));
    let own = |name: &str| attribute(node, name).filter(|text| !text.is_empty()).map(shown);
    // `<defaultValue value="4"/>`
    let of_parameter = |name: &'static str| {
        let found = parameter?.descendants().find(|child| is(*child, name))?;
        attribute(found, "value").filter(|text| !text.is_empty()).map(shown)
    };
    let kind = || {
        let mut children = parameter?.children().filter(Node::is_element);
        children.find_map(|child| TYPES.iter().find(|(name, _)| is(child, name))).map(|(_, number)| *number)
    };
    let access = || {
        Some(match attribute(*parameter?, "access")? {
            "read" => "ro",
            "write" => "wo",
            "readWrite" | "readWriteInput" | "readWriteOutput" => "rw",
            other => other,
        })
    };
    let first = |names: [&'static str; 2]| {
        names.into_iter().find_map(|name| own(name).or_else(|| of_parameter(name)))
    };
    let mapping = attribute(node, "PDOmapping").unwrap_or("no");
    Entry {
        name: own("name").unwrap_or_default(),
        data_type: hexadecimal(node, "dataType").or_else(kind),
        access: own("accessType")
            .unwrap_or_else(|| access().unwrap_or_default().to_owned())
            .to_ascii_lowercase(),
        value: first(["actualValue", "defaultValue"]).unwrap_or_default(),
        mappable: !mapping.eq_ignore_ascii_case("no"),
        low_limit: first(["lowLimit", "minValue"]).unwrap_or_default(),
        high_limit: first(["highLimit", "maxValue"]).unwrap_or_default(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both ways in which a file says what an object is.
    const SHEET: &str = r#"<?xml version="1.0"?>
<ISO15745ProfileContainer xmlns="http://www.canopen.org/xml/1.1"><ISO15745Profile><ProfileBody>
  <DeviceIdentity><vendorName>Maker</vendorName><productName>Drive</productName></DeviceIdentity>
  <ApplicationProcess><parameterList>
    <parameter uniqueID="P1" access="readWrite"><UINT/><defaultValue value="1000"/>
      <allowedValues><range><minValue value="0"/><maxValue value="5000"/></range></allowedValues></parameter>
  </parameterList></ApplicationProcess>
  <CANopenObjectList>
    <CANopenObject index="1000" name="Device type" objectType="7" dataType="0007" accessType="const" defaultValue="0x00020192" PDOmapping="no"/>
    <CANopenObject index="1017" name="Producer heartbeat" objectType="7" uniqueIDRef="P1" PDOmapping="no"/>
    <CANopenObject index="1018" name="Identity" objectType="9" subNumber="2">
      <CANopenSubObject subIndex="00" name="Entries" objectType="7" dataType="0005" accessType="ro" defaultValue="1"/>
      <CANopenSubObject subIndex="01" name="Vendor" objectType="7" dataType="0007" accessType="ro" defaultValue="0" actualValue="0x2A"/>
    </CANopenObject>
    <CANopenObject index="6041" name="Statusword" objectType="7" dataType="0006" accessType="ro" PDOmapping="TPDO"/>
    <CANopenObject index="zz" name="Wrong"/>
    <CANopenObject index="2000" name="Unknown" objectType="7"/>
  </CANopenObjectList>
  <deviceCommissioning nodeID="5" nodeName="d"/>
</ProfileBody></ISO15745Profile></ISO15745ProfileContainer>"#;

    #[test]
    fn a_sheet_in_xml_is_read_like_one_of_keys() {
        let eds = Eds::parse(SHEET.as_bytes());
        assert_eq!((eds.product.as_str(), eds.vendor.as_str(), eds.node), ("Drive", "Maker", Some(5)));
        let of = |index: u16, sub: u8| eds.entry_of(index, sub).unwrap();
        assert_eq!((of(0x1000, 0).value.as_str(), of(0x1000, 0).access.as_str()), ("0x00020192", "const"));
        let heartbeat = of(0x1017, 0);
        assert_eq!(
            (heartbeat.data_type, heartbeat.access.as_str(), heartbeat.value.as_str()),
            (Some(6), "rw", "1000")
        );
        assert_eq!((heartbeat.low_limit.as_str(), heartbeat.high_limit.as_str()), ("0", "5000"));
        assert_eq!((of(0x1018, 1).value.as_str(), eds.value_of(0x1018, 1, 5)), ("0x2A", Some(42)));
        assert!(of(0x6041, 0).mappable && !of(0x1000, 0).mappable);
        assert_eq!(eds.objects[&0x1018].code, 9);
        assert_eq!(
            eds.issues,
            ["line 16: an object without a number", "2000:00 has no data type that is known"]
        );
    }

    #[test]
    fn what_is_cut_or_no_sheet_is_said() {
        for end in (1..SHEET.len()).filter(|end| SHEET.is_char_boundary(*end)) {
            let eds = Eds::parse(&SHEET.as_bytes()[..end]);
            assert!(eds.objects.is_empty() && !eds.issues.is_empty());
        }
        assert!(Eds::parse(b"<x/>").objects.is_empty());
    }
}
