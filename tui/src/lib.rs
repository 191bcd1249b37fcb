//! The live view of CAN buses and traces in a terminal, which `cantap monitor` shows: a source thread fills a [`model::Model`], the pages draw it, and recording depends on
//! neither.

#![forbid(unsafe_code)]

mod app;
mod cut;
mod editor;
mod event_text;
mod keyboard;
mod model;
mod order;
mod picture;
mod plan;
mod profile;
mod screen;
mod source;
mod stops;
#[cfg(test)]
mod tests;
mod theme;
mod times;
mod views;

use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::bail;
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Buffer;
use ratatui::crossterm::event::{self, Event, KeyEventKind};

use app::{Flow, Request};
use cantap_work::interrupt;
use editor::Edited;
use keyboard::{Keyboard, Waited};
use model::{Playing, SourceState};
use screen::Screen;
use source::{Shared, lock};
use stops::Stops;

pub use app::{App, SendEntry, View, parse_entry};
pub use model::Model;
pub use order::Order;
pub use picture::svg;
pub use plan::Plan;
pub use profile::Profile;
pub use source::Origin;
pub use theme::Theme;

/// The display is redrawn at this interval: 25 times a second.
const FRAME: Duration = Duration::from_millis(40);

/// Shows the display until the user leaves. Returns what is to be reported afterwards, such as how recordings ended.
pub fn run(
    origin: Origin,
    app: App,
    model: Model,
    orders: std::sync::mpsc::Receiver<Order>,
) -> anyhow::Result<Vec<String>> {
    interrupt::watch()?;
    let mut screen = Screen::enter()?;
    let mut sources = vec![Watched::start(origin, app, model, orders)?];
    sources[0].app.begin();
    let result = display(&mut screen, &mut sources);
    drop(screen);
    // Each source finishes its recording properly first.
    let notices: Vec<_> = sources.into_iter().map(Watched::end).collect();
    let mut notices = notices.into_iter().collect::<anyhow::Result<Vec<_>>>()?;
    notices.retain(|notice| !notice.is_empty());
    result.map(|()| notices)
}

/// A source, what is known of it, and its view.
struct Watched {
    app: App,
    model: Shared,
    thread: std::thread::JoinHandle<()>,
}

impl Watched {
    fn start(
        origin: Origin,
        app: App,
        model: Model,
        orders: std::sync::mpsc::Receiver<Order>,
    ) -> anyhow::Result<Self> {
        let model: Shared = Arc::new(Mutex::new(model));
        let thread = start(origin, &model, orders)?;
        Ok(Self { app, model, thread })
    }

    /// A trace beside this one, with the same databases, bit rates and memory for history.
    fn open_trace(&self, path: std::path::PathBuf) -> anyhow::Result<Self> {
        let (sender, receiver) = orders();
        let model = {
            let model = lock(&self.model);
            let decoder = Arc::clone(model.seen.signals.decoder());
            Model::new(decoder, model.options().clone(), model.history.memory().1)?
        };
        let mut app = App::new(self.app.view, self.app.theme, None, sender);
        app.databases = self.app.databases.clone();
        app.file = path.file_name().map(|name| name.to_string_lossy().into_owned());
        Self::start(Origin::File(path), app, model, receiver)
    }

    /// Ends it; returns what to report then.
    fn end(self) -> anyhow::Result<String> {
        // It may have ended on its own.
        let _ = self.app.orders.send(Order::Quit);
        if self.thread.join().is_err() {
            bail!("the source thread failed; please report this");
        }
        Ok(std::mem::take(&mut lock(&self.model).notice))
    }
}

fn start(
    origin: Origin,
    model: &Shared,
    orders: std::sync::mpsc::Receiver<Order>,
) -> std::io::Result<std::thread::JoinHandle<()>> {
    let model = Arc::clone(model);
    let body = move || source::run(origin, &model, &orders);
    std::thread::Builder::new().name("cantap-source".to_owned()).spawn(body)
}

