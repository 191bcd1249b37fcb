//! A picture made of characters, for terminals: braille dots for curves, blocks for bars; plain ASCII if the
//! terminal has nothing else.

use std::fmt::Write as _;

use cantap_trace::counted;

use super::layout::{axis_label, vertical_range};
use super::model::{Axis, Content, Curve, Gap, Pane, Plot, colour_of};
use super::scale;

/// How to draw.
#[derive(Clone, Copy, Debug)]
pub struct TextStyle {
    /// Columns to use.
    pub width: usize,
    /// Rows of each pane with curves or bars.
    pub pane_height: usize,
    /// Colours by ANSI sequences.
    pub colour: bool,
    /// Use braille and block characters; otherwise ASCII.
    pub unicode: bool,
}

impl Default for TextStyle {
    /// Eighty columns, without colour, with braille.
    fn default() -> Self {
        Self { width: 80, pane_height: 12, colour: false, unicode: true }
    }
}

/// Columns for the vertical axis.
const AXIS_WIDTH: usize = 10;
const RESET: &str = "\x1b[0m";

/// Draws everything.
pub(super) fn draw(plot: &Plot, style: &TextStyle) -> String {
    let mut out = String::new();
    let style = TextStyle {
        width: style.width.clamp(AXIS_WIDTH + 20, 1000),
        pane_height: style.pane_height.clamp(3, 200),
        ..*style
    };
    if !plot.title.is_empty() {
        out.push_str(&plot.title);
        out.push('\n');
    }
    let span = plot.span();
    let mut first_curve = 0;
    for pane in &plot.panes {
        legend(pane, first_curve, &style, &mut out);
        match &pane.content {
            Content::Digital(curves) => lanes(curves, first_curve, span, &plot.gaps, &style, &mut out),
            Content::Analogue(curves) => {
                let mut canvas = Canvas::new(&style, span, vertical_range(pane));
                for (index, curve) in curves.iter().enumerate() {
                    canvas.curve(curve, colour_of(curve, first_curve + index));
                }
                canvas.gaps(&plot.gaps);
                canvas.write(pane, &style, &mut out);
            }
            Content::Bars(bars) => {
                let mut canvas = Canvas::new(&style, span, vertical_range(pane));
                for bar in bars {
                    canvas.bar(bar.from, bar.to, bar.count as f64);
                }
                canvas.write(pane, &style, &mut out);
            }
        }
        first_curve += pane.content.curves().len();
    }
    if plot.panes.is_empty() {
        out.push_str("There is nothing to show.\n");
        return out;
    }
    axis(plot, span, &style, &mut out);
    out
}

fn legend(pane: &Pane, first_curve: usize, style: &TextStyle, out: &mut String) {
    let mark = if style.unicode { "━━" } else { "--" };
    let label = &pane.label;
    let _ = write!(out, "{label:>width$} ", width = AXIS_WIDTH - 1);
    let mut used = AXIS_WIDTH.max(label.chars().count() + 1);
    for (index, curve) in pane.content.curves().iter().enumerate() {
        let needed = curve.name.chars().count() + 5;
        if used > AXIS_WIDTH && used + needed > style.width {
            let _ = write!(out, "\n{:AXIS_WIDTH$}", "");
            used = AXIS_WIDTH;
        }
        used += needed;
        coloured(out, style, colour_of(curve, first_curve + index), mark);
        let _ = write!(out, " {}  ", curve.name);
    }
    while out.ends_with(' ') {
        out.pop();
    }
    out.push('\n');
}

fn coloured(out: &mut String, style: &TextStyle, [red, green, blue]: [u8; 3], text: &str) {
    if style.colour {
        let _ = write!(out, "\x1b[38;2;{red};{green};{blue}m{text}{RESET}");
    } else {
        out.push_str(text);
    }
}

/// Cells of two by four dots.
struct Canvas {
    columns: usize,
    rows: usize,
    /// Braille dots, one bit each, as in Unicode's braille block.
    dots: Vec<u8>,
    colours: Vec<Option<[u8; 3]>>,
    /// Eighths of a cell that a bar fills.
    fills: Vec<u8>,
    lost: Vec<bool>,
    x: (f64, f64),
    y: (f64, f64),
}

impl Canvas {
    fn new(style: &TextStyle, x: (f64, f64), y: (f64, f64)) -> Self {
        let (columns, rows) = (style.width - AXIS_WIDTH, style.pane_height);
        Self {
            columns,
            rows,
            dots: vec![0; columns * rows],
            colours: vec![None; columns * rows],
            fills: vec![0; columns * rows],
            lost: vec![false; columns],
            x,
            y,
        }
    }

