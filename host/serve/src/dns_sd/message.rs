//! Messages of multicast DNS (RFC 1035 §4, RFC 6762 §18): as much of them as announcing and finding one kind of service takes.

use std::fmt;
use std::net::IpAddr;

/// The longest message, without the headers of IP and UDP (RFC 6762 §17).
pub const MOST_BYTES: usize = 8952;
/// The longest name, with its lengths and its end (RFC 1035 §2.3.4).
const MOST_NAME: usize = 255;
/// The longest part of a name.
pub const MOST_LABEL: usize = 63;

/// Types of records.
pub mod kind {
    pub const A: u16 = 1;
    pub const PTR: u16 = 12;
    pub const TXT: u16 = 16;
    pub const AAAA: u16 = 28;
    pub const SRV: u16 = 33;
    pub const NSEC: u16 = 47;
    pub const ANY: u16 = 255;
}

/// The class of the Internet.
pub const IN: u16 = 1;
/// Any class, in a question.
const ANY_CLASS: u16 = 255;
/// In a record: it is the only one, and others are to be forgotten. In a question: an answer to the one who asks is enough.
const TOP_BIT: u16 = 0x8000;
/// The flags of an answer: it is one, and from the one who has the name.
const ANSWER: u16 = 0x8400;

/// As much of a text as has this many bytes.
pub fn up_to_bytes(text: &str, most: usize) -> &str {
    &text[..text.floor_char_boundary(most)]
}

/// A name, of parts as they are. Two that differ by the case of their letters are the same.
#[derive(Clone)]
pub struct Name(Vec<u8>);

impl Name {
    /// Of at least one part, each of 1 to 63 bytes. A longer name than DNS has is a mistake of whoever makes it.
    pub fn of(parts: &[&str]) -> Self {
        let mut bytes = Vec::new();
        for part in parts {
            let part = up_to_bytes(part, MOST_LABEL);
            bytes.push(part.len() as u8);
            bytes.extend_from_slice(part.as_bytes());
        }
        bytes.push(0);
        Self(bytes)
    }

    /// The name of something under this one.
    pub fn with_first(&self, part: &str) -> Self {
        let Self(mut bytes) = Self::of(&[part]);
        bytes.pop();
        bytes.extend_from_slice(&self.0);
        Self(bytes)
    }

    fn key(&self) -> Vec<u8> {
        // The lengths stay what they are: none is a letter.
        self.0.to_ascii_lowercase()
    }

    /// The first part, if the others are this name.
    pub fn first_before(&self, rest: &Self) -> Option<&[u8]> {
        let len = usize::from(*self.0.first()?);
        let (first, others) = self.0[1..].split_at_checked(len)?;
        (len > 0 && others.eq_ignore_ascii_case(&rest.0)).then_some(first)
    }

    /// As it stands in a record's data.
    pub fn bytes(&self) -> &[u8] {
        &self.0
    }
}

impl PartialEq for Name {
    fn eq(&self, other: &Self) -> bool {
        self.0.eq_ignore_ascii_case(&other.0)
    }
}

impl Eq for Name {}

impl PartialOrd for Name {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Name {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.key().cmp(&other.key())
    }
}

impl fmt::Debug for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", String::from_utf8_lossy(&self.0))
    }
}

/// A question.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Question {
    pub name: Name,
    pub kind: u16,
    class: u16,
}

impl Question {
    pub const fn new(name: Name, kind: u16) -> Self {
        Self { name, kind, class: IN }
    }

    /// Whether a record with this name and of this type is asked for.
    pub fn asks(&self, name: &Name, kind: u16) -> bool {
        let is_class = matches!(self.class & !TOP_BIT, IN | ANY_CLASS);
        is_class && (self.kind == kind || self.kind == self::kind::ANY) && self.name == *name
    }
}

/// A record. Names in its data are whole, also where the message that it came in refers to others.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    pub name: Name,
    pub kind: u16,
    /// Without its top bit.
    pub class: u16,
    /// It is the only one of its name and type.
    pub is_only: bool,
    /// In seconds; 0 if it is not so any more.
    pub ttl_s: u32,
    pub data: Vec<u8>,
}

impl Record {
    pub const fn new(name: Name, kind: u16, ttl_s: u32, data: Vec<u8>) -> Self {
        // Only names of services are others' as well.
        let is_only = kind != self::kind::PTR;
        Self { name, kind, class: IN, is_only, ttl_s, data }
    }

    pub fn pointer(name: Name, ttl_s: u32, to: &Name) -> Self {
        Self::new(name, kind::PTR, ttl_s, to.bytes().to_vec())
    }

    pub fn address(name: Name, ttl_s: u32, ip: IpAddr) -> Self {
        match ip {
            IpAddr::V4(ip) => Self::new(name, kind::A, ttl_s, ip.octets().to_vec()),
            IpAddr::V6(ip) => Self::new(name, kind::AAAA, ttl_s, ip.octets().to_vec()),
        }
    }

