//! The terminal while it is ours: taken over, restored however we leave, and never waited for with the model
//! locked.

use std::cell::RefCell;
use std::io::{IsTerminal, Write};
use std::rc::Rc;

use anyhow::bail;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use ratatui::Terminal;
use ratatui::backend::CrosstermBackend;
use ratatui::crossterm::event::{DisableMouseCapture, EnableMouseCapture};
use ratatui::crossterm::terminal::{
    BeginSynchronizedUpdate, Clear, ClearType, EndSynchronizedUpdate, EnterAlternateScreen,
    LeaveAlternateScreen, disable_raw_mode, enable_raw_mode,
};
use ratatui::crossterm::{execute, queue};

use super::app::App;
use super::model::Model;
use super::source::{Shared, lock};
use super::views;

/// The terminal, taken over; dropping this restores it.
pub struct Screen {
    terminal: Terminal<CrosstermBackend<Page>>,
    page: Page,
}

/// Output to be written. Drawing needs the model, whose lock must not be held while a slow terminal takes its time.
#[derive(Clone, Default)]
struct Page(Rc<RefCell<Vec<u8>>>);

impl Write for Page {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.borrow_mut().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Screen {
    /// Takes over the terminal; if there is none, the error says what to do instead.
    pub fn enter() -> anyhow::Result<Self> {
        const INSTEAD: &str = "use --once for one screen, or `cantap capture` and `cantap stats`";
        // Where standard input is a trace (`candump can0 | cantap monitor - -b 500k`), keys come from the terminal itself.
        let has_keys =
            || std::io::stdin().is_terminal() || cfg!(unix) && std::fs::File::open("/dev/tty").is_ok();
        if !std::io::stdout().is_terminal() || !has_keys() {
            bail!("the live view needs a terminal; {INSTEAD}");
        }
        if cfg!(unix) && matches!(std::env::var("TERM").as_deref(), Ok("" | "dumb")) {
            bail!(
                "the live view needs a terminal that can move its cursor, and TERM says it cannot; {INSTEAD}"
            );
        }
        let page = Page::default();
        let terminal = Terminal::new(CrosstermBackend::new(page.clone()))?;
        let before = std::panic::take_hook();
        // A panic's message must not be lost with the alternate screen.
        std::panic::set_hook(Box::new(move |info| {
            give_back();
            before(info);
        }));
        let screen = Self { terminal, page };
        take()?;
        Ok(screen)
    }

    /// Draws the page that the user is viewing.
    pub fn draw(&mut self, app: &mut App, model: &Shared) -> anyhow::Result<()> {
        {
            let mut model = lock(model);
            app.catch_up(&mut model);
            self.render(app, &model)?;
        }
        let mut out = std::io::stdout();
        out.write_all(&self.page.0.borrow())?;
        self.page.0.borrow_mut().clear();
        Ok(out.flush()?)
    }

    fn render(&mut self, app: &mut App, model: &Model) -> anyhow::Result<()> {
        // A terminal that supports this shows the page only once it is complete.
        queue!(self.page, BeginSynchronizedUpdate)?;
        self.terminal.draw(|frame| views::draw(frame, app, model))?;
        Ok(queue!(self.page, EndSynchronizedUpdate)?)
    }

    /// Stops the program until the shell resumes it, with the terminal restored.
    #[cfg(unix)]
    pub fn suspend(&mut self) -> anyhow::Result<()> {
        let stop = || signal_hook::low_level::emulate_default_handler(signal_hook::consts::SIGTSTP);
        Ok(self.give_to(stop)??)
    }

    /// Gives the terminal to another program for a while.
    pub fn give_to<R>(&mut self, other: impl FnOnce() -> R) -> anyhow::Result<R> {
        give_back();
        let result = other();
        take()?;
        // Nothing that was drawn before is there any more.
        self.terminal = Terminal::new(CrosstermBackend::new(self.page.clone()))?;
        execute!(std::io::stdout(), Clear(ClearType::All))?;
        Ok(result)
    }

    /// Not available on this system.
    #[cfg(not(unix))]
    pub fn suspend(&mut self) -> anyhow::Result<()> {
        Ok(())
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        give_back();
    }
}

fn take() -> anyhow::Result<()> {
    enable_raw_mode()?;
    Ok(execute!(std::io::stdout(), EnterAlternateScreen, EnableMouseCapture)?)
}

fn give_back() {
    // If that fails, there is nobody left to report it to. The first drawing has hidden the cursor.
    let _ = execute!(
        std::io::stdout(),
        DisableMouseCapture,
        LeaveAlternateScreen,
        ratatui::crossterm::cursor::Show
    );
    let _ = disable_raw_mode();
}

/// Copies text to the clipboard through the terminal (xterm's OSC 52), which also works over a network.
pub fn copy(text: &str) -> std::io::Result<()> {
    let mut out = std::io::stdout();
    write!(out, "\x1b]52;c;{}\x07", STANDARD.encode(text))?;
    out.flush()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    #[ignore = "the next test runs it in a terminal of its own"]
    fn a_display_that_panics() {
        let _screen = Screen::enter().unwrap();
        panic!("on purpose");
    }

    #[cfg(unix)]
    #[test]
    fn a_panic_gives_the_terminal_back_and_its_message_stays() {
        use std::io::Read;

        let pair = portable_pty::native_pty_system().openpty(portable_pty::PtySize::default()).unwrap();
        let mut command = portable_pty::CommandBuilder::new(std::env::current_exe().unwrap());
        command.args(["--ignored", "--nocapture", "screen::tests::a_display_that_panics"]);
        command.env("TERM", "xterm");
        // A backtrace with lines would push the message off the screen.
        command.env("RUST_BACKTRACE", "0");
        let mut child = pair.slave.spawn_command(command).unwrap();
        drop(pair.slave);
        let (mut reader, mut output) = (pair.master.try_clone_reader().unwrap(), Vec::new());
        // It ends with an error when the child has closed its terminal.
        let _ = reader.read_to_end(&mut output);
        child.wait().unwrap();
        let mut terminal = vt100::Parser::default();
        terminal.process(&output);
        let screen = terminal.screen();
        assert!(String::from_utf8_lossy(&output).contains("\x1b[?1049h"));
        assert!(!screen.alternate_screen() && !screen.hide_cursor());
        assert_eq!(screen.mouse_protocol_mode(), vt100::MouseProtocolMode::None);
        assert!(screen.contents().contains("on purpose"), "{}", screen.contents());
        let local = format!("{:?}", pair.master.get_termios().unwrap().local_flags);
        assert!(local.contains("ICANON") && local.contains("ECHO"), "{local}");
    }
}
