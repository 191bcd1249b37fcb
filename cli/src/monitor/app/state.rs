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
use super::signals::{SignalFilter, SignalsPage};
use super::wish::Wish;
use crate::databases::Databases;

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
    /// Nodes, transfers, and what was said.
    Nodes,
}

impl View {
    /// In the order of their keys.
    pub const ALL: [View; 8] = [
        View::Trace,
        View::Fixed,
        View::Signals,
        View::Graph,
        View::Statistics,
        View::Send,
        View::Record,
        View::Nodes,
    ];

    /// What its tab says.
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
        }
    }

    /// The page whose tab is in this column of the screen's first line.
    pub fn at_column(column: u16) -> Option<Self> {
        let mut end = 1;
        Self::ALL.into_iter().find(|view| {
            end += view.title().len() as u16 + 3;
            column < end
        })
    }
}

/// How times are shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimeMode {
    /// The time of day, UTC.
    Absolute,
    /// Seconds since the first record.
    Relative,
    /// Seconds since the record before.
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
    /// What there was to see when the display was stopped; the model goes on.
    pub frozen: Option<Box<Seen>>,
    /// How times are shown.
    pub time_mode: TimeMode,
    /// Place of the trace's selected record; the newest without.
    pub cursor: Option<u64>,
    /// Place of the first record below the trace's page, as last drawn.
    pub bottom: u64,
    /// What was last looked for, in capitals.
    pub(super) wanted: String,
    /// The search that is under way.
    pub(super) search: Option<Search>,
    /// The fixed view's column that rows are sorted by.
    pub sort: Column,
    /// Sorted the other way round.
    pub reverse: bool,
    /// Rows grouped by channel.
    pub grouped: bool,
    /// Show how often each bit changed.
    pub heat: bool,
    /// Where the fixed view's headings that sort stand, as last drawn.
    pub sort_columns: Vec<(Range<u16>, Column)>,
    /// Identifiers whose signals stand below their row.
    pub opened: HashSet<(u8, Id)>,
    /// The fixed view shows identifiers with a signal that is so.
    pub row_filter: SignalFilter,
    /// The signals of the trace's selected record are shown.
    pub record_opened: bool,
    /// How the signals page is.
    pub signals: SignalsPage,
    /// Selected row of the fixed, signals and send views.
    pub selected: usize,
    /// What the fixed view's rows are, by identifier, as last drawn.
    pub fixed_order: Vec<(u8, Id)>,
    /// What the signals view's rows are, by place in the table, as last drawn; none is a message's name.
    pub signal_order: Vec<Option<usize>>,
    /// Rows of the page that fit, as last drawn.
    pub page_rows: usize,
    /// What the graph shows of the time.
    pub graph: Graph,
    /// Frames to send.
    pub send: Vec<SendEntry>,
    /// The help is shown.
    pub help: bool,
    /// Its first line in sight; what is past the last is drawn as that.
    pub help_first: usize,
    /// A line of input.
    pub prompt: Option<Prompt>,
    /// Something to tell once, such as what is wrong with what was typed.
    pub message: String,
    /// Times to come back to, in their order.
    pub bookmarks: Vec<i64>,
    /// Where the file's bar is, as last drawn.
    pub bar: Option<Rect>,
    /// What the source is called where it is a file.
    pub file: Option<String>,
    /// What is asked of whoever has the display.
    pub wish: Option<Wish>,
    /// Which of how many sources this is, from 1.
    pub beside: (usize, usize),
    /// Text for the clipboard, to be taken by whoever owns the terminal.
    pub clipboard: Option<String>,
    /// The signal databases.
    pub databases: Databases,
    /// The device and its buses, if the source is one.
    pub plan: Option<Plan>,
    /// The sessions of the devices that the send list's periodic entries belong to.
    pub(super) sessions: Vec<u32>,
    /// Where orders for the source go.
    pub orders: Sender<Order>,
}

/// Whether to go on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flow {
    /// Yes.
    GoOn,
    /// The user wants to leave.
    Quit,
    /// The user wants the shell back for a while.
    Suspend,
}

/// Which way to look.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// To older records.
    Back,
    /// To newer records.
    Forward,
}

/// A search under way.
#[derive(Clone, Copy, Debug)]
pub struct Search {
    pub(super) direction: Direction,
    /// The place to go on at; going back, the one behind it.
    pub(super) at: u64,
}

impl App {
    /// As it is at the start.
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
            graph: Graph::default(),
            send: Vec::new(),
            help: false,
            help_first: 0,
            prompt: None,
            message: String::new(),
            bookmarks: Vec::new(),
            bar: None,
            file: None,
            wish: None,
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
            self.view = view;
            self.selected = 0;
        }
    }

    pub(super) fn ask(&mut self, kind: PromptKind, text: &str) {
        self.prompt = Some(Prompt { kind, line: Line::new(text), entry: None });
    }

    /// Stops the display, or lets it go on.
    pub(super) fn pause(&mut self, model: &Model) {
        if self.frozen.take().is_some() {
            self.cursor = None;
        } else {
            self.frozen = Some(Box::new(model.seen.clone()));
            self.cursor = self.cursor.or(model.history.end().checked_sub(1));
        }
    }

    /// Forgets everything that was seen; the display goes on.
    pub(super) fn clear(&mut self, model: &mut Model) {
        model.clear();
        self.cursor = None;
        self.selected = 0;
        self.frozen = None;
    }

    /// What is changed on a page is changed in what is shown and in what goes on behind it.
    pub(super) fn each_seen(&mut self, model: &mut Model, change: impl Fn(&mut Seen)) {
        change(&mut model.seen);
        if let Some(frozen) = &mut self.frozen {
            change(frozen);
        }
    }
}