    pub fn place(name: Name, ttl_s: u32, port: u16, host: &Name) -> Self {
        let data = [&[0; 4], &port.to_be_bytes()[..], host.bytes()].concat();
        Self::new(name, kind::SRV, ttl_s, data)
    }

    /// Says that there are records of these types under the name, and no others (RFC 6762 §6.1).
    pub fn only_these(name: Name, ttl_s: u32, kinds: &[u16]) -> Self {
        let mut bits = [0; 32];
        for kind in kinds {
            bits[usize::from(kind / 8 % 32)] |= 0x80 >> (kind % 8);
        }
        let len = bits.iter().rposition(|bits| *bits != 0).map_or(0, |last| last + 1);
        let data = [name.bytes(), &[0, len as u8], &bits[..len]].concat();
        Self::new(name, kind::NSEC, ttl_s, data)
    }

    /// What it points to.
    pub fn target(&self) -> Option<Name> {
        (self.kind == kind::PTR).then(|| Name(self.data.clone()))
    }

    /// Where a service is: its port and its host.
    pub fn port_and_host(&self) -> Option<(u16, Name)> {
        let (head, host) = self.data.split_at_checked(6).filter(|_| self.kind == kind::SRV)?;
        Some((u16::from_be_bytes([head[4], head[5]]), Name(host.to_vec())))
    }

    /// A host's address.
    pub fn ip(&self) -> Option<IpAddr> {
        match self.kind {
            kind::A => <[u8; 4]>::try_from(self.data.as_slice()).ok().map(IpAddr::from),
            kind::AAAA => <[u8; 16]>::try_from(self.data.as_slice()).ok().map(IpAddr::from),
            _ => None,
        }
    }

    /// Whether it says the same as another one, for however long.
    pub fn is_same(&self, other: &Self) -> bool {
        let says = |record: &Self| (record.kind, record.class);
        says(self) == says(other) && self.name == other.name && self.data == other.data
    }
}

/// A message.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Message {
    pub id: u16,
    pub is_answer: bool,
    pub questions: Vec<Question>,
    pub answers: Vec<Record>,
    /// In a question: what whoever asks would like to have under that name.
    pub proposed: Vec<Record>,
    pub additional: Vec<Record>,
}

impl Message {
    pub fn question(name: Name, kind: u16) -> Self {
        Self { questions: vec![Question::new(name, kind)], ..Self::default() }
    }

    pub fn answer(answers: Vec<Record>) -> Self {
        Self { is_answer: true, answers, ..Self::default() }
    }

    /// On the wire.
    pub fn bytes(&self) -> Vec<u8> {
        let flags = if self.is_answer { ANSWER } else { 0 };
        let counts = [self.questions.len(), self.answers.len(), self.proposed.len(), self.additional.len()];
        let mut out = [self.id.to_be_bytes(), flags.to_be_bytes()].concat();
        out.extend(counts.iter().flat_map(|count| (*count as u16).to_be_bytes()));
        for Question { name, kind, class } in &self.questions {
            out.extend_from_slice(name.bytes());
            out.extend([kind, class].iter().flat_map(|number| number.to_be_bytes()));
        }
        for record in self.answers.iter().chain(&self.proposed).chain(&self.additional) {
            let class = if record.is_only { record.class | TOP_BIT } else { record.class };
            out.extend_from_slice(record.name.bytes());
            out.extend([record.kind, class].iter().flat_map(|number| number.to_be_bytes()));
            out.extend_from_slice(&record.ttl_s.to_be_bytes());
            out.extend_from_slice(&(record.data.len() as u16).to_be_bytes());
            out.extend_from_slice(&record.data);
        }
        out
    }

    /// Reads one; `None` if it is none, or says that it is longer than it is.
    pub fn read(bytes: &[u8]) -> Option<Self> {
        if bytes.len() > MOST_BYTES {
            return None;
        }
        let mut reader = Reader { bytes, at: 0 };
        let (id, flags) = (reader.number()?, reader.number()?);
        // Neither another operation nor an error (RFC 6762 §18.3, §18.11).
        if flags & 0x780F != 0 {
            return None;
        }
        let counts = [reader.number()?, reader.number()?, reader.number()?, reader.number()?];
        let questions = (0..counts[0]).map(|_| reader.question()).collect::<Option<_>>()?;
        let mut records = |count: u16| (0..count).map(|_| reader.record()).collect::<Option<Vec<_>>>();
        let (answers, proposed) = (records(counts[1])?, records(counts[2])?);
        let additional = records(counts[3])?;
        Some(Self { id, is_answer: flags & 0x8000 != 0, questions, answers, proposed, additional })
    }
}

struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    fn take(&mut self, len: usize) -> Option<&'a [u8]> {
        let taken = self.bytes.get(self.at..self.at.checked_add(len)?)?;
        self.at += len;
        Some(taken)
    }

    fn number(&mut self) -> Option<u16> {
        self.take(2)?.try_into().ok().map(u16::from_be_bytes)
    }

    /// A name, in parts of which the last can be a pointer to an earlier place: only ever further back, so that nothing leads in circles.
    fn name(&mut self) -> Option<Name> {
        let mut name = Vec::new();
        let (mut at, mut before, mut end) = (self.at, self.at, None);
        loop {
            let len = *self.bytes.get(at)?;
            match len {
                0 => {
                    name.push(0);
                    self.at = end.unwrap_or(at + 1);
                    return (name.len() <= MOST_NAME).then_some(Name(name));
                }
                1..=63 => {
                    name.extend_from_slice(self.bytes.get(at..=at + usize::from(len))?);
                    if name.len() >= MOST_NAME {
                        return None;
                    }
                    at += 1 + usize::from(len);
                }
                0xC0.. => {
                    let to = usize::from(len & 0x3F) << 8 | usize::from(*self.bytes.get(at + 1)?);
                    end = end.or(Some(at + 2));
                    if to >= before {
                        return None;
                    }
                    (at, before) = (to, to);
                }
                _ => return None,
            }
        }
    }

    fn question(&mut self) -> Option<Question> {
        Some(Question { name: self.name()?, kind: self.number()?, class: self.number()? })
    }

    fn record(&mut self) -> Option<Record> {
        let (name, kind, class) = (self.name()?, self.number()?, self.number()?);
        let ttl_s = u32::from_be_bytes(self.take(4)?.try_into().ok()?);
        let len = usize::from(self.number()?);
        let end = self.at + len;
        let data = match kind {
            self::kind::PTR => self.name()?.0,
            self::kind::SRV => {
                let head = self.take(6)?;
                [head, &self.name()?.0].concat()
            }
            _ => self.take(len)?.to_vec(),
        };
        let record =
            Record { name, kind, class: class & !TOP_BIT, is_only: class & TOP_BIT != 0, ttl_s, data };
        (self.at == end).then_some(record)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_again() {
        let (service, host) = (Name::of(&["a.b\\", "_x", "local"]), Name::of(&["host", "local"]));
        let message = Message {
            id: 7,
            is_answer: true,
            questions: vec![Question::new(host.clone(), kind::ANY)],
            answers: vec![Record::pointer(Name::of(&["_x", "local"]), 9, &service)],
            proposed: vec![Record::place(service.clone(), 5, 80, &host)],
            additional: vec![Record::address(host.clone(), 1, IpAddr::from([192, 0, 2, 7]))],
        };
        let read = Message::read(&message.bytes()).unwrap();
        assert_eq!(read, message);
        assert_eq!(read.answers[0].target(), Some(Name::of(&["A.B\\", "_X", "LOCAL"])));
        assert_eq!(read.proposed[0].port_and_host(), Some((80, host)));
        assert_eq!(read.additional[0].ip(), Some(IpAddr::from([192, 0, 2, 7])));
        assert_eq!(service.first_before(&Name::of(&["_x", "local"])), Some(&b"a.b\\"[..]));
        assert_eq!(service.first_before(&Name::of(&["local"])), None);
        // Of RFC 4034 §4.3's example, the types of the first window.
        let only = Record::only_these(Name::of(&["h"]), 1, &[1, 15, 46, 47]);
        assert_eq!(only.data[3..], [0, 6, 0x40, 1, 0, 0, 0, 3]);
    }

    #[test]
    fn a_name_goes_on_at_an_earlier_place_and_never_in_circles() {
        let head = [0, 0, 0x84, 0, 0, 0, 0, 2, 0, 0, 0, 0];
        let first =
            [&[1, b'h', 5][..], b"local", &[0, 0, 1, 0x80, 1, 0, 0, 0, 9, 0, 4, 192, 0, 2, 7]].concat();
        let with = |name: &[u8]| {
            let rest = [name, &[0, 1, 0, 1, 0, 0, 0, 9, 0, 4, 1, 2, 3, 4]].concat();
            Message::read(&[&head[..], &first, &rest].concat())
        };
        let read = with(&[1, b'g', 0xC0, 14]).unwrap();
        assert_eq!(read.answers[1].name, Name::of(&["g", "local"]));
        let own = (head.len() + first.len()) as u8;
        for bad in
            [&[0xC0, own][..], &[1, b'g', 0xC0, own], &[0xC0, own + 2], &[0xFF, 0xFF], &[0x40, 0], &[0xC0]]
        {
            assert_eq!(with(bad), None, "{bad:?}");
        }
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_are_a_message_or_none(bytes in proptest::collection::vec(0u8.., 0..200)) {
            if let Some(read) = Message::read(&bytes) {
                proptest::prop_assert_eq!(Message::read(&read.bytes()), Some(read));
            }
        }

        #[test]
        fn a_message_that_is_cut_is_none(cut in 0usize..80) {
            let name = Name::of(&["x", "local"]);
            let whole = Message::answer(vec![Record::place(name.clone(), 1, 2, &name); 2]).bytes();
            proptest::prop_assert_eq!(Message::read(&whole[..cut.min(whole.len() - 1)]), None);
        }
    }
}