/// Runs until the user leaves, a signal requests it, or there is no source or terminal left.
fn display(screen: &mut Screen, sources: &mut Vec<Watched>) -> anyhow::Result<()> {
    let stops = Stops::watch()?;
    let keyboard = Keyboard::new()?;
    let mut current = 0;
    while !interrupt::requested() && !sources.iter().any(|source| source.thread.is_finished()) {
        let drawn = Instant::now();
        let count = sources.len();
        let Watched { app, model, .. } = &mut sources[current];
        app.beside = (current + 1, count);
        screen.draw(app, model)?;
        let mut flow = if stops.asked() { Flow::Suspend } else { Flow::GoOn };
        // Events in the meantime are handled immediately.
        let mut wait = FRAME.saturating_sub(drawn.elapsed());
        while flow == Flow::GoOn && app.request.is_none() {
            match keyboard.wait(wait)? {
                Waited::Event => {}
                Waited::Nothing => break,
                Waited::Gone => return Ok(()),
            }
            let event = event::read()?;
            let mut model = lock(model);
            match event {
                Event::Key(key) if key.kind != KeyEventKind::Release => flow = app.key(key, &mut model),
                Event::Mouse(mouse) => app.mouse(mouse, &mut model),
                _ => {}
            }
            wait = Duration::ZERO;
        }
        match flow {
            Flow::GoOn => {}
            Flow::Quit => break,
            Flow::Suspend => screen.suspend()?,
        }
        if let Some(text) = app.clipboard.take() {
            screen::copy(&text)?;
        }
        match app.request.take() {
            Some(Request::Edit(path)) => match screen.give_to(|| editor::edit(&path, &stops))? {
                Edited::Done => app.reload_script(&path, &mut lock(model)),
                Edited::Failed(reason) => app.message = reason,
                Edited::Terminated => break,
            },
            Some(request) => current = follow(request, sources, current)?,
            None => {}
        }
    }
    Ok(())
}

/// Opens, selects or closes a source; returns the one to show.
fn follow(request: Request, sources: &mut Vec<Watched>, current: usize) -> anyhow::Result<usize> {
    match request {
        Request::Open(path) => {
            let opened = sources[current].open_trace(path)?;
            sources[current].app.set_aside();
            sources.push(opened);
            Ok(sources.len() - 1)
        }
        // The caller has the terminal.
        Request::Edit(_) => Ok(current),
        Request::Next => {
            if sources.len() == 1 {
                "there is one source; O opens a trace beside it".clone_into(&mut sources[0].app.message);
            }
            sources[current].app.set_aside();
            Ok((current + 1) % sources.len())
        }
        Request::Close if sources.len() == 1 => {
            "there is no other source; q leaves".clone_into(&mut sources[0].app.message);
            Ok(0)
        }
        Request::Close => {
            let notice = sources.remove(current).end()?;
            let next = current.min(sources.len() - 1);
            sources[next].app.message = notice;
            Ok(next)
        }
    }
}

/// One screen, and the first fault if nothing else could be read from a file.
pub struct Once {
    /// The screen.
    pub screen: Buffer,
    /// The first fault.
    pub nothing_read: Option<String>,
}

/// Watches for that time (a file: to its end), then returns the screen.
pub fn once(
    origin: Origin,
    mut app: App,
    model: Model,
    orders: std::sync::mpsc::Receiver<Order>,
    size: (u16, u16),
    time: Duration,
) -> anyhow::Result<Once> {
    let is_file = matches!(origin, Origin::File(_));
    // Nobody is there to be asked whether to take part in the bus.
    if app.plan.as_ref().is_some_and(|plan| plan.mode().transmits()) {
        app.begin();
    }
    let model: Shared = Arc::new(Mutex::new(model));
    let thread = start(origin, &model, orders)?;
    if is_file {
        // As fast as it can be read.
        for _ in 0..20 {
            let _ = app.orders.send(Order::Faster);
        }
    }
    let start = Instant::now();
    loop {
        let state = lock(&model).source.clone();
        match state {
            SourceState::Playing(Playing { ended: true, .. }) => break,
            SourceState::Gone(reason) => bail!("{reason}"),
            _ if !is_file && start.elapsed() >= time => break,
            _ => std::thread::sleep(Duration::from_millis(10)),
        }
    }
    if is_file {
        lock(&model).conclude();
    }
    app.catch_up(&mut lock(&model));
    let (screen, nothing_read) = {
        let model = lock(&model);
        let unread = model.unread.as_ref().filter(|_| model.first_ns.is_none());
        (screen(&mut app, &model, size)?, unread.map(|(_, first)| first.clone()))
    };
    let _ = app.orders.send(Order::Quit);
    if thread.join().is_err() {
        bail!("the source thread failed; please report this");
    }
    Ok(Once { screen, nothing_read })
}

/// A screen of this size.
pub fn screen(app: &mut App, model: &Model, (width, height): (u16, u16)) -> anyhow::Result<Buffer> {
    let mut terminal = Terminal::new(TestBackend::new(width, height))?;
    terminal.draw(|frame| views::draw(frame, app, model))?;
    Ok(terminal.backend().buffer().clone())
}

/// A screen as text, without colours.
pub fn text(buffer: &Buffer) -> String {
    let mut text = String::new();
    for row in 0..buffer.area.height {
        let line: String = (0..buffer.area.width)
            .filter_map(|column| buffer.cell((column, row)))
            .map(ratatui::buffer::Cell::symbol)
            .collect();
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

/// A channel for orders.
pub fn orders() -> (std::sync::mpsc::Sender<Order>, std::sync::mpsc::Receiver<Order>) {
    channel()
}
