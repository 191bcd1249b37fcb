//! Requests by name.

use super::decode::is_written;
use super::ecu::Ecu;
use super::model::{DopKind, Item, Link, ParamKind, Target};
use super::prefix::Prefix;

/// A request that has a name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NamedRequest {
    /// The service's short name, or that of a table's row that it asks for.
    pub name: String,
    /// The long name; empty without one.
    pub long_name: String,
    /// The bytes that are always the same.
    pub bytes: Vec<u8>,
    /// The parameters behind them, which whoever asks has to give.
    pub open: Vec<String>,
    /// Other names by which it is found: those of the values of its response.
    also: Vec<String>,
}

/// Why a name is not the name of a request.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NameError {
    /// Nothing has it.
    #[error("{name} is not the name of {what} of {ecu}{}", like(likely))]
    Unknown {
        /// The name.
        name: String,
        /// What was looked for, as `a request 22`.
        what: String,
        /// The layer.
        ecu: String,
        /// Names that are like it.
        likely: Vec<String>,
    },
    /// Several have it.
    #[error("{name} may be each of these; write one of them: {}", all.join(", "))]
    Several {
        /// The name.
        name: String,
        /// Those that it may be.
        all: Vec<String>,
    },
}

fn like(likely: &[String]) -> String {
    match likely {
        [] => "; `cantap db` lists what a file has".to_owned(),
        likely => format!("; there are: {}", likely.join(", ")),
    }
}

/// So many names are proposed.
const PROPOSED: usize = 8;

impl Ecu {
    /// Its requests in the order of their names, those for rows of tables among them.
    pub fn requests(&self) -> Vec<NamedRequest> {
        let mut requests = Vec::new();
        for number in self.view.services.values() {
            let service = &self.model.services[*number as usize];
            let Some(message) = service.request.and_then(|link| self.model.message(link)) else { continue };
            let prefix = Prefix::of(&self.model, &self.view, self.message(message), None);
            let bytes = prefix.bytes();
            let params = &self.message(message).params;
            let is_open =
                |kind: &ParamKind| !matches!(kind, ParamKind::Constant { .. } | ParamKind::Reserved { .. });
            let open: Vec<_> = params.iter().filter(|param| is_open(&param.kind)).collect();
            let request = NamedRequest {
                name: service.name.to_string(),
                long_name: service.long_name.to_string(),
                bytes: bytes.clone(),
                open: open.iter().map(|param| param.name.to_string()).collect(),
                also: self.values_of(&service.responses),
            };
            // One that only asks for rows of a table has a request for each.
            if let [param] = open[..]
                && let ParamKind::TableKey { table } = param.kind
            {
                requests.extend(self.rows(table, &request));
            }
            requests.push(request);
        }
        requests.sort_by(|a, b| a.name.cmp(&b.name));
        requests
    }

    /// The names of what the responses say.
    fn values_of(&self, responses: &[Link]) -> Vec<String> {
        let messages = responses.iter().filter_map(|link| self.model.message(*link));
        let params = messages.flat_map(|message| &self.message(message).params);
        let values = params.filter(|param| matches!(param.kind, ParamKind::Value { .. }));
        values.map(|param| param.name.to_string()).collect()
    }

    fn rows(&self, table: Link, service: &NamedRequest) -> Vec<NamedRequest> {
        let number = match self.model.links.get(table as usize) {
            Some(Target::Item(Item::Table(table))) => *table,
            Some(Target::Name(name)) => match self.view.tables.get(name) {
                Some(table) => *table,
                None => return Vec::new(),
            },
            _ => return Vec::new(),
        };
        let table = &self.model.tables[number as usize];
        let key = table.key.and_then(|key| self.model.dop(&self.view, key));
        let Some(DopKind::Data(data)) = key.map(|key| &self.model.dops[key as usize].kind) else {
            return Vec::new();
        };
        // A key's bytes are those that mean it: the only way that needs no conversion to be reversed.
        let rows = self.model.rows(number, table).filter_map(|(_, row)| {
            let value = super::xml::integer(&row.key)?;
            let bytes = u16::try_from(value).ok()?.to_be_bytes();
            let length = match data.coded.length {
                super::model::Length::Bits { bits: 16, mask: None } => &bytes[..],
                super::model::Length::Bits { bits: 8, mask: None } if bytes[0] == 0 => &bytes[1..],
                _ => return None,
            };
            let (found, used) =
                super::coded::extract(&data.coded, length, 0, 0, 8 * length.len() as u64).ok()?;
            let found = data.compu.convert(found, data.physical).ok()?;
            (used == length.len() && is_written(&found, &row.key)).then(|| NamedRequest {
                name: row.name.to_string(),
                long_name: row.long_name.to_string(),
                bytes: [&service.bytes, length].concat(),
                open: Vec::new(),
                also: Vec::new(),
            })
        });
        rows.collect()
    }

    /// The request of a name that begins with these bytes: by its own name or long name, or by the name of a value of its response; upper and
    /// lower case are the same.
    ///
    /// # Errors
    ///
    /// None has it, or several have.
    pub fn request(&self, name: &str, begins: &[u8]) -> Result<NamedRequest, NameError> {
        let mut all = self.requests();
        all.retain(|request| request.bytes.starts_with(begins));
        let same = |one: &str| one.eq_ignore_ascii_case(name);
        let by = |is: &dyn Fn(&NamedRequest) -> bool| {
            all.iter().filter(|request| is(request)).cloned().collect::<Vec<_>>()
        };
        let exact = by(&|request| request.name == name);
        let own = if exact.is_empty() { by(&|request| same(&request.name)) } else { exact };
        let own = if own.is_empty() { by(&|request| same(&request.long_name)) } else { own };
        let mut found =
            if own.is_empty() { by(&|request| request.also.iter().any(|also| same(also))) } else { own };
        found.dedup_by(|a, b| a.bytes == b.bytes);
        match found.len() {
            1 => Ok(found.remove(0)),
            0 => {
                let digits = crate::text::hex(begins);
                let wanted = name.to_lowercase();
                let is_like = |request: &&NamedRequest| {
                    let own = request.name.to_lowercase();
                    own.contains(&wanted) || wanted.contains(&own)
                };
                let likely = all.iter().filter(is_like).take(PROPOSED).map(|request| request.name.clone());
                Err(NameError::Unknown {
                    name: cantap_trace::clean::line(name).into_owned(),
                    what: format!("a request {digits}"),
                    ecu: self.name().to_owned(),
                    likely: likely.collect(),
                })
            }
            _ => Err(NameError::Several {
                name: name.to_owned(),
                all: found.into_iter().map(|request| request.name).collect(),
            }),
        }
    }
}
