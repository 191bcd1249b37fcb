//! Computes where everything in a picture goes.

use cantap_trace::counted;

use super::model::{Axis, Content, Curve, PALETTE, Pane, Plot, colour_of};
use super::scale::{self, Range};
use super::scene::{Anchor, Colour, PaneArea, Scene, Shape};
use super::series::Point;

const LEFT: f32 = 84.0;
const RIGHT: f32 = 24.0;
const TITLE_HEIGHT: f32 = 40.0;
const LEGEND_HEIGHT: f32 = 24.0;
const AXIS_HEIGHT: f32 = 48.0;
const ANALOGUE_HEIGHT: f32 = 200.0;
const BARS_HEIGHT: f32 = 320.0;
/// Height of a digital signal's lane: its name, and its line below that.
const LANE_HEIGHT: f32 = 46.0;
const LANE_NAME_HEIGHT: f32 = 18.0;
const PANE_DISTANCE: f32 = 16.0;
/// Text is 13 units high; a DejaVu Sans character is about this fraction of that wide.
const TEXT_SIZE: f32 = 13.0;
const CHARACTER_WIDTH: f32 = TEXT_SIZE * 0.62;

const INK: Colour = Colour([0x22, 0x22, 0x22], 255);
const SOFT_INK: Colour = Colour([0x66, 0x66, 0x66], 255);
const GRID: Colour = Colour([0xDD, 0xDD, 0xDD], 255);
const LOSS: Colour = Colour([0x88, 0x88, 0x88], 90);
const ABOVE: Colour = Colour([0xD0, 0x20, 0x20], 34);
const BELOW: Colour = Colour([0x20, 0x50, 0xD0], 34);

/// Lays the plot out as shapes, `width` units wide.
pub(super) fn lay_out(plot: &Plot, width: u32) -> Scene {
    let mut scene =
        Scene { width: width as f32, height: 0.0, shapes: Vec::new(), panes: Vec::new(), span: plot.span() };
    let mut top = 12.0;
    if !plot.title.is_empty() {
        fitted(
            &mut scene,
            (LEFT, 26.0),
            17.0,
            Anchor::Start,
            INK,
            (&plot.title, width as f32 - LEFT - RIGHT),
        );
        top = TITLE_HEIGHT;
    }
    let mut first_curve = 0;
    for pane in &plot.panes {
        top = lay_out_pane(plot, pane, top, first_curve, &mut scene);
        first_curve += pane.content.curves().len();
    }
    if plot.panes.is_empty() {
        text(&mut scene, (LEFT, top + 20.0), TEXT_SIZE, Anchor::Start, SOFT_INK, "There is nothing to show.");
        top += 24.0;
    }
    lay_out_axis(plot, top - PANE_DISTANCE, &mut scene);
    scene.height = (top - PANE_DISTANCE + AXIS_HEIGHT).ceil();
    scene
}

