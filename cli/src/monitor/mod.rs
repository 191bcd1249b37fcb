//! The live view: a source thread fills a [`model::Model`], the pages draw it, and what is recorded does not
//! depend on either.

pub mod app;
mod event_text;
mod keyboard;
pub mod model;
pub mod order;
pub mod picture;
pub mod plan;
pub mod profile;
mod recorder;
mod screen;
pub mod source;
#[cfg(test)]
mod tests;
pub mod theme;
mod times;
pub mod views;

use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::bail;
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Buffer;
use ratatui::crossterm::event::{self, Event, KeyEventKind};

use crate::interrupt;
use app::{App, Flow};
use keyboard::{Keyboard, Waited};
use model::{Model, SourceState};
use screen::Screen;
use order::Order;
use source::{Origin, Shared, lock};

/// The display is drawn anew so often: 25 times a second.
const FRAME: Duration = Duration::from_millis(40);

/// Shows the display until the user leaves.
pub fn run(
    origin: Origin,
    mut app: App,
    model: Model,
    orders: std::sync::mpsc::Receiver<Order>,
) -> anyhow::Result<()> {
    interrupt::watch()?;
    let mut screen = Screen::enter()?;
    let model: Shared = Arc::new(Mutex::new(model));
    let thread = start(origin, &model, orders)?;
    let result = display(&mut screen, &mut app, &model, || thread.is_finished());
    drop(screen);
    // The source ends the recording properly before it goes.
    let _ = app.orders.send(Order::Quit);
    if thread.join().is_err() {
        bail!("the source thread failed; please report this");
    }
    let notice = std::mem::take(&mut lock(&model).notice);
    if !notice.is_empty() {
        eprintln!("cantap: {notice}");
    }
    result
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

/// Until the user leaves, a signal asks for it, or there is no source or no terminal any more.
fn display(
    screen: &mut Screen,
    app: &mut App,
    model: &Shared,
    is_over: impl Fn() -> bool,
) -> anyhow::Result<()> {
    let stops = Stops::watch()?;
    let keyboard = Keyboard::new()?;
    while !interrupt::requested() && !is_over() {
        let drawn = Instant::now();
        screen.draw(app, model)?;
        let mut flow = if stops.asked() { Flow::Suspend } else { Flow::GoOn };
        // What happens meanwhile is answered at once.
        let mut wait = FRAME.saturating_sub(drawn.elapsed());
        while flow == Flow::GoOn {
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
    }
    Ok(())
}

/// Whether another program asked this one to stop for a while (SIGTSTP), as a shell's job control does.
struct Stops {
    #[cfg(unix)]
    asked: Arc<std::sync::atomic::AtomicBool>,
}

impl Stops {
    #[cfg(unix)]
    fn watch() -> std::io::Result<Self> {
        let asked = Arc::default();
        signal_hook::flag::register(signal_hook::consts::SIGTSTP, Arc::clone(&asked))?;
        Ok(Self { asked })
    }

    #[cfg(unix)]
    fn asked(&self) -> bool {
        self.asked.swap(false, std::sync::atomic::Ordering::Relaxed)
    }

    #[cfg(not(unix))]
    #[expect(clippy::unnecessary_wraps, reason = "it can fail where there are signals")]
    fn watch() -> std::io::Result<Self> {
        Ok(Self {})
    }

    #[cfg(not(unix))]
    #[expect(clippy::unused_self, reason = "there are no such signals here")]
    fn asked(&self) -> bool {
        false
    }
}

/// Watches for that time (a file: to its end), then returns the screen.
pub fn once(
    origin: Origin,
    mut app: App,
    model: Model,
    orders: std::sync::mpsc::Receiver<Order>,
    size: (u16, u16),
    time: Duration,
) -> anyhow::Result<Buffer> {
    let is_file = matches!(origin, Origin::File(_));
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
            SourceState::Playing { ended: true, .. } => break,
            SourceState::Gone(reason) => bail!("{reason}"),
            _ if !is_file && start.elapsed() >= time => break,
            _ => std::thread::sleep(Duration::from_millis(10)),
        }
    }
    app.catch_up(&mut lock(&model));
    let screen = screen(&mut app, &lock(&model), size)?;
    let _ = app.orders.send(Order::Quit);
    if thread.join().is_err() {
        bail!("the source thread failed; please report this");
    }
    Ok(screen)
}

/// One screen of this size.
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
