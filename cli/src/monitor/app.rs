//! What the user has chosen: view, place, sorting, prompts; and what keys do.

use std::path::PathBuf;
use std::sync::mpsc::Sender;

use cantap::filter::Filter;
use cantap::wire::message::Mode;
use cantap::{Address, Channel, Id};
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers, MouseButton, MouseEvent, MouseEventKind};

use super::model::{FixedTable, Model, SourceState};
use super::sending::{SendEntry, parse_entry};
use super::source::{Order, Plan};
use super::theme::Theme;
use super::views::{fixed, trace};

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
}

impl View {
    /// In the order of their keys.
    pub const ALL: [View; 7] =
        [View::Trace, View::Fixed, View::Signals, View::Graph, View::Statistics, View::Send, View::Record];

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
        }
    }
}

/// How times are shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimeMode {
    /// Seconds since the epoch, as candump -ta.
    Absolute,
    /// Seconds since the first record.
    Relative,
    /// Seconds since the record before.
    Delta,
}

/// What a line of input is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PromptKind {
    /// Text to look for in the trace.
    Search,
    /// Filters in candump's syntax.
    Filter,
    /// A file to record to.
    Record,
    /// A frame or message to send, with its period.
    Send,
    /// Bit rates.
    BitRate,
    /// A device.
    Device,
}

/// A line of input.
#[derive(Clone, Debug)]
pub struct Prompt {
    /// What for.
    pub kind: PromptKind,
    /// What was typed.
    pub text: String,
    /// The entry of the send list that it edits.
    pub entry: Option<usize>,
}

/// Everything that is not the model.
pub struct App {
    /// The page.
    pub view: View,
    /// How to draw.
    pub theme: Theme,
    /// The display stands still; the model goes on.
    pub paused: bool,
    /// The rows as they were when the display was stopped.
    pub frozen: Option<(FixedTable, i64)>,
    /// How times are shown.
    pub time_mode: TimeMode,
    /// The trace's selected record by number; the newest without.
    pub cursor: Option<u64>,
    /// Number of the first record below the trace's page, as last drawn.
    pub bottom: u64,
    /// What was last looked for.
    pub search: String,
    /// The fixed view's column that rows are sorted by.
    pub sort: fixed::Column,
    /// Sorted the other way round.
    pub reverse: bool,
    /// Rows grouped by channel.
    pub grouped: bool,
    /// Show how often each bit changed.
    pub heat: bool,
    /// Selected row of the fixed, signals and send views.
    pub selected: usize,
    /// What the fixed view's rows are, by identifier, as last drawn.
    pub fixed_order: Vec<(u8, Id)>,
    /// Rows of the page that fit, as last drawn.
    pub page_rows: usize,
    /// Seconds that the graph shows.
    pub graph_span: f64,
    /// The graph's cursor, as a share of its width.
    pub graph_cursor: Option<f64>,
    /// Frames to send.
    pub send: Vec<SendEntry>,
    /// The help is shown.
    pub help: bool,
    /// A line of input.
    pub prompt: Option<Prompt>,
    /// Something to tell once, such as what is wrong with what was typed.
    pub message: String,
    /// Text for the clipboard, to be taken by whoever owns the terminal.
    pub clipboard: Option<String>,
    /// The device and its buses, if the source is one.
    pub plan: Option<Plan>,
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
}

impl App {
    /// As it is at the start.
    pub fn new(view: View, theme: Theme, plan: Option<Plan>, orders: Sender<Order>) -> Self {
        Self {
            view,
            theme,
            paused: false,
            frozen: None,
            time_mode: TimeMode::Relative,
            cursor: None,
            bottom: 0,
            search: String::new(),
            sort: fixed::Column::Id,
            reverse: false,
            grouped: false,
            heat: false,
            selected: 0,
            fixed_order: Vec::new(),
            page_rows: 20,
            graph_span: 10.0,
            graph_cursor: None,
            send: Vec::new(),
            help: false,
            prompt: None,
            message: String::new(),
            clipboard: None,
            plan,
            orders,
        }
    }

    pub(super) fn order(&mut self, order: Order) {
        if self.orders.send(order).is_err() {
            "the source has ended; leave with q and start again".clone_into(&mut self.message);
        }
    }