/// Places a pane and returns where the next one begins.
fn lay_out_pane(plot: &Plot, pane: &Pane, top: f32, first_curve: usize, scene: &mut Scene) -> f32 {
    let top = legend(pane, top, first_curve, scene);
    let height = match &pane.content {
        Content::Analogue(_) => ANALOGUE_HEIGHT,
        Content::Digital(curves) => LANE_HEIGHT * curves.len().max(1) as f32,
        Content::Bars(_) => BARS_HEIGHT,
    };
    let area = PaneArea { left: LEFT, top, right: scene.width - RIGHT, bottom: top + height };
    let places = Places { area, x: scene.span, y: vertical_range(pane) };
    grid(plot, pane, &places, scene);
    match &pane.content {
        Content::Analogue(curves) => {
            for curve in curves {
                alarm_bands(curve, &places, scene);
            }
            for (index, curve) in curves.iter().enumerate() {
                draw_curve(curve, first_curve + index, &places, scene);
            }
        }
        Content::Digital(curves) => {
            for (index, curve) in curves.iter().enumerate() {
                let lane_top = area.top + LANE_HEIGHT * index as f32;
                entry(scene, (LEFT + 8.0, lane_top + LANE_NAME_HEIGHT - 3.0), curve, first_curve + index);
                let lane = lane_area(&area, index);
                let places = Places { area: lane, x: scene.span, y: (0.0, 1.0) };
                draw_curve(curve, first_curve + index, &places, scene);
            }
        }
        Content::Bars(bars) => {
            let [red, green, blue] = PALETTE[0];
            for bar in bars.iter().filter(|bar| bar.count > 0) {
                let (left, right) = (places.x(bar.from), places.x(bar.to));
                let bar_top = places.y(bar.count as f64).min(area.bottom - 1.0);
                let colour = Colour([red, green, blue], 255);
                let width = (right - left - 1.0).max(0.7);
                let height = area.bottom - bar_top;
                scene.shapes.push(Shape::Area { x: left, y: bar_top, width, height, colour });
            }
        }
    }
    for gap in &plot.gaps {
        let (left, right) = (places.x(gap.from), places.x(gap.to));
        let width = (right - left).max(2.0);
        scene.shapes.push(Shape::Area { x: left, y: area.top, width, height, colour: LOSS });
    }
    let corners = [
        (area.left, area.top),
        (area.right, area.top),
        (area.right, area.bottom),
        (area.left, area.bottom),
        (area.left, area.top),
    ];
    line(scene, corners.to_vec(), SOFT_INK, 1.0, false, None);
    scene.panes.push(area);
    area.bottom + PANE_DISTANCE
}

/// Draws names and colours of the pane's curves, in as many rows as they need. Returns where the pane begins.
fn legend(pane: &Pane, top: f32, first_curve: usize, scene: &mut Scene) -> f32 {
    let right = scene.width - RIGHT;
    let mut x = LEFT;
    let mut baseline = top + 16.0;
    if !pane.label.is_empty() {
        let width = pane.label.chars().count() as f32 * CHARACTER_WIDTH;
        if width <= LEFT - 14.0 {
            text(scene, (LEFT - 10.0, baseline), TEXT_SIZE, Anchor::End, SOFT_INK, &pane.label);
        } else {
            // A long unit takes as much space as it needs, followed by the names.
            text(scene, (4.0, baseline), TEXT_SIZE, Anchor::Start, SOFT_INK, &pane.label);
            x = (4.0 + width + 14.0).max(LEFT);
        }
    }
    if matches!(pane.content, Content::Digital(_)) {
        // Each lane has its own name.
        return top + 8.0;
    }
    for (index, curve) in pane.content.curves().iter().enumerate() {
        let needed = 24.0 + curve.name.chars().count() as f32 * CHARACTER_WIDTH + 18.0;
        if x > LEFT && x + needed > right {
            x = LEFT;
            baseline += LEGEND_HEIGHT - 4.0;
        }
        entry(scene, (x, baseline), curve, first_curve + index);
        x += needed;
    }
    baseline + 8.0
}

/// Draws a curve's colour and name.
fn entry(scene: &mut Scene, (x, baseline): (f32, f32), curve: &Curve, number: usize) {
    let colour = Colour(colour_of(curve, number), 255);
    let swatch = vec![(x, baseline - 5.0), (x + 18.0, baseline - 5.0)];
    line(scene, swatch, colour, 3.0, false, Some(number));
    scene.shapes.push(Shape::Text {
        x: x + 24.0,
        y: baseline,
        size: TEXT_SIZE,
        anchor: Anchor::Start,
        colour: INK,
        text: fitting(&curve.name, scene.width - RIGHT - x - 24.0, TEXT_SIZE),
        full: Some(curve.name.clone()),
        curve: Some(number),
    });
}

/// The area of a digital signal's line.
fn lane_area(pane: &PaneArea, lane: usize) -> PaneArea {
    let top = pane.top + LANE_HEIGHT * lane as f32;
    PaneArea { top: top + LANE_NAME_HEIGHT + 3.0, bottom: top + LANE_HEIGHT - 5.0, ..*pane }
}

