//! Colours for dark and light backgrounds and for colour-blind users; only modifiers if there are no colours.
//!
//! Nothing is conveyed by colour alone: errors have a letter, alarms an arrow, losses a text.

use ratatui::style::{Color, Modifier, Style};

/// How to draw.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Theme {
    /// Whether colours may be used.
    pub colour: bool,
    /// Whether the background is light.
    pub light: bool,
    /// Whether characters beyond ASCII may be used.
    pub unicode: bool,
}

impl Theme {
    /// From the environment: `NO_COLOR`, `COLORFGBG`, the locale; and from the user's choice.
    pub fn from_environment(light: bool) -> Self {
        let has = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
        // "foreground;background", where 7 and 15 are light.
        let is_light = std::env::var("COLORFGBG")
            .is_ok_and(|value| matches!(value.rsplit(';').next(), Some("7" | "15")));
        Self {
            colour: !has("NO_COLOR"),
            light: light || is_light,
            unicode: cantap_work::locale::is_utf8_locale(),
        }
    }

    fn style(self, dark: Color, light: Color, plain: Modifier) -> Style {
        if self.colour {
            Style::new().fg(if self.light { light } else { dark })
        } else {
            Style::new().add_modifier(plain)
        }
    }

    /// Errors, and values above their alarm limit.
    pub fn error(self) -> Style {
        self.style(Color::LightRed, Color::Red, Modifier::BOLD).add_modifier(Modifier::BOLD)
    }

    /// Whatever follows a loss.
    pub fn loss(self) -> Style {
        self.style(Color::Yellow, Color::Rgb(0x99, 0x66, 0), Modifier::REVERSED)
    }

    /// Values below their alarm limit.
    pub fn below(self) -> Style {
        self.style(Color::LightBlue, Color::Blue, Modifier::UNDERLINED).add_modifier(Modifier::BOLD)
    }

    /// Frames sent by this device.
    pub fn sent(self) -> Style {
        self.style(Color::LightCyan, Color::Rgb(0, 0x60, 0x70), Modifier::ITALIC)
    }

    /// Less important.
    pub fn dim(self) -> Style {
        self.style(Color::DarkGray, Color::Gray, Modifier::DIM)
    }

    /// Names of columns and figures.
    pub fn label(self) -> Style {
        self.style(Color::Gray, Color::DarkGray, Modifier::empty())
    }

    /// Headings.
    pub fn heading() -> Style {
        Style::new().add_modifier(Modifier::BOLD)
    }

    /// The top and bottom line of the screen, and the selection.
    pub fn bar() -> Style {
        Style::new().add_modifier(Modifier::REVERSED)
    }

    /// The style of a byte by the time since its last change, in nanoseconds: it fades.
    pub fn changed(self, age_ns: i64) -> Style {
        match age_ns {
            i64::MIN..300_000_000 => self
                .style(Color::LightYellow, Color::Rgb(0xA0, 0x40, 0), Modifier::REVERSED)
                .add_modifier(Modifier::BOLD),
            300_000_000..1_000_000_000 => {
                self.style(Color::Yellow, Color::Rgb(0xB0, 0x60, 0x20), Modifier::BOLD)
            }
            1_000_000_000..3_000_000_000 => {
                self.style(Color::Rgb(0xA0, 0x90, 0x50), Color::Rgb(0xC0, 0x90, 0x60), Modifier::UNDERLINED)
            }
            _ => Style::new(),
        }
    }

    /// The colour of a curve or a mark: Okabe and Ito's, which everyone can tell apart.
    pub fn series(self, index: usize) -> Style {
        const DARK: [Color; 6] = [
            Color::Rgb(0x56, 0xB4, 0xE9),
            Color::Rgb(0xE6, 0x9F, 0x00),
            Color::Rgb(0x00, 0xC0, 0x90),
            Color::Rgb(0xE0, 0x90, 0xC0),
            Color::Rgb(0xF0, 0xE4, 0x42),
            Color::Rgb(0xE0, 0x70, 0x30),
        ];
        const LIGHT: [Color; 6] = [
            Color::Rgb(0x00, 0x72, 0xB2),
            Color::Rgb(0xD5, 0x5E, 0x00),
            Color::Rgb(0x00, 0x80, 0x60),
            Color::Rgb(0xB0, 0x50, 0x90),
            Color::Rgb(0x80, 0x70, 0x00),
            Color::Rgb(0x40, 0x40, 0x40),
        ];
        self.style(DARK[index % 6], LIGHT[index % 6], Modifier::empty())
    }

    /// How full something is, as a style: green, yellow, red.
    pub fn load(self, per_cent: f64) -> Style {
        match per_cent {
            80.0.. => self.error(),
            50.0.. => self.loss().remove_modifier(Modifier::REVERSED),
            _ => self.style(Color::LightGreen, Color::Rgb(0, 0x70, 0x30), Modifier::empty()),
        }
    }
}