    /// A key was pressed.
    pub fn key(&mut self, key: KeyEvent, model: &mut Model) -> Flow {
        self.message.clear();
        // Autobaud may have found other bit rates.
        for (channel, rate) in self.plan.iter_mut().flat_map(|plan| &mut plan.channels) {
            *rate = model.options().bitrate_of(channel.number()).unwrap_or(*rate);
        }
        // Whoever presses a key has read it.
        model.notice.clear();
        if key.modifiers.contains(KeyModifiers::CONTROL) && key.code == KeyCode::Char('c') {
            return Flow::Quit;
        }
        if self.prompt.is_some() {
            self.prompt_key(key.code, model);
            return Flow::GoOn;
        }
        if self.help {
            self.help = false;
            return if key.code == KeyCode::Char('q') { Flow::Quit } else { Flow::GoOn };
        }
        match key.code {
            KeyCode::Char('q') => return Flow::Quit,
            KeyCode::Char('h' | '?') | KeyCode::F(1) => self.help = true,
            KeyCode::Char(digit @ '1'..='7') => self.show(View::ALL[digit as usize - '1' as usize]),
            KeyCode::Tab => self.show(View::ALL[(self.view as usize + 1) % View::ALL.len()]),
            KeyCode::BackTab => {
                self.show(View::ALL[(self.view as usize + View::ALL.len() - 1) % View::ALL.len()]);
            }
            KeyCode::Char(' ') if self.view == View::Send => self.toggle_sending(),
            KeyCode::Char(' ') => self.pause(model),
            KeyCode::Char('c') => {
                model.clear();
                self.cursor = None;
                self.selected = 0;
                self.frozen = None;
                self.paused = false;
            }
            KeyCode::Char('t') => {
                self.time_mode = match self.time_mode {
                    TimeMode::Absolute => TimeMode::Relative,
                    TimeMode::Relative => TimeMode::Delta,
                    TimeMode::Delta => TimeMode::Absolute,
                }
            }
            KeyCode::Char('/') => {
                self.show(View::Trace);
                self.ask(PromptKind::Search, String::new());
            }
            KeyCode::Char('f') => {
                let filters: Vec<_> = model.filters.iter().map(ToString::to_string).collect();
                self.ask(PromptKind::Filter, filters.join(" "));
            }
            KeyCode::Char('r') if model.recording.is_some() => self.order(Order::StopRecording),
            KeyCode::Char('r') => self.ask(PromptKind::Record, String::new()),
            KeyCode::Char('b') => self.ask_bit_rate(),
            KeyCode::Char('A') if self.plan.is_some() => self.order(Order::Autobaud),
            KeyCode::Char('D') => {
                let address =
                    self.plan.as_ref().map_or("virtual".to_owned(), |plan| plan.address.to_string());
                self.ask(PromptKind::Device, address);
            }
            KeyCode::Char('m') => self.toggle_mode(),
            KeyCode::Char(',') => self.order(Order::Slower),
            KeyCode::Char('.') => self.order(Order::Faster),
            KeyCode::Char('p') => self.order(Order::TogglePause),
            KeyCode::Char('>') => self.order(Order::Step),
            KeyCode::Char('l') => self.order(Order::ToggleLoop),
            code => self.view_key(code, model),
        }
        Flow::GoOn
    }

    fn show(&mut self, view: View) {
        if self.view != view {
            self.view = view;
            self.selected = 0;
        }
    }

    fn pause(&mut self, model: &Model) {
        self.paused = !self.paused;
        if self.paused {
            self.frozen = Some((model.table.clone(), model.statistics.last_ns().unwrap_or(0)));
            self.cursor = self.cursor.or(model.history.end().checked_sub(1));
        } else {
            self.frozen = None;
            self.cursor = None;
        }
    }

    /// Keys that mean something on this page only.
    fn view_key(&mut self, code: KeyCode, model: &mut Model) {
        match (self.view, code) {
            (View::Trace, KeyCode::Char('n')) => self.find(model, trace::Direction::Back),
            (View::Trace, KeyCode::Char('N')) => self.find(model, trace::Direction::Forward),
            (View::Trace, KeyCode::Char('y')) => {
                let number = self.cursor.or(model.history.end().checked_sub(1));
                self.clipboard = number.and_then(|number| trace::candump_line(model, number));
                if self.clipboard.is_some() {
                    "copied".clone_into(&mut self.message);
                }
            }
            (View::Trace, code) => self.scroll_trace(code, model),
            (View::Fixed, KeyCode::Char('s')) => self.sort = self.sort.next(),
            (View::Fixed, KeyCode::Char('S')) => self.reverse = !self.reverse,
            (View::Fixed, KeyCode::Char('g')) => self.grouped = !self.grouped,
            (View::Fixed, KeyCode::Char('H')) => self.heat = !self.heat,
            (View::Fixed, KeyCode::Char('#')) => model.table.notch(),
            (View::Fixed, KeyCode::Char('*')) => model.table.unnotch(),
            (View::Fixed, KeyCode::Char('u')) => model.table.unhide(),
            (View::Fixed, KeyCode::Char(key @ ('x' | 'o'))) => {
                if let Some((channel, id)) = self.fixed_order.get(self.selected).copied()
                    && let Some(row) = model.table.row_mut(channel, id)
                {
                    if key == 'x' {
                        row.hidden = true;
                    } else {
                        row.mark = (row.mark + 1) % 7;
                    }
                }
            }
            (View::Signals, KeyCode::Enter) => model.signals.toggle(self.selected),
            (View::Graph, KeyCode::Char('+') | KeyCode::Up) => {
                self.graph_span = (self.graph_span / 2.0).max(0.1);
            }
            (View::Graph, KeyCode::Char('-') | KeyCode::Down) => {
                self.graph_span = (self.graph_span * 2.0).min(600.0);
            }
            (View::Graph, KeyCode::Left) => self.move_graph_cursor(-0.02),
            (View::Graph, KeyCode::Right) => self.move_graph_cursor(0.02),
            (View::Graph, KeyCode::Esc) => self.graph_cursor = None,
            (View::Send, KeyCode::Enter) => self.send_once(),
            (View::Send, KeyCode::Char('a')) => self.ask(PromptKind::Send, String::new()),
            (View::Send, KeyCode::Char('e')) => self.edit_entry(),
            (View::Send, KeyCode::Char('d') | KeyCode::Delete) => self.delete_entry(),
            (_, code) => self.scroll(code),
        }
    }