/// Maps values to positions in a pane.
struct Places {
    area: PaneArea,
    x: (f64, f64),
    y: (f64, f64),
}

impl Places {
    fn x(&self, value: f64) -> f32 {
        let share = ((value - self.x.0) / (self.x.1 - self.x.0)).clamp(0.0, 1.0) as f32;
        self.area.left + share * (self.area.right - self.area.left)
    }

    fn y(&self, value: f64) -> f32 {
        self.beyond_y(value).clamp(self.area.top, self.area.bottom)
    }

    /// The same, also outside the pane.
    fn beyond_y(&self, value: f64) -> f32 {
        /// Farther out, positions would lose their precision.
        const FAR: f64 = 100.0;
        let share = ((value - self.y.0) / (self.y.1 - self.y.0)).clamp(-FAR, FAR) as f32;
        self.area.bottom - share * (self.area.bottom - self.area.top)
    }

    /// The stretches of a line that are inside the pane: what is beyond its range is cut off, not drawn along its edge.
    fn clipped(&self, corners: &[(f32, f32)]) -> Vec<Vec<(f32, f32)>> {
        let (top, bottom) = (self.area.top, self.area.bottom);
        let mut stretches: Vec<Vec<(f32, f32)>> = Vec::new();
        if let [(x, y)] = corners {
            return if (top..=bottom).contains(y) { vec![vec![(*x, *y)]] } else { Vec::new() };
        }
        let mut goes_on = false;
        for pair in corners.windows(2) {
            let ((x0, y0), (x1, y1)) = (pair[0], pair[1]);
            // Which part of this piece, from 0 to 1, is inside.
            let (mut from, mut to) = (0.0_f32, 1.0_f32);
            let delta = y1 - y0;
            if delta == 0.0 {
                if !(top..=bottom).contains(&y0) {
                    goes_on = false;
                    continue;
                }
            } else {
                let (at_top, at_bottom) = ((top - y0) / delta, (bottom - y0) / delta);
                from = from.max(at_top.min(at_bottom));
                to = to.min(at_top.max(at_bottom));
            }
            if from > to {
                goes_on = false;
                continue;
            }
            let place = |part: f32| (x0 + part * (x1 - x0), (y0 + part * delta).clamp(top, bottom));
            match stretches.last_mut() {
                Some(stretch) if goes_on => stretch.push(place(to)),
                _ => stretches.push(vec![place(from), place(to)]),
            }
            goes_on = to >= 1.0;
        }
        stretches
    }
}

/// The range of values that a pane's height shows.
pub(super) fn vertical_range(pane: &Pane) -> (f64, f64) {
    if let Some(range) = pane.range {
        return range;
    }
    let mut range = Range::default();
    match &pane.content {
        Content::Digital(_) => return (0.0, 1.0),
        Content::Bars(bars) => {
            let most = bars.iter().map(|bar| bar.count).max().unwrap_or(1).max(1);
            return (0.0, most as f64 * 1.06);
        }
        Content::Analogue(curves) => {
            for curve in curves {
                for point in curve.series.points() {
                    range.include(point.y);
                }
            }
            // An alarm limit near the curve belongs in the picture; a distant one would flatten the curve.
            let (low, high) = range.or_unit();
            let near = (high - low) * 0.5;
            let limits = curves.iter().flat_map(|curve| [curve.alarm_below, curve.alarm_above]).flatten();
            for limit in limits.filter(|limit| (low - near..=high + near).contains(limit)) {
                range.include(limit);
            }
        }
    }
    scale::with_margin(range.or_unit())
}

fn horizontal_ticks(plot: &Plot, scene_span: (f64, f64), wanted: usize) -> (Vec<f64>, f64) {
    match plot.axis {
        Axis::Time { .. } => scale::time_ticks(scene_span, wanted),
        Axis::Value { .. } => scale::ticks(scene_span, wanted),
    }
}

fn wanted_ticks(scene: &Scene) -> usize {
    ((scene.width - LEFT - RIGHT) / 110.0) as usize
}

