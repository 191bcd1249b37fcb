// Draws one panel: shaded gaps, the grid, lines or lanes, cursors. It knows nothing of elements or of the engine.

import type { Gap, Series } from '../api';
import type { Range } from '../model/app';
import type { Style } from '../model/panels';
import type { Pen } from './pen';
import { type Scale, tickText, tickTexts, ticks, toPixel } from './scale';
import { columnAt } from './series-cache';

export interface Colours {
  background: string;
  grid: string;
  axis: string;
  text: string;
  gap: string;
  alarmAbove: string;
  alarmBelow: string;
  cursorA: string;
  cursorB: string;
  hover: string;
  lane: string;
  lines: string[];
}

export interface Trace {
  label: string;
  unit: string;
  colour: string;
  series: Series | null;
  texts: { value: number; text: string }[];
  /** Limits of the database; a dotted line where they are in sight. */
  limits: number[];
  /** Where values are an alarm: shaded above and below. */
  alarms: { min: number | null; max: number | null } | null;
}

export interface Sheet {
  width: number;
  height: number;
  range: Range;
  traces: Trace[];
  style: Style;
  gaps: Gap[];
  cursorA: number | null;
  cursorB: number | null;
  hover: number | null;
  /** Stretch that is being dragged over. */
  zoomBox: Range | null;
  notes: { time: number }[];
  colours: Colours;
}

/** Left margin with the numbers of the axis. */
export const MARGIN = 66;
const TOP = 6;
const BOTTOM = 4;

export function timeScale(range: Range, width: number): Scale {
  return { from: range.from, to: range.to, start: MARGIN, end: width - 4 };
}

/** Whether a panel is drawn as lanes: each of its signals has texts for its values. */
export function isDigital(traces: readonly Trace[]): boolean {
  return traces.length > 0 && traces.every((t) => t.texts.length > 0);
}

export function drawPanel(pen: Pen, sheet: Sheet): void {
  const { width, height, colours } = sheet;
  const x = timeScale(sheet.range, width);
  pen.rect(0, 0, width, height, colours.background);
  pen.clipped(MARGIN, 0, x.end - x.start, height, () => {
    drawGaps(pen, sheet, x);
    for (const tick of ticks(sheet.range.from, sheet.range.to, (x.end - x.start) / 110).values) vertical(pen, toPixel(x, tick), height, colours.grid);
  });
  if (isDigital(sheet.traces)) drawLanes(pen, sheet, x);
  else drawLines(pen, sheet, x);
  pen.line([MARGIN - 0.5, 0, MARGIN - 0.5, height], colours.axis, 1);
  pen.clipped(MARGIN, 0, x.end - x.start, height, () => {
    for (const note of sheet.notes) vertical(pen, toPixel(x, note.time), height, colours.hover, [1, 3]);
    if (sheet.hover !== null) vertical(pen, toPixel(x, sheet.hover), height, colours.hover);
    if (sheet.cursorA !== null) vertical(pen, toPixel(x, sheet.cursorA), height, colours.cursorA, [], 1.5);
    if (sheet.cursorB !== null) vertical(pen, toPixel(x, sheet.cursorB), height, colours.cursorB, [], 1.5);
    if (sheet.zoomBox) {
      const left = toPixel(x, sheet.zoomBox.from);
      pen.rect(left, 0, toPixel(x, sheet.zoomBox.to) - left, height, colours.lane);
    }
  });
}

function vertical(pen: Pen, at: number, height: number, colour: string, dash: number[] = [], width = 1): void {
  const snapped = Math.round(at) + 0.5;
  pen.line([snapped, 0, snapped, height], colour, width, dash);
}

function drawGaps(pen: Pen, sheet: Sheet, x: Scale): void {
  for (const gap of sheet.gaps) {
    if (gap.to < sheet.range.from || gap.from > sheet.range.to) continue;
    const left = Math.max(x.start, toPixel(x, gap.from));
    const right = Math.min(x.end, toPixel(x, gap.to));
    pen.rect(left, 0, Math.max(2, right - left), sheet.height, sheet.colours.gap);
  }
}

/** Smallest and largest value in sight, of all lines of a panel; null if there is none. */
export function valueRange(traces: readonly Trace[], range: Range): Range | null {
  let from = Infinity;
  let to = -Infinity;
  for (const { series } of traces) {
    if (!series) continue;
    const [first, last] = columnsInSight(series, range);
    for (let i = first; i < last; i++) {
      const low = series.min[i] as number;
      const high = series.max[i] as number;
      if (low < from) from = low;
      if (high > to) to = high;
    }
  }
  if (!Number.isFinite(from) || !Number.isFinite(to)) return null;
  const pad = from === to ? Math.max(Math.abs(from) * 0.1, 0.5) : (to - from) * 0.06;
  return { from: from - pad, to: to + pad };
}

/** The columns that a stretch needs: one more on either side, so that lines reach the edges. */
function columnsInSight(series: Series, range: Range): [number, number] {
  const first = Math.max(0, columnAt(series, range.from) - 1);
  let last = columnAt(series, range.to);
  last = Math.min(series.time.length, last + 2);
  return [first, last];
}