    fn dot_x(&self, value: f64) -> i64 {
        let last = (self.columns * 2 - 1) as f64;
        (((value - self.x.0) / (self.x.1 - self.x.0)).clamp(0.0, 1.0) * last).round() as i64
    }

    fn dot_y(&self, value: f64) -> i64 {
        let last = (self.rows * 4 - 1) as f64;
        ((1.0 - ((value - self.y.0) / (self.y.1 - self.y.0)).clamp(0.0, 1.0)) * last).round() as i64
    }

    /// The same, also outside the canvas.
    fn beyond_y(&self, value: f64) -> i64 {
        const FAR: f64 = 100.0;
        let last = (self.rows * 4 - 1) as f64;
        ((1.0 - ((value - self.y.0) / (self.y.1 - self.y.0)).clamp(-FAR, FAR)) * last).round() as i64
    }

    /// Does nothing outside the canvas: what is beyond the range is not drawn along its edge.
    fn set(&mut self, x: i64, y: i64, colour: [u8; 3]) {
        const DOTS: [[u8; 2]; 4] = [[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]];
        let Ok(y) = usize::try_from(y) else { return };
        let x = x as usize;
        if y >= self.rows * 4 {
            return;
        }
        let cell = y / 4 * self.columns + x / 2;
        self.dots[cell] |= DOTS[y % 4][x % 2];
        self.colours[cell] = Some(colour);
    }

    fn line(&mut self, (x0, y0): (i64, i64), (x1, y1): (i64, i64), colour: [u8; 3]) {
        let steps = (x1 - x0).abs().max((y1 - y0).abs()).max(1);
        for step in 0..=steps {
            // Rounded to the nearest dot.
            let part = |a: i64, b: i64| a + ((b - a) * step * 2 + steps * (b - a).signum()) / (steps * 2);
            self.set(part(x0, x1), part(y0, y1), colour);
        }
    }

    fn curve(&mut self, curve: &Curve, colour: [u8; 3]) {
        let mut before: Option<(i64, i64)> = None;
        for point in curve.series.points() {
            if point.y.is_nan() {
                before = None;
                continue;
            }
            let place = (self.dot_x(point.x), self.beyond_y(point.y));
            match before {
                Some(from) if curve.stepped => {
                    self.line(from, (place.0, from.1), colour);
                    self.line((place.0, from.1), place, colour);
                }
                Some(from) => self.line(from, place, colour),
                None => self.set(place.0, place.1, colour),
            }
            before = Some(place);
        }
    }

    fn bar(&mut self, from: f64, to: f64, height: f64) {
        let column = |value: f64| ((value - self.x.0) / (self.x.1 - self.x.0) * self.columns as f64) as usize;
        let (first, end) = (column(from), column(to).max(column(from) + 1).min(self.columns));
        let mut eighths = (height / self.y.1 * (self.rows * 8) as f64).round() as usize;
        if height > 0.0 {
            eighths = eighths.max(1);
        }
        for row in (0..self.rows).rev() {
            let fill = eighths.min(8);
            for column in first.min(self.columns)..end {
                let cell = &mut self.fills[row * self.columns + column];
                *cell = (*cell).max(fill as u8);
            }
            eighths -= fill;
        }
    }

    fn gaps(&mut self, gaps: &[Gap]) {
        for gap in gaps {
            let (first, last) = (self.dot_x(gap.from) / 2, self.dot_x(gap.to) / 2);
            self.lost[first as usize..=last as usize].fill(true);
        }
    }

    fn write(&self, pane: &Pane, style: &TextStyle, out: &mut String) {
        let mut labels = vec![String::new(); self.rows];
        for (tick, label) in pane.ticks(self.y, (self.rows / 3).max(1)) {
            labels[(self.dot_y(tick) / 4) as usize] = label.chars().take(AXIS_WIDTH - 1).collect();
        }
        let border = if style.unicode { ['│', '┤'] } else { ['|', '+'] };
        for (row, label) in labels.iter().enumerate() {
            let edge = border[usize::from(!label.is_empty())];
            let _ = write!(out, "{label:>width$}{edge}", width = AXIS_WIDTH - 1);
            let mut line = String::new();
            for column in 0..self.columns {
                let cell = row * self.columns + column;
                let symbol = self.symbol(cell, column, style.unicode);
                match self.colours[cell] {
                    Some(colour) if style.colour => coloured(&mut line, style, colour, &symbol.to_string()),
                    _ => line.push(symbol),
                }
            }
            out.push_str(line.trim_end());
            out.push('\n');
        }
    }