fn grid(plot: &Plot, pane: &Pane, places: &Places, scene: &mut Scene) {
    let area = places.area;
    for tick in horizontal_ticks(plot, scene.span, wanted_ticks(scene)).0 {
        let x = places.x(tick);
        line(scene, vec![(x, area.top), (x, area.bottom)], GRID, 1.0, false, None);
    }
    if let Content::Digital(curves) = &pane.content {
        for lane in 1..curves.len() {
            let y = area.top + LANE_HEIGHT * lane as f32;
            line(scene, vec![(area.left, y), (area.right, y)], GRID, 1.0, false, None);
        }
        for (lane, curve) in curves.iter().enumerate() {
            let PaneArea { left, top, bottom, .. } = lane_area(&area, lane);
            let named = |value: f64, otherwise: &str| {
                let texts = &curve.texts;
                let found =
                    texts.iter().find(|(of, _)| (of - value).abs() < 1e-9).map(|(_, text)| text.as_str());
                found.unwrap_or(otherwise).to_owned()
            };
            for (y, label) in [(top, named(1.0, "1")), (bottom, named(0.0, "0"))] {
                fitted(scene, (left - 8.0, y + 4.0), 11.0, Anchor::End, SOFT_INK, (&label, left - 12.0));
            }
        }
        return;
    }
    for (tick, label) in pane.ticks(places.y, 5) {
        let y = places.y(tick);
        line(scene, vec![(area.left, y), (area.right, y)], GRID, 1.0, false, None);
        let room = (&label[..], area.left - 12.0);
        fitted(scene, (area.left - 8.0, y + 4.5), TEXT_SIZE, Anchor::End, SOFT_INK, room);
    }
}

fn alarm_bands(curve: &Curve, places: &Places, scene: &mut Scene) {
    let area = places.area;
    let mut band = |top: f32, bottom: f32, edge: f32, colour: Colour| {
        let width = area.right - area.left;
        if bottom > top {
            scene.shapes.push(Shape::Area { x: area.left, y: top, width, height: bottom - top, colour });
        }
        let edge_colour = Colour(colour.0, 200);
        line(scene, vec![(area.left, edge), (area.right, edge)], edge_colour, 1.0, true, None);
    };
    let shown = |limit: &f64| (places.y.0..=places.y.1).contains(limit);
    if let Some(limit) = curve.alarm_above.filter(shown) {
        band(area.top, places.y(limit), places.y(limit), ABOVE);
    }
    if let Some(limit) = curve.alarm_below.filter(shown) {
        band(places.y(limit), area.bottom, places.y(limit), BELOW);
    }
}

fn draw_curve(curve: &Curve, number: usize, places: &Places, scene: &mut Scene) {
    let colour = Colour(colour_of(curve, number), 255);
    let points = curve.series.points();
    for stretch in points.split(|point| point.y.is_nan()).filter(|stretch| !stretch.is_empty()) {
        for stretch in places.clipped(&outline(stretch, curve.stepped, places)) {
            if let [(x, y)] = stretch[..] {
                scene.shapes.push(Shape::Dot { x, y, radius: 2.5, colour, curve: Some(number) });
            } else {
                line(scene, stretch, colour, 1.6, false, Some(number));
            }
        }
    }
}

/// The line's corners. If many points share a column of half a unit, only first, last and extremes are drawn.
fn outline(points: &[Point], stepped: bool, places: &Places) -> Vec<(f32, f32)> {
    let mut out: Vec<(f32, f32)> = Vec::with_capacity(points.len().min(16_384));
    let corner = |out: &mut Vec<(f32, f32)>, next: (f32, f32)| {
        if stepped && let Some((_, y)) = out.last().copied() {
            out.push((next.0, y));
        }
        out.push(next);
    };
    let column = |point: &Point| (places.x(point.x) * 2.0) as i32;
    for column in points.chunk_by(|a, b| column(a) == column(b)) {
        let place = |point: &Point| (places.x(point.x), places.beyond_y(point.y));
        if column.len() <= 4 {
            for point in column {
                corner(&mut out, place(point));
            }
            continue;
        }
        let by_y = |a: &&Point, b: &&Point| a.y.total_cmp(&b.y);
        let ends = [column.first(), column.iter().min_by(by_y), column.iter().max_by(by_y), column.last()];
        for point in ends.into_iter().flatten() {
            corner(&mut out, place(point));
        }
    }
    out
}

