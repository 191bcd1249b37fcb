//! The live view: a source thread fills a [`model::Model`], the pages draw it, and what is recorded does not
//! depend on either.

pub mod app;
pub mod model;
pub mod profile;
mod recorder;
pub mod sending;
pub mod source;
#[cfg(test)]
mod tests;
pub mod theme;
pub mod views;

use std::io::{IsTerminal, Write};
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::bail;
use ratatui::Terminal;
use ratatui::backend::{CrosstermBackend, TestBackend};
use ratatui::buffer::Buffer;
use ratatui::crossterm::event::{self, DisableMouseCapture, EnableMouseCapture, Event, KeyEventKind};
use ratatui::crossterm::execute;
use ratatui::crossterm::terminal::{
    EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode,
};

use app::{App, Flow};
use model::{Model, SourceState};
use source::{Order, Origin, Shared, lock};

/// The display is drawn anew so often: 25 times a second.
const FRAME: Duration = Duration::from_millis(40);
/// The row where a page's own rows begin, its heading.
const BODY_ROW: u16 = 2;

/// Shows the display until the user leaves.
pub fn run(
    origin: Origin,
    mut app: App,
    model: Model,
    orders: std::sync::mpsc::Receiver<Order>,
) -> anyhow::Result<()> {
    if !std::io::stdout().is_terminal() || !std::io::stdin().is_terminal() {
        bail!(
            "the live view needs a terminal; use --once for one screen, or `cantap capture` and `cantap stats`"
        );
    }
    let model: Shared = Arc::new(Mutex::new(model));
    let for_thread = Arc::clone(&model);
    let thread = std::thread::Builder::new()
        .name("cantap-source".to_owned())
        .spawn(move || source::run(origin, &for_thread, &orders))?;
    let result = {
        let _screen = Screen::enter()?;
        let mut terminal = Terminal::new(CrosstermBackend::new(std::io::stdout()))?;
        display(&mut terminal, &mut app, &model)
    };
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

fn display(
    terminal: &mut Terminal<CrosstermBackend<std::io::Stdout>>,
    app: &mut App,
    model: &Shared,
) -> anyhow::Result<()> {
    loop {
        let drawn = Instant::now();
        {
            let model = lock(model);
            terminal.draw(|frame| views::draw(frame, app, &model))?;
        }
        // What happens meanwhile is answered at once.
        let mut wait = FRAME.saturating_sub(drawn.elapsed());
        while event::poll(wait)? {
            let mut model = lock(model);
            let flow = match event::read()? {
                Event::Key(key) if key.kind != KeyEventKind::Release => app.key(key, &mut model),
                Event::Mouse(mouse) => {
                    app.mouse(mouse, BODY_ROW, &mut model);
                    Flow::GoOn
                }
                _ => Flow::GoOn,
            };
            if flow == Flow::Quit {
                return Ok(());
            }
            wait = Duration::ZERO;
        }
        if let Some(text) = app.clipboard.take() {
            copy(&text)?;
        }
    }
}

/// Puts text into the clipboard through the terminal (xterm's OSC 52), which works over a network too.
fn copy(text: &str) -> std::io::Result<()> {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut encoded = String::new();
    for piece in text.as_bytes().chunks(3) {
        let bits =
            piece.iter().chain([0, 0].iter()).take(3).fold(0u32, |bits, byte| bits << 8 | u32::from(*byte));
        for digit in 0..4 {
            let value = bits >> (18 - 6 * digit) & 63;
            encoded.push(if digit <= piece.len() { DIGITS[value as usize] as char } else { '=' });
        }
    }
    let mut out = std::io::stdout();
    write!(out, "\x1b]52;c;{encoded}\x07")?;
    out.flush()
}

/// The terminal in our hands; given back however we leave.
struct Screen;

impl Screen {
    fn enter() -> anyhow::Result<Self> {
        let before = std::panic::take_hook();
        // A panic's message must not be lost with the alternate screen.
        std::panic::set_hook(Box::new(move |info| {
            Self::leave();
            before(info);
        }));
        enable_raw_mode()?;
        let screen = Self;
        execute!(std::io::stdout(), EnterAlternateScreen, EnableMouseCapture)?;
        Ok(screen)
    }

    fn leave() {
        // There is nobody left to tell if that fails.
        let _ = execute!(std::io::stdout(), DisableMouseCapture, LeaveAlternateScreen);
        let _ = disable_raw_mode();
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        Self::leave();
    }
}

/// Looks for so long (a file: to its end), then gives the screen as text.
pub fn once(
    origin: Origin,
    mut app: App,
    model: Model,
    orders: std::sync::mpsc::Receiver<Order>,
    size: (u16, u16),
    time: Duration,
) -> anyhow::Result<String> {
    let is_file = matches!(origin, Origin::File(_));
    let model: Shared = Arc::new(Mutex::new(model));
    let for_thread = Arc::clone(&model);
    let thread = std::thread::Builder::new()
        .name("cantap-source".to_owned())
        .spawn(move || source::run(origin, &for_thread, &orders))?;
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
    let text = screen_text(&mut app, &lock(&model), size)?;
    let _ = app.orders.send(Order::Quit);
    if thread.join().is_err() {
        bail!("the source thread failed; please report this");
    }
    Ok(text)
}

/// One screen as text, without colours.
pub fn screen_text(app: &mut App, model: &Model, (width, height): (u16, u16)) -> anyhow::Result<String> {
    let mut terminal = Terminal::new(TestBackend::new(width, height))?;
    terminal.draw(|frame| views::draw(frame, app, model))?;
    Ok(buffer_text(terminal.backend().buffer()))
}

fn buffer_text(buffer: &Buffer) -> String {
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