/** What is above and below the limits of a signal's alarms. */
function drawAlarms(pen: Pen, trace: Trace, x: Scale, y: Scale, { colours }: Sheet): void {
  const { min, max } = trace.alarms ?? { min: null, max: null };
  const at = (value: number): number => Math.min(y.start, Math.max(y.end, toPixel(y, value)));
  if (max !== null && max < y.to) pen.rect(x.start, y.end, x.end - x.start, at(max) - y.end, colours.alarmAbove);
  if (min !== null && min > y.from) pen.rect(x.start, at(min), x.end - x.start, y.start - at(min), colours.alarmBelow);
}

/** Width of an axis that stands within the picture, at its right edge. */
const INNER_AXIS = 54;

/** Signals of one unit share a scale; the first unit's axis stands on the left, others at the right edge in their signal's colour. */
function drawLines(pen: Pen, sheet: Sheet, x: Scale): void {
  const units = [...new Set(sheet.traces.map((t) => t.unit))];
  let shown = 0;
  for (const unit of units) {
    const traces = sheet.traces.filter((t) => t.unit === unit);
    const values = valueRange(traces, sheet.range);
    if (!values) continue;
    const y: Scale = { ...values, start: sheet.height - BOTTOM, end: TOP };
    drawValueAxis(pen, sheet, x, y, unit, shown, traces[0]?.colour ?? sheet.colours.text);
    pen.clipped(x.start, 0, x.end - x.start, sheet.height, () => {
      for (const trace of traces) drawAlarms(pen, trace, x, y, sheet);
      for (const trace of traces) {
        for (const limit of trace.limits) {
          if (limit > values.from && limit < values.to) pen.line([x.start, toPixel(y, limit), x.end, toPixel(y, limit)], trace.colour, 1, [2, 5]);
        }
        if (trace.series) drawSeries(pen, trace.series, trace.colour, sheet, x, y);
      }
    });
    shown++;
  }
  if (shown === 0) pen.text('no value in sight', (x.start + x.end) / 2, sheet.height / 2, { colour: sheet.colours.text, align: 'center' });
}

function drawValueAxis(pen: Pen, sheet: Sheet, x: Scale, y: Scale, unit: string, number: number, own: string): void {
  const { colours } = sheet;
  const marks = ticks(y.from, y.to, Math.max(2, sheet.height / 34));
  const right = number === 0 ? MARGIN - 6 : x.end - 4 - (number - 1) * INNER_AXIS;
  const colour = number === 0 ? colours.text : own;
  const texts = tickTexts(marks);
  for (const [i, tick] of marks.values.entries()) {
    const at = Math.round(toPixel(y, tick)) + 0.5;
    if (number === 0) pen.line([x.start, at, x.end, at], colours.grid, 1);
    if (at > 18) pen.text(texts[i] ?? '', right, at, { colour, align: 'right', size: 10 });
  }
  if (unit) pen.text(unit, right, 8, { colour, align: 'right', size: 10, maxWidth: INNER_AXIS });
}

function drawSeries(pen: Pen, series: Series, colour: string, sheet: Sheet, x: Scale, y: Scale): void {
  const [first, last] = columnsInSight(series, sheet.range);
  const xs = (x.end - x.start) / (x.to - x.from);
  const ys = (y.end - y.start) / (y.to - y.from);
  const px = (t: number): number => x.start + (t - x.from) * xs;
  const py = (v: number): number => y.start + (v - y.from) * ys;
  const points: number[] = [];
  if (sheet.style === 'points') {
    for (let i = first; i < last; i++) {
      const low = series.min[i] as number;
      const high = series.max[i] as number;
      points.push(px(series.time[i] as number), py(low));
      if (high !== low) points.push(px(series.time[i] as number), py(high));
    }
    pen.dots(points, colour, 3);
    return;
  }
  if (!series.exact && last - first > (x.end - x.start) / 2) {
    drawDense(pen, series, colour, sheet.style, [first, last], px, py);
    return;
  }
  let previous = NaN;
  for (let i = first; i < last; i++) {
    const at = px(series.time[i] as number);
    const entry = py(series.first[i] as number);
    if (sheet.style === 'step' && !Number.isNaN(previous)) points.push(at, previous);
    points.push(at, entry);
    const low = series.min[i] as number;
    const high = series.max[i] as number;
    const exit = py(series.last[i] as number);
    if (low !== high) points.push(at, py(low), at, py(high));
    if (exit !== entry || low !== high) points.push(Math.max(at, px(series.end[i] as number)), exit);
    previous = exit;
  }
  // The last value holds until the next one, which is not there: to the trace's end it is drawn only as far as it is known.
  pen.line(points, colour, 1);
  // Few values are shown one by one, so that it is seen where frames are.
  if (series.exact && last - first < (x.end - x.start) / 12) {
    const dots: number[] = [];
    for (let i = first; i < last; i++) dots.push(px(series.time[i] as number), py(series.last[i] as number));
    pen.dots(dots, colour, 4);
  }
}

