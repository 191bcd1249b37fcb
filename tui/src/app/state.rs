//! The choices themselves.

use std::collections::HashSet;
use std::ops::Range;
use std::sync::mpsc::Sender;

use cantap::Id;
use ratatui::layout::Rect;

use super::super::model::{Model, Seen};
use super::super::order::Order;
use super::super::plan::Plan;
use super::super::theme::Theme;
use super::column::Column;
use super::entry::SendEntry;
use super::graph::Graph;
use super::line::{Line, Prompt, PromptKind};
use super::request::Request;
use super::signals::{SignalFilter, SignalsPage};
use cantap_work::databases::Databases;

/// A page of the display.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum View {
    /// Every frame in order.
    Trace,
    /// One row per identifier.
    Fixed,
    /// Live values.
    Signals,
    /// Curves of chosen signals.
    Graph,
    /// Load, rates, losses.
    Statistics,
    /// Frames to send.
    Send,
    /// Recording.
    Record,
    /// Nodes, transfers, and events.
    Nodes,
    /// Scripts, and the device's gateway.
    Scripts,
    /// What a vehicle answers by OBD-II.
    Obd,
}

impl View {
    /// In the order of their keys: 1 to 9, and 0.
    pub const ALL: [View; 10] = [
        View::Trace,
        View::Fixed,
        View::Signals,
        View::Graph,
        View::Statistics,
        View::Send,
        View::Record,
        View::Nodes,
        View::Scripts,
        View::Obd,
    ];
    /// How many of them follow each other by Tab: the last one asks a vehicle, which only its own key or tab may begin.
    const BY_TAB: usize = Self::ALL.len() - 1;

    /// The page that follows this one by Tab, or precedes it.
    pub(super) const fn neighbour(self, is_next: bool) -> Self {
        let step = if is_next { 1 } else { Self::BY_TAB - 1 };
        let place = match (self, is_next) {
            (Self::Obd, true) => Self::BY_TAB - 1,
            (Self::Obd, false) => 0,
            _ => self as usize,
        };
        Self::ALL[(place + step) % Self::BY_TAB]
    }

    /// The text of its tab.
    pub const fn title(self) -> &'static str {
        match self {
            Self::Trace => "Trace",
            Self::Fixed => "Fixed",
            Self::Signals => "Signals",
            Self::Graph => "Graph",
            Self::Statistics => "Statistics",
            Self::Send => "Send",
            Self::Record => "Record",
            Self::Nodes => "Nodes",
            Self::Scripts => "Scripts",
            Self::Obd => "OBD",
        }
    }
}

/// The form in which times are shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimeMode {
    /// The time of day, UTC.
    Absolute,
    /// Seconds since the first record.
    Relative,
    /// Seconds since the previous record.
    Delta,
}

impl TimeMode {
    pub(super) const fn next(self) -> Self {
        match self {
            Self::Absolute => Self::Relative,
            Self::Relative => Self::Delta,
            Self::Delta => Self::Absolute,
        }
    }
}

/// Everything that is not the model.
pub struct App {
    /// The page.
    pub view: View,
    /// How to draw.
    pub theme: Theme,
    /// What was on display when it was paused; the model continues.
    pub frozen: Option<Box<Seen>>,
    /// The form in which times are shown.
    pub time_mode: TimeMode,
    /// Position of the trace's selected record; `None` for the newest.
    pub cursor: Option<u64>,
    /// Position of the first record below the trace's page, as last drawn.
    pub bottom: u64,
    /// The last search text, in upper case.
    pub(super) wanted: String,
    /// The search in progress.
    pub(super) search: Option<Search>,
    /// The column by which the fixed view's rows are sorted.
    pub sort: Column,
    /// In reverse order.
    pub reverse: bool,
    /// Rows grouped by channel.
    pub grouped: bool,
    /// Show how often each bit changed.
    pub heat: bool,
    /// The positions of the fixed view's headings that sort, as last drawn.
    pub sort_columns: Vec<(Range<u16>, Column)>,
    /// Identifiers whose signals are shown below their row.
    pub opened: HashSet<(u8, Id)>,
    /// The fixed view shows only identifiers with a matching signal.
    pub row_filter: SignalFilter,
    /// The signals of the trace's selected record are shown.
    pub record_opened: bool,
    /// The state of the signals page.
    pub signals: SignalsPage,
    /// Selected row of the fixed, signals and send views.
    pub selected: usize,
    /// The identifiers in the fixed view's rows, as last drawn.
    pub fixed_order: Vec<(u8, Id)>,
    /// The signals in the signals view's rows, by index in the table, as last drawn; `None` for a message's
    /// name.
    pub signal_order: Vec<Option<usize>>,
    /// Number of rows that fit on the page, as last drawn.
    pub page_rows: usize,
    /// Where on the screen the first row of a list is, as last drawn.
    pub rows_at: u16,
    /// The graph's view of time.
    pub graph: Graph,
    /// Frames to send.
    pub send: Vec<SendEntry>,
    /// The help is shown.
    pub help: bool,
    /// The first line of the help that is shown; a position past the end is drawn as the end.
    pub help_first: usize,
    /// The input line, if any.
    pub prompt: Option<Prompt>,
    /// Lines of the scripts' output below the last one on the page; a position past the beginning is drawn as the beginning.
    pub output_above: usize,
    /// Number of lines of it that fit on the page, as last drawn.
    pub output_rows: usize,
    /// The columns of the pages' tabs, as last drawn.
    pub tab_columns: Vec<(Range<u16>, View)>,
    /// A message to show once, such as an error in what was typed.
    pub message: String,
    /// The message as last drawn is longer than its line, lies over the page, and says that any key continues.
    pub any_key_continues: bool,
    /// Times to return to, in order.
    pub bookmarks: Vec<i64>,
    /// The position of the file's bar, as last drawn.
    pub bar: Option<Rect>,
    /// The source's name if it is a file.
    pub file: Option<String>,
    /// A request to the owner of the display.
    pub request: Option<Request>,
    /// The number of this source, from 1, and the number of sources.
    pub beside: (usize, usize),
    /// Text for the clipboard, to be taken by the owner of the terminal.
    pub clipboard: Option<String>,
    /// The signal databases.
    pub databases: Databases,
    /// The device and its buses, if the source is one.
    pub plan: Option<Plan>,
    /// The devices' sessions to which the send list's periodic entries belong.
    pub(super) sessions: Vec<u32>,
    /// Where orders to the source go.
    pub orders: Sender<Order>,
}