    fn move_graph_cursor(&mut self, by: f64) {
        self.graph_cursor = Some((self.graph_cursor.unwrap_or(1.0) + by).clamp(0.0, 1.0));
    }

    fn scroll(&mut self, code: KeyCode) {
        let page = self.page_rows.max(1);
        self.selected = match code {
            KeyCode::Up | KeyCode::Char('k') => self.selected.saturating_sub(1),
            KeyCode::Down | KeyCode::Char('j') => self.selected + 1,
            KeyCode::PageUp => self.selected.saturating_sub(page),
            KeyCode::PageDown => self.selected + page,
            KeyCode::Home => 0,
            KeyCode::End => usize::MAX / 2,
            _ => self.selected,
        };
    }

    fn scroll_trace(&mut self, code: KeyCode, model: &Model) {
        let (first, Some(last)) = (model.history.first(), model.history.end().checked_sub(1)) else {
            return;
        };
        let page = self.page_rows.max(1) as u64;
        let cursor = self.cursor.unwrap_or(last);
        let wanted = match code {
            KeyCode::Up | KeyCode::Char('k') => cursor.saturating_sub(1),
            KeyCode::Down | KeyCode::Char('j') => cursor + 1,
            KeyCode::PageUp => cursor.saturating_sub(page),
            KeyCode::PageDown => cursor + page,
            KeyCode::Home => first,
            KeyCode::End | KeyCode::Esc => {
                self.cursor = None;
                self.paused = false;
                return;
            }
            _ => return,
        };
        self.cursor = Some(wanted.clamp(first, last));
    }

    fn find(&mut self, model: &Model, direction: trace::Direction) {
        if self.search.is_empty() {
            return self.ask(PromptKind::Search, String::new());
        }
        match trace::find(model, self.cursor, &self.search, direction) {
            Some(number) => self.cursor = Some(number),
            None => self.message = format!("'{}' is not there", self.search),
        }
    }

    fn ask(&mut self, kind: PromptKind, text: String) {
        self.prompt = Some(Prompt { kind, text, entry: None });
    }

    fn ask_bit_rate(&mut self) {
        let Some(plan) = &self.plan else {
            "a file has no bit rate; start with -b for the load".clone_into(&mut self.message);
            return;
        };
        let rates: Vec<_> =
            plan.channels.iter().map(|(channel, rate)| format!("{}:{rate}", channel.number())).collect();
        self.ask(PromptKind::BitRate, rates.join(" "));
    }

    fn prompt_key(&mut self, code: KeyCode, model: &mut Model) {
        let Some(prompt) = &mut self.prompt else {
            return;
        };
        match code {
            KeyCode::Esc => self.prompt = None,
            KeyCode::Backspace => {
                prompt.text.pop();
            }
            KeyCode::Char(character) => prompt.text.push(character),
            KeyCode::Enter => {
                let prompt = prompt.clone();
                self.prompt = None;
                self.answer(&prompt, model);
            }
            _ => {}
        }
    }

    /// A line was typed. What is wrong with it is said, and the line stays open.
    fn answer(&mut self, prompt: &Prompt, model: &mut Model) {
        let text = prompt.text.trim();
        let result = match prompt.kind {
            PromptKind::Search => {
                self.search = text.to_uppercase();
                if !text.is_empty() {
                    self.find(model, trace::Direction::Back);
                }
                Ok(())
            }
            PromptKind::Filter => self.set_filters(text),
            PromptKind::Record | PromptKind::Send if text.is_empty() => Ok(()),
            PromptKind::Record => {
                self.order(Order::Record(PathBuf::from(text)));
                Ok(())
            }
            PromptKind::Send => parse_entry(text, model).map(|entry| self.put_entry(prompt.entry, entry)),
            PromptKind::BitRate => self.set_bit_rates(text, model),
            PromptKind::Device => self.set_device(text, model),
        };
        if let Err(reason) = result {
            self.message = reason;
            self.prompt = Some(prompt.clone());
        }
    }