    fn symbol(&self, cell: usize, column: usize, unicode: bool) -> char {
        match (self.dots[cell], self.fills[cell]) {
            (0, 0) if self.lost[column] => lost_mark(unicode),
            (0, 0) => ' ',
            (0, eighths) if unicode => [' ', '▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'][usize::from(eighths)],
            (0, eighths) => {
                if eighths > 4 {
                    '#'
                } else {
                    '.'
                }
            }
            (dots, _) if unicode => char::from_u32(0x2800 + u32::from(dots)).unwrap_or('*'),
            _ => '*',
        }
    }
}

fn lost_mark(unicode: bool) -> char {
    if unicode { '░' } else { ':' }
}

/// Digital signals, one row each: high, low, or both in one column.
fn lanes(
    curves: &[Curve],
    first_curve: usize,
    span: (f64, f64),
    gaps: &[Gap],
    style: &TextStyle,
    out: &mut String,
) {
    let columns = style.width - AXIS_WIDTH;
    let column =
        |x: f64| (((x - span.0) / (span.1 - span.0)).clamp(0.0, 1.0) * (columns - 1) as f64) as usize;
    for (index, curve) in curves.iter().enumerate() {
        // Bit 0: low in this column; bit 1: high.
        let mut seen = vec![0u8; columns];
        let mut before: Option<(usize, u8)> = None;
        for point in curve.series.points() {
            let place = column(point.x);
            if let Some((from, level)) = before {
                seen[from..=place].iter_mut().for_each(|cell| *cell |= level);
            }
            before = (!point.y.is_nan()).then_some((place, if point.y >= 0.5 { 2 } else { 1 }));
            if let Some((_, level)) = before {
                seen[place] |= level;
            }
        }
        let symbols = if style.unicode { [' ', '▁', '▔', '█'] } else { [' ', '_', '-', '#'] };
        let mut line: String = seen.iter().map(|level| symbols[usize::from(*level)]).collect();
        let mut cells: Vec<char> = line.chars().collect();
        for gap in gaps {
            for cell in &mut cells[column(gap.from)..=column(gap.to)] {
                if *cell == ' ' {
                    *cell = lost_mark(style.unicode);
                }
            }
        }
        line = cells.into_iter().collect();
        let name: String = curve.name.chars().take(AXIS_WIDTH - 1).collect();
        let edge = if style.unicode { '│' } else { '|' };
        let _ = write!(out, "{name:>width$}{edge}", width = AXIS_WIDTH - 1);
        coloured(out, style, colour_of(curve, first_curve + index), line.trim_end());
        out.push('\n');
    }
}

fn axis(plot: &Plot, span: (f64, f64), style: &TextStyle, out: &mut String) {
    let columns = style.width - AXIS_WIDTH;
    let (ticks, step) = match plot.axis {
        Axis::Time { .. } => scale::time_ticks(span, columns / 14),
        Axis::Value { .. } => scale::ticks(span, columns / 14),
    };
    let (corner, dash, tick_mark) = if style.unicode { ('└', '─', '┬') } else { ('+', '-', '+') };
    let mut rule = vec![dash; columns];
    let mut labels = vec![' '; style.width];
    let mut free_from = 0;
    for tick in ticks {
        let place = ((tick - span.0) / (span.1 - span.0)).clamp(0.0, 1.0) * (columns - 1) as f64;
        let column = place.round() as usize;
        rule[column] = tick_mark;
        let label = match plot.axis {
            Axis::Time { .. } => scale::time_label(tick, step, span.1 - span.0),
            Axis::Value { .. } => scale::label(tick, step),
        };
        let length = label.chars().count();
        let start = (AXIS_WIDTH + column).saturating_sub(length / 2).min(style.width.saturating_sub(length));
        if start >= free_from && start + length <= style.width {
            labels.splice(start..start + length, label.chars());
            free_from = start + length + 1;
        }
    }
    let _ = write!(out, "{corner:>AXIS_WIDTH$}");
    out.extend(rule);
    let labels: String = labels.into_iter().collect();
    let _ = write!(out, "\n{}\n", labels.trim_end());
    let label = axis_label(plot, span.1 - span.0);
    let padding = AXIS_WIDTH + columns.saturating_sub(label.chars().count()) / 2;
    let _ = writeln!(out, "{:padding$}{label}", "");
    if !plot.gaps.is_empty() {
        let lost: u64 = plot.gaps.iter().map(|gap| gap.frames).sum();
        let _ =
            writeln!(out, "{:AXIS_WIDTH$}{} {} lost", "", lost_mark(style.unicode), counted(lost, "frame"));
    }
}