/// Whether to continue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flow {
    /// Yes.
    GoOn,
    /// The user wants to leave.
    Quit,
    /// The user wants to return to the shell for a while.
    Suspend,
}

/// The direction of a search.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// To older records.
    Back,
    /// To newer records.
    Forward,
}

/// A search in progress.
#[derive(Clone, Copy, Debug)]
pub struct Search {
    pub(super) direction: Direction,
    /// The position at which to continue; when going back, the one after it.
    pub(super) at: u64,
}

impl App {
    /// The initial state.
    pub fn new(view: View, theme: Theme, plan: Option<Plan>, orders: Sender<Order>) -> Self {
        Self {
            view,
            theme,
            frozen: None,
            time_mode: TimeMode::Relative,
            cursor: None,
            bottom: 0,
            wanted: String::new(),
            search: None,
            sort: Column::Id,
            reverse: false,
            grouped: false,
            heat: false,
            sort_columns: Vec::new(),
            opened: HashSet::new(),
            record_opened: false,
            row_filter: SignalFilter::default(),
            signals: SignalsPage::default(),
            selected: 0,
            fixed_order: Vec::new(),
            signal_order: Vec::new(),
            page_rows: 20,
            rows_at: 0,
            graph: Graph::default(),
            send: Vec::new(),
            help: false,
            help_first: 0,
            prompt: None,
            output_above: 0,
            output_rows: 20,
            tab_columns: Vec::new(),
            message: String::new(),
            any_key_continues: false,
            bookmarks: Vec::new(),
            bar: None,
            file: None,
            request: None,
            beside: (1, 1),
            clipboard: None,
            databases: Databases::default(),
            plan,
            sessions: Vec::new(),
            orders,
        }
    }

    pub(super) fn order(&mut self, order: Order) {
        if self.orders.send(order).is_err() {
            "the source has ended; leave with q and start again".clone_into(&mut self.message);
        }
    }

    pub(super) fn show(&mut self, view: View) {
        if self.view != view {
            // Leaving the page ends the asking.
            self.set_aside();
            self.view = view;
            self.selected = 0;
        }
    }

    pub(super) fn ask(&mut self, kind: PromptKind, text: &str) {
        self.prompt = Some(Prompt { kind, line: Line::suggested(text), entry: None });
    }

    /// Pauses the display, or resumes it.
    pub(super) fn pause(&mut self, model: &Model) {
        if self.frozen.take().is_some() {
            self.cursor = None;
        } else {
            self.frozen = Some(Box::new(model.seen.clone()));
            self.cursor = self.cursor.or(model.history.end().checked_sub(1));
        }
    }

    /// Forgets everything seen; the display continues.
    pub(super) fn clear(&mut self, model: &mut Model) {
        model.clear();
        self.cursor = None;
        self.selected = 0;
        self.frozen = None;
    }

    /// Applies a change on a page both to what is shown and to what continues behind it.
    pub(super) fn each_seen(&mut self, model: &mut Model, change: impl Fn(&mut Seen)) {
        change(&mut model.seen);
        if let Some(frozen) = &mut self.frozen {
            change(frozen);
        }
    }
}