    fn set_filters(&mut self, text: &str) -> Result<(), String> {
        let filters =
            text.split_whitespace().map(|part| part.parse::<Filter>().map_err(|error| error.to_string()));
        let filters = filters.collect::<Result<Vec<_>, _>>()?;
        self.order(Order::Filter(filters));
        Ok(())
    }

    fn set_bit_rates(&mut self, text: &str, model: &mut Model) -> Result<(), String> {
        let Some(plan) = &self.plan else {
            return Ok(());
        };
        let rates = text
            .split_whitespace()
            .map(str::parse::<crate::channel_bitrate::ChannelBitrate>)
            .collect::<Result<Vec<_>, _>>()?;
        let plan = Plan { channels: channels_of(&rates)?, ..plan.clone() };
        self.open(plan, model)
    }

    fn set_device(&mut self, text: &str, model: &mut Model) -> Result<(), String> {
        let address: Address = text.parse().map_err(|error: cantap::DeviceError| error.to_string())?;
        let plan = if let Some(plan) = &self.plan {
            Plan { address, ..plan.clone() }
        } else {
            let options = model.options();
            let channels: Vec<_> = Channel::ALL
                .into_iter()
                .filter_map(|channel| Some((channel, options.bitrate_of(channel.number())?)))
                .collect();
            if channels.is_empty() {
                return Err("no bit rate is known; leave, and start with -d DEVICE -b BITRATE".to_owned());
            }
            Plan { address, channels, mode: Mode::ListenOnly }
        };
        self.open(plan, model)
    }

    fn open(&mut self, plan: Plan, model: &mut Model) -> Result<(), String> {
        let options = plan.options(model.options());
        model.set_options(options).map_err(|error| error.to_string())?;
        // A new session has no periodic entries.
        self.send.iter_mut().for_each(|entry| entry.on = false);
        self.plan = Some(plan.clone());
        self.order(Order::Open(plan));
        Ok(())
    }

    /// The mouse was used. `body` is where the page's rows begin.
    pub fn mouse(&mut self, event: MouseEvent, body_row: u16, model: &mut Model) {
        let code = match event.kind {
            MouseEventKind::ScrollUp => KeyCode::Up,
            MouseEventKind::ScrollDown => KeyCode::Down,
            MouseEventKind::Down(MouseButton::Left) if event.row == 0 => {
                if let Some(view) = super::views::tab_at(event.column) {
                    self.show(view);
                }
                return;
            }
            MouseEventKind::Down(MouseButton::Left) if event.row > body_row => {
                let row = usize::from(event.row - body_row - 1);
                if matches!(self.view, View::Fixed | View::Signals | View::Send) {
                    self.selected = super::views::first_row(self.selected, self.page_rows) + row;
                }
                return;
            }
            _ => return,
        };
        if self.prompt.is_none() && !self.help {
            for _ in 0..3 {
                self.view_key(code, model);
            }
        }
    }
}

/// Channels to open from bit rates: one without a channel is for both.
pub fn channels_of(rates: &[crate::channel_bitrate::ChannelBitrate]) -> Result<Vec<(Channel, u32)>, String> {
    let options = crate::channel_bitrate::ChannelBitrate::options(rates);
    let channels: Vec<_> = Channel::ALL
        .into_iter()
        .filter_map(|channel| Some((channel, options.bitrate_of(channel.number())?)))
        .collect();
    if channels.is_empty() {
        return Err("give a bit rate, such as 500k, or one for each channel: 1:500k 2:250k".to_owned());
    }
    Ok(channels)
}

/// Whether the source is over or gone, in words for the top line.
pub fn source_text(model: &Model) -> String {
    match &model.source {
        SourceState::Starting => "connecting".to_owned(),
        SourceState::Running => "running".to_owned(),
        SourceState::Gone(reason) => format!("gone, trying again: {reason}"),
        SourceState::Playing { factor, paused, looped, ended } => {
            let state = match (paused, ended) {
                (_, true) => "ended",
                (true, _) => "stopped",
                _ => "playing",
            };
            let looped = if *looped { ", loop" } else { "" };
            let speed =
                if *factor == 0.0 { "as fast as can be".to_owned() } else { format!("delay ×{factor}") };
            format!("{state}, {speed}{looped}")
        }
    }
}
