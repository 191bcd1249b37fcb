//! Filters, and the rows that pass them.

use std::str::FromStr;

use cantap_protocols::Options;
use cantap_signals::Decoder;
use cantap_signals::condition::Condition;
use cantap_signals::search::DataPattern;
use cantap_trace::TraceRecord;
use cantap_trace::filter::Filter;

use crate::error::EngineError;
use crate::index::shift;
use crate::store::Store;

/// The view of all records.
pub const ALL: u32 = 0;
/// So many are kept, those that were used last.
const KEPT: usize = 8;

/// What a text looks for.
enum Matcher {
    /// Any may match.
    Filters(Vec<Filter>),
    Condition(Box<Condition>),
    Data(DataPattern),
}

impl Matcher {
    /// A filter of candump, several separated by blanks, or a condition of `cantap search`.
    fn of_filter(text: &str, decoder: &Decoder) -> Result<Self, EngineError> {
        let filters: Result<Vec<_>, _> = text.split_whitespace().map(Filter::from_str).collect();
        let unfit = match filters {
            Ok(filters) => return Ok(Self::Filters(filters)),
            Err(unfit) => unfit,
        };
        match cantap_protocols::condition(text, decoder, &Options::default()) {
            Ok(condition) => Ok(Self::Condition(Box::new(condition))),
            // Which of the two was meant shows in the text.
            Err(error) if text.contains(|character: char| " =<>!&|+*/%()[].".contains(character)) => {
                Err(EngineError::Filter(error.to_string()))
            }
            Err(_) => {
                Err(EngineError::Filter(format!("{unfit}; or a condition such as Speed > 80 or error")))
            }
        }
    }

    /// The same, or bytes: `11 ?? 3?`, `* DE AD`. A text that may be an identifier and bytes, such as `123`, is an identifier.
    fn of_search(text: &str, decoder: &Decoder) -> Result<Self, EngineError> {
        let is_one_identifier = !text.contains([' ', '?', '*']) && text.parse::<Filter>().is_ok();
        match text.parse::<DataPattern>() {
            Ok(pattern) if !is_one_identifier => Ok(Self::Data(pattern)),
            _ => Self::of_filter(text, decoder),
        }
    }

    fn matches(&mut self, record: &TraceRecord) -> bool {
        match self {
            Self::Filters(filters) => filters.iter().any(|filter| filter.accepts(record)),
            Self::Condition(condition) => condition.holds(record),
            Self::Data(pattern) => record.frame().is_some_and(|frame| pattern.matches(frame)),
        }
    }
}

/// The rows that pass a filter.
struct View {
    number: u32,
    text: String,
    is_search: bool,
    matcher: Matcher,
    rows: Vec<u32>,
    scanned: usize,
    used: u64,
}

impl View {
    fn extend(&mut self, store: &Store) {
        for row in self.scanned..store.len() {
            if store.record(row).is_some_and(|record| self.matcher.matches(&record)) {
                self.rows.push(row as u32);
            }
        }
        self.scanned = store.len();
    }
}

/// All views.
#[derive(Default)]
pub struct Views {
    kept: Vec<View>,
    numbers: u32,
    uses: u64,
}

/// The rows of a view: numbers of records.
#[derive(Clone, Copy)]
pub enum Rows<'a> {
    /// All of so many.
    All(usize),
    /// Those.
    Some(&'a [u32]),
}

impl Rows<'_> {
    /// How many rows there are.
    pub const fn len(self) -> usize {
        match self {
            Self::All(len) => len,
            Self::Some(rows) => rows.len(),
        }
    }

    /// The record of a row.
    pub fn record(self, row: usize) -> Option<usize> {
        match self {
            Self::All(len) => (row < len).then_some(row),
            Self::Some(rows) => rows.get(row).map(|record| *record as usize),
        }
    }

    /// The first row whose record is this one or a later one.
    pub fn row_of(self, record: usize) -> usize {
        match self {
            Self::All(len) => record.min(len),
            Self::Some(rows) => rows.partition_point(|row| (*row as usize) < record),
        }
    }
}

