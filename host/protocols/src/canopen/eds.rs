//! Electronic data sheets and device configuration files (CiA 306): every object of the file, or the reason why it
//! is missing.

use std::collections::BTreeMap;

/// A file's description of a device.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Eds {
    /// The device's name.
    pub product: String,
    /// Its manufacturer.
    pub vendor: String,
    /// The node's number, if the file is for a single node (DCF).
    pub node: Option<u8>,
    /// Objects by index.
    pub objects: BTreeMap<u16, Object>,
    /// What was not understood in the file, with the line if there is one.
    pub issues: Vec<String>,
}

/// An object: a variable, or one with several entries.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Object {
    /// Its name.
    pub name: String,
    /// Its object code: 7 a variable, 8 an array, 9 a record.
    pub code: u8,
    /// By sub-index; a variable has 0.
    pub entries: BTreeMap<u8, Entry>,
}

/// A value of the dictionary.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Entry {
    /// Its name.
    pub name: String,
    /// Its data type (CiA 301, table 44).
    pub data_type: Option<u16>,
    /// One of `ro`, `rw`, `wo`, `const`.
    pub access: String,
    /// The value set for this node (DCF), otherwise the default.
    pub value: String,
    /// Whether a PDO may carry it.
    pub mappable: bool,
    /// The least value, in the file's words; empty if there is none.
    pub low_limit: String,
    /// The greatest value.
    pub high_limit: String,
}

/// A section of the file: its line and its keys.
#[derive(Default)]
struct Section {
    line: usize,
    keys: BTreeMap<String, String>,
}

impl Section {
    fn text(&self, key: &str) -> String {
        self.keys.get(key).cloned().unwrap_or_default()
    }

    fn number(&self, key: &str) -> Option<i128> {
        number(self.keys.get(key)?, 0)
    }
}

/// Decimal, hexadecimal with 0x, or octal with a leading 0; `$NODEID` may be added. Objects have up to 64 bits, signed or not.
pub fn number(text: &str, node: u8) -> Option<i128> {
    text.split('+').try_fold(0_i128, |sum, part| {
        let part = part.trim();
        let value = if part.eq_ignore_ascii_case("$NODEID") {
            node.into()
        } else if let Some(digits) = part.strip_prefix("0x").or_else(|| part.strip_prefix("0X")) {
            u64::from_str_radix(digits, 16).ok()?.into()
        } else if part.len() > 1
            && part.starts_with('0')
            && part.bytes().all(|byte| (b'0'..=b'7').contains(&byte))
        {
            i128::from_str_radix(part, 8).ok()?
        } else {
            part.parse().ok()?
        };
        sum.checked_add(value)
    })
}

impl Eds {
    /// Parses a file's text, in UTF-8 or else Latin-1: only names contain non-ASCII characters. A sheet in XML (XDD, XDC) is recognised by how it
    /// begins.
    pub fn parse(bytes: &[u8]) -> Self {
        let mut eds = Self::default();
        let latin = || bytes.iter().map(|byte| char::from(*byte)).collect();
        let text = str::from_utf8(bytes).map_or_else(|_| latin(), str::to_owned);
        let text = text.trim_start_matches('\u{FEFF}');
        if text.trim_start().starts_with('<') {
            return Self::of_xml(text);
        }
        let sections = eds.sections(text);
        if let Some(info) = sections.get("deviceinfo") {
            (eds.product, eds.vendor) = (info.text("productname"), info.text("vendorname"));
        } else {
            eds.issues.push("there is no section [DeviceInfo]".to_owned());
        }
        let commissioning =
            sections.get("devicecomissioning").or_else(|| sections.get("devicecommissioning"));
        eds.node = commissioning
            .and_then(|section| section.number("nodeid"))
            .and_then(|node| u8::try_from(node).ok())
            .filter(|node| (1..=127).contains(node));
        for (name, section) in &sections {
            eds.object(name, section, &sections);
        }
        for (name, section) in &sections {
            eds.sub_object(name, section);
        }
        for (name, section) in &sections {
            eds.check_entries(name, section);
        }
        for list in ["mandatoryobjects", "optionalobjects", "manufacturerobjects"] {
            eds.check_list(list, sections.get(list));
        }
        eds
    }

    fn sections(&mut self, text: &str) -> BTreeMap<String, Section> {
        let mut sections: BTreeMap<String, Section> = BTreeMap::new();
        let mut current: Option<String> = None;
        for (at, line) in text.lines().enumerate() {
            let line_number = at + 1;
            let line = line.trim();
            if line.is_empty() || line.starts_with([';', '#']) {
                continue;
            }
            if let Some(name) = line.strip_prefix('[') {
                let Some((name, _)) = name.split_once(']') else {
                    self.issues.push(format!("line {line_number}: a section without ']'"));
                    continue;
                };
                let name = name.trim().to_ascii_lowercase();
                if sections.contains_key(&name) {
                    self.issues.push(format!(
                        "line {line_number}: the section [{name}] is there twice; its keys are put together"
                    ));
                } else {
                    sections.insert(name.clone(), Section { line: line_number, ..Section::default() });
                }
                current = Some(name);
                continue;
            }
            match (line.split_once('='), current.as_ref().and_then(|name| sections.get_mut(name))) {
                (Some((key, value)), Some(section)) => {
                    let value = without_comment(value).trim().to_owned();
                    section.keys.insert(key.trim().to_ascii_lowercase(), value);
                }
                (Some(_), None) => {
                    self.issues.push(format!("line {line_number}: a key before the first section"));
                }
                (None, _) => {
                    self.issues.push(format!("line {line_number}: neither a section nor a key: {line}"));
                }
            }
        }
        sections
    }