fn lay_out_axis(plot: &Plot, top: f32, scene: &mut Scene) {
    let area = PaneArea { left: LEFT, top, right: scene.width - RIGHT, bottom: top };
    let places = Places { area, x: scene.span, y: (0.0, 1.0) };
    let (ticks, step) = horizontal_ticks(plot, scene.span, wanted_ticks(scene));
    let span = scene.span.1 - scene.span.0;
    for tick in ticks {
        let label = match plot.axis {
            Axis::Time { .. } => scale::time_label(tick, step, span),
            Axis::Value { .. } => scale::label(tick, step),
        };
        text(scene, (places.x(tick), top + 18.0), TEXT_SIZE, Anchor::Middle, SOFT_INK, &label);
    }
    let label = axis_label(plot, span);
    let middle = f32::midpoint(area.left, area.right);
    let lost: u64 = plot.gaps.iter().map(|gap| gap.frames).sum();
    let note = format!("{} lost here", counted(lost, "frame"));
    let note_width = note.chars().count() as f32 * CHARACTER_WIDTH + 18.0;
    // Both are in one line, the label in its middle.
    let room = if plot.gaps.is_empty() {
        area.right - area.left
    } else {
        area.right - area.left - 2.0 * (note_width + 8.0)
    };
    fitted(scene, (middle, top + 38.0), TEXT_SIZE, Anchor::Middle, SOFT_INK, (&label, room.max(80.0)));
    if !plot.gaps.is_empty() {
        let x = area.right - note_width;
        scene.shapes.push(Shape::Area { x, y: top + 28.0, width: 12.0, height: 12.0, colour: LOSS });
        text(scene, (x + 18.0, top + 38.0), TEXT_SIZE, Anchor::Start, SOFT_INK, &note);
    }
}

/// The text, truncated if it would be wider than this many units.
fn fitting(text: &str, width: f32, size: f32) -> String {
    let most = (width / (size * 0.62)) as usize;
    if text.chars().count() <= most {
        return text.to_owned();
    }
    text.chars().take(most.saturating_sub(1)).chain(['…']).collect()
}

/// The label of the horizontal axis.
pub(super) fn axis_label(plot: &Plot, span: f64) -> String {
    match &plot.axis {
        Axis::Value { label } => label.clone(),
        Axis::Time { zero } => {
            let unit = match span {
                ..300.0 => "time in s",
                ..3600.0 => "time in min:s",
                _ => "time in h:min:s",
            };
            if zero.is_empty() { unit.to_owned() } else { format!("{unit} since {zero}") }
        }
    }
}

fn line(
    scene: &mut Scene,
    points: Vec<(f32, f32)>,
    colour: Colour,
    width: f32,
    dashed: bool,
    curve: Option<usize>,
) {
    scene.shapes.push(Shape::Line { points, colour, width, dashed, curve });
}

fn text(scene: &mut Scene, (x, y): (f32, f32), size: f32, anchor: Anchor, colour: Colour, text: &str) {
    let (text, full) = (text.to_owned(), None);
    scene.shapes.push(Shape::Text { x, y, size, anchor, colour, text, full, curve: None });
}

/// A text that must not be wider than so many units: what does not fit is cut off, and the whole of it is there for whoever points at it.
fn fitted(
    scene: &mut Scene,
    (x, y): (f32, f32),
    size: f32,
    anchor: Anchor,
    colour: Colour,
    (whole, width): (&str, f32),
) {
    let (text, full) = (fitting(whole, width, size), Some(whole.to_owned()));
    scene.shapes.push(Shape::Text { x, y, size, anchor, colour, text, full, curve: None });
}