/** Pixels between two columns from which on there is a line between them. */
const APART = 1.5;

/** Columns about as near as pixels: each is a bar from its smallest to its largest value, and reaches the one before. */
function drawDense(pen: Pen, series: Series, colour: string, style: Style, [first, last]: [number, number], px: (time: number) => number, py: (value: number) => number): void {
  const bars: number[] = [];
  const lines: number[] = [];
  let [at, exit] = [NaN, NaN];
  for (let i = first; i < last; i++) {
    const here = px(series.time[i] as number);
    const entry = py(series.first[i] as number);
    let top = py(series.max[i] as number);
    let bottom = py(series.min[i] as number);
    const isApart = here - at > APART;
    if (isApart) lines.push(at, exit, here, style === 'step' ? exit : entry, NaN, NaN);
    if (i > first && (style === 'step' || !isApart)) {
      top = Math.min(top, exit);
      bottom = Math.max(bottom, exit);
    }
    // A value that stays is a pixel high.
    const flat = Math.max(0, 1 - (bottom - top)) / 2;
    bars.push(here, top - flat, bottom + flat);
    at = Math.max(here, px(series.end[i] as number));
    exit = py(series.last[i] as number);
  }
  pen.bars(bars, colour);
  pen.line(lines, colour, 1);
}

function drawLanes(pen: Pen, sheet: Sheet, x: Scale): void {
  const { colours } = sheet;
  const lane = (sheet.height - 4) / sheet.traces.length;
  for (const [number, trace] of sheet.traces.entries()) {
    const top = 2 + number * lane;
    const height = Math.min(26, lane - 6);
    const y = top + (lane - height) / 2;
    pen.text(trace.label.slice(trace.label.lastIndexOf('.') + 1), MARGIN - 6, y + height / 2, { colour: colours.text, align: 'right', size: 10, maxWidth: MARGIN - 8 });
    const series = trace.series;
    if (!series) continue;
    const name = (value: number): string => trace.texts.find((t) => t.value === value)?.text ?? String(value);
    const [first, last] = columnsInSight(series, sheet.range);
    pen.clipped(x.start, 0, x.end - x.start, sheet.height, () => {
      let i = first;
      while (i < last) {
        const value = series.last[i] as number;
        const mixed = series.min[i] !== series.max[i];
        let j = i + 1;
        // One box for as long as the value holds; one hatched box for columns within which it changes.
        while (j < last && (mixed ? series.min[j] !== series.max[j] : series.min[j] === value && series.max[j] === value)) j++;
        const left = Math.max(x.start, toPixel(x, series.time[i] as number));
        const endTime = j < series.time.length ? (series.time[j] as number) : (series.end[j - 1] as number);
        const right = Math.min(x.end, toPixel(x, endTime));
        if (right >= left) drawBox(pen, left, y, Math.max(1, right - left), height, mixed ? null : name(value), trace.colour, colours);
        i = j;
      }
    });
  }
}

function drawBox(pen: Pen, left: number, y: number, width: number, height: number, text: string | null, colour: string, colours: Colours): void {
  pen.rect(left, y, width, height, colours.lane);
  if (text === null) {
    const lines: number[] = [];
    for (let at = left; at < left + width; at += 5) lines.push(at, y + height, Math.min(at + 5, left + width), y, NaN, NaN);
    pen.line(lines, colour, 1);
    return;
  }
  if (width > 3) pen.frame(left, y, width, height, colour);
  else pen.rect(left, y, width, height, colour);
  pen.text(text, left + 5, y + height / 2, { colour: colours.axis, size: 11, maxWidth: width - 8 });
}

/** The time axis below all panels. */
export function drawTimeAxis(pen: Pen, width: number, height: number, range: Range, colours: Colours, cursors: { time: number; label: string; colour: string }[]): void {
  const x = timeScale(range, width);
  pen.rect(0, 0, width, height, colours.background);
  const { values, step } = ticks(range.from, range.to, (x.end - x.start) / 110);
  pen.text('time / s', MARGIN - 6, 12, { colour: colours.text, align: 'right', size: 10 });
  for (const tick of values) {
    const at = Math.round(toPixel(x, tick)) + 0.5;
    pen.line([at, 0, at, 4], colours.axis, 1);
    const half = (tickText(tick, step).length * 6.5) / 2;
    // A cursor's letter stands there.
    if (cursors.some((cursor) => Math.abs(toPixel(x, cursor.time) - at) < half + 8)) continue;
    pen.text(tickText(tick, step), Math.min(Math.max(at, x.start + half), x.end - half), 12, { colour: colours.text, align: 'center', size: 11 });
  }
  pen.line([x.start, 0.5, x.end, 0.5], colours.axis, 1);
  for (const cursor of cursors) {
    if (cursor.time < range.from || cursor.time > range.to) continue;
    const at = toPixel(x, cursor.time);
    pen.rect(at - 7, 0, 14, 14, cursor.colour);
    pen.text(cursor.label, at, 7, { colour: colours.background, align: 'center', size: 11 });
  }
}