    fn entry(&mut self, name: &str, section: &Section) -> Entry {
        let data_type = section.number("datatype").and_then(|kind| u16::try_from(kind).ok());
        if data_type.is_none() && section.keys.contains_key("datatype") {
            self.issues.push(format!("line {}: the data type of [{name}] is not a number", section.line));
        }
        let set = section.keys.get("parametervalue").filter(|value| !value.is_empty());
        Entry {
            name: section.text("parametername"),
            data_type,
            access: section.text("accesstype").to_ascii_lowercase(),
            value: set.cloned().unwrap_or_else(|| section.text("defaultvalue")),
            mappable: section.number("pdomapping") == Some(1),
            low_limit: section.text("lowlimit"),
            high_limit: section.text("highlimit"),
        }
    }

    /// `[1018]`: an object.
    fn object(&mut self, name: &str, section: &Section, sections: &BTreeMap<String, Section>) {
        let Some(index) = index(name) else { return };
        let code = section.number("objecttype").and_then(|code| u8::try_from(code).ok()).unwrap_or(7);
        let mut object = Object { name: section.text("parametername"), code, ..Object::default() };
        let compact = section.number("compactsubobj").unwrap_or(0);
        if compact > 0 {
            // An array in one section: all entries are alike, with names and values in separate sections (CiA 306,
            // 6.3.3).
            let model = self.entry(name, section);
            let names = sections.get(&format!("{name}name"));
            let values = sections.get(&format!("{name}value"));
            let count = Entry {
                name: "Highest sub-index supported".to_owned(),
                data_type: Some(5),
                access: "ro".to_owned(),
                ..Entry::default()
            };
            object.entries.insert(0, count);
            for sub in 1..=u8::try_from(compact).unwrap_or(254).min(254) {
                let of = |section: Option<&Section>| {
                    section.and_then(|section| section.keys.get(&sub.to_string()).cloned())
                };
                let entry = Entry {
                    name: of(names).unwrap_or_else(|| format!("{}{sub}", model.name)),
                    value: of(values).unwrap_or_else(|| model.value.clone()),
                    ..model.clone()
                };
                object.entries.insert(sub, entry);
            }
        } else if matches!(code, 8 | 9) {
            // Its entries are in separate sections.
        } else {
            let entry = self.entry(name, section);
            object.entries.insert(0, entry);
        }
        self.objects.insert(index, object);
    }

    /// `[1018sub1]`: an entry.
    fn sub_object(&mut self, name: &str, section: &Section) {
        let Some((object, sub)) = name.split_once("sub") else { return };
        let Some(index) = index(object) else { return };
        let Ok(sub) = u8::from_str_radix(sub, 16) else {
            self.issues.push(format!("line {}: [{name}] is not a sub-index", section.line));
            return;
        };
        let entry = self.entry(name, section);
        let line = section.line;
        if let Some(object) = self.objects.get_mut(&index) {
            object.entries.insert(sub, entry);
        } else {
            self.issues.push(format!("line {line}: [{name}] belongs to an object that has no section"));
            let object = Object { name: entry.name.clone(), code: 9, entries: [(sub, entry)].into() };
            self.objects.insert(index, object);
        }
    }

    /// Checks for entries that an object claims to have but that have no section.
    fn check_entries(&mut self, name: &str, section: &Section) {
        let Some(object) = index(name).and_then(|index| self.objects.get(&index)) else { return };
        let compact = section.number("compactsubobj").unwrap_or(0) > 0;
        if let Some(promised) =
            section.number("subnumber").filter(|_| !compact && matches!(object.code, 6 | 8 | 9))
            && promised != object.entries.len() as i128
        {
            let found = object.entries.len();
            self.issues
                .push(format!("line {}: [{name}] promises {promised} entries and has {found}", section.line));
        }
    }

    /// Checks that everything in the lists of objects exists.
    fn check_list(&mut self, list: &str, section: Option<&Section>) {
        let Some(section) = section else { return };
        let count = section.number("supportedobjects").unwrap_or(0);
        let listed = section.keys.iter().filter(|(key, _)| key.parse::<u32>().is_ok());
        let mut found: i128 = 0;
        for (_, value) in listed {
            found += 1;
            match number(value, 0).and_then(|index| u16::try_from(index).ok()) {
                Some(index) if self.objects.contains_key(&index) => {}
                Some(index) => self.issues.push(format!("[{list}] names {index:04X}, which has no section")),
                None => self.issues.push(format!("[{list}] names '{value}', which is not an index")),
            }
        }
        if count != found {
            self.issues.push(format!("[{list}] promises {count} objects and names {found}"));
        }
    }