impl Views {
    /// Forgets all, such as after a database has changed: conditions may have another meaning.
    pub fn clear(&mut self) {
        self.kept.clear();
    }

    /// The view of a filter; [`ALL`] for an empty one. One that is there goes on.
    pub fn filter(&mut self, text: &str, decoder: &Decoder, store: &Store) -> Result<u32, EngineError> {
        if text.trim().is_empty() { Ok(ALL) } else { self.view(text, false, decoder, store) }
    }

    fn view(
        &mut self,
        text: &str,
        is_search: bool,
        decoder: &Decoder,
        store: &Store,
    ) -> Result<u32, EngineError> {
        let text = text.trim();
        self.uses += 1;
        let used = self.uses;
        if let Some(view) = self.kept.iter_mut().find(|view| view.text == text && view.is_search == is_search)
        {
            view.used = used;
            view.extend(store);
            return Ok(view.number);
        }
        let make = if is_search { Matcher::of_search } else { Matcher::of_filter };
        let matcher = make(text, decoder)?;
        self.numbers += 1;
        let mut view = View {
            number: self.numbers,
            text: text.to_owned(),
            is_search,
            matcher,
            rows: Vec::new(),
            scanned: 0,
            used,
        };
        view.extend(store);
        if self.kept.len() >= KEPT
            && let Some(oldest) = (0..self.kept.len()).min_by_key(|at| self.kept[*at].used)
        {
            self.kept.swap_remove(oldest);
        }
        self.kept.push(view);
        Ok(self.numbers)
    }

    /// The first records are no longer there: the others have lower numbers now.
    pub fn forget_first(&mut self, forgotten: usize) {
        for view in &mut self.kept {
            shift(&mut view.rows, forgotten);
            view.scanned = view.scanned.saturating_sub(forgotten);
        }
    }

    /// The rows of a view, as they were when it was last asked for.
    pub fn rows<'a>(&'a mut self, number: u32, store: &Store) -> Result<Rows<'a>, EngineError> {
        if number == ALL {
            return Ok(Rows::All(store.len()));
        }
        self.uses += 1;
        let used = self.uses;
        let view = self.kept.iter_mut().find(|view| view.number == number).ok_or(EngineError::NoView)?;
        view.used = used;
        Ok(Rows::Some(&view.rows))
    }

    /// The next row of a view after `from`, or the one before it, that a text finds. −1 is before the first.
    pub fn find(
        &mut self,
        number: u32,
        text: &str,
        from: i64,
        backwards: bool,
        decoder: &Decoder,
        store: &Store,
    ) -> Result<Option<usize>, EngineError> {
        if text.trim().is_empty() {
            return Err(EngineError::Filter(
                "nothing to look for; write bytes, an ID or a condition".to_owned(),
            ));
        }
        // It must not push out the view that is looked through.
        self.rows(number, store)?;
        let found = self.view(text, true, decoder, store)?;
        let of = |wanted: u32| {
            self.kept.iter().find(|view| view.number == wanted).map(|view| Rows::Some(&view.rows))
        };
        let within =
            if number == ALL { Rows::All(store.len()) } else { of(number).ok_or(EngineError::NoView)? };
        let found = of(found).ok_or(EngineError::NoView)?;
        let in_view = |at: usize| {
            let record = found.record(at)?;
            let row = within.row_of(record);
            (within.record(row) == Some(record)).then_some(row)
        };
        Ok(if backwards {
            let end = within.record(usize::try_from(from).unwrap_or(0)).unwrap_or(store.len());
            (0..found.row_of(end)).rev().find_map(in_view)
        } else {
            let begin = within.record(usize::try_from(from.saturating_add(1)).unwrap_or(0));
            let begin = begin.unwrap_or(store.len());
            (found.row_of(begin)..found.len()).find_map(in_view)
        })
    }
}