    /// An object's entry.
    pub fn entry_of(&self, index: u16, sub: u8) -> Option<&Entry> {
        self.objects.get(&index)?.entries.get(&sub)
    }

    /// An entry's value as a number, for a node.
    pub fn value_of(&self, index: u16, sub: u8, node: u8) -> Option<u32> {
        number(&self.entry_of(index, sub)?.value, node).and_then(|value| u32::try_from(value).ok())
    }
}

/// CiA 306 has comments on separate lines; many tools also write them after a value and a blank.
fn without_comment(value: &str) -> &str {
    let mark = value.match_indices(';').map(|(at, _)| at).find(|&at| value[..at].ends_with([' ', '\t']));
    mark.map_or(value, |at| &value[..at])
}

/// Exactly four hexadecimal digits.
fn index(name: &str) -> Option<u16> {
    (name.len() == 4 && name.bytes().all(|byte| byte.is_ascii_hexdigit()))
        .then(|| u16::from_str_radix(name, 16).ok())
        .flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHEET: &str = "\u{FEFF}; a comment\n[DeviceInfo]\nVendorName=Us\nProductName=Drive\n[DeviceComissioning]\nNodeID=0x05\n\
        [MandatoryObjects]\nSupportedObjects=3\n1=0x1000\n2=0x1018\n3=0x1001\n[1000]\nParameterName=Device type\nObjectType=0x7\n\
        DataType=0x0007\nAccessType=ro\nDefaultValue=0x191\n[1018]\nParameterName=Identity ; of the maker\nObjectType=9\nSubNumber=3\n\
        [1018sub0]\nParameterName=Entries\nDataType=5\nAccessType=ro\nDefaultValue=1\n[1018Sub1]\nParameterName=Vendor\n\
        DataType=7\nAccessType=ro\n[1800]\nParameterName=TPDO\nObjectType=9\n[1800sub1]\nParameterName=COB\nDataType=7\n\
        DefaultValue=$NODEID+0x180\n[2000]\nParameterName=Table\nObjectType=8\nDataType=0x6\nAccessType=rw\nCompactSubObj=3\n\
        PDOMapping=1\n[2000Name]\nNrOfEntries=1\n2=Second\n[2000Value]\nNrOfEntries=1\n1=7\n[3000sub1]\nParameterName=Lost\nrubbish\n";

    #[test]
    fn every_object_is_there_or_said_why_not() {
        let eds = Eds::parse(SHEET.as_bytes());
        assert_eq!((eds.product.as_str(), eds.vendor.as_str(), eds.node), ("Drive", "Us", Some(5)));
        assert_eq!(eds.objects.keys().copied().collect::<Vec<_>>(), [0x1000, 0x1018, 0x1800, 0x2000, 0x3000]);
        assert_eq!(eds.value_of(0x1800, 1, 5), Some(0x185));
        assert_eq!(eds.entry_of(0x1018, 1).unwrap().name, "Vendor");
        let table = &eds.objects[&0x2000].entries;
        let names: Vec<_> = table.values().map(|entry| entry.name.as_str()).collect();
        assert_eq!(names, ["Highest sub-index supported", "Table1", "Second", "Table3"]);
        assert_eq!((table[&1].value.as_str(), table[&2].data_type, table[&2].mappable), ("7", Some(6), true));
        assert_eq!(
            eds.issues,
            [
                "line 53: neither a section nor a key: rubbish",
                "line 51: [3000sub1] belongs to an object that has no section",
                "line 18: [1018] promises 3 entries and has 2",
                "[mandatoryobjects] names 1001, which has no section",
            ]
        );
    }

    #[test]
    fn names_may_be_in_latin_1_and_lines_end_in_every_way() {
        let sheet = b"[DeviceInfo]\r\nProductName=Temp\xE9rature \xB0C\r\nVendorName=V\n";
        let eds = Eds::parse(sheet);
        assert_eq!((eds.product.as_str(), eds.vendor.as_str()), ("Temp\u{E9}rature \u{B0}C", "V"));
        assert_eq!(Eds::parse("[DeviceInfo]\nProductName=\u{E9}".as_bytes()).product, "\u{E9}");
    }

    #[test]
    fn numbers_are_written_in_every_way() {
        for (text, expected) in [
            ("10", Some(10)),
            ("0x1F", Some(31)),
            ("010", Some(8)),
            ("$NODEID+0x200", Some(0x205)),
            ("0x200 + $nodeid", Some(0x205)),
            ("", None),
            ("x", None),
            ("0", Some(0)),
            ("-5", Some(-5)),
            ("09", Some(9)),
            ("0xFFFFFFFFFFFFFFFF", Some(u64::MAX.into())),
            ("-9223372036854775808", Some(i64::MIN.into())),
            ("18446744073709551615", Some(u64::MAX.into())),
        ] {
            assert_eq!(number(text, 5), expected, "{text}");
        }
    }
}
