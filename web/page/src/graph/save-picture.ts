// Saves what the graphs show: as a picture, or as the columns behind it.

import { MARGIN, type Colours, type Sheet, drawPanel, drawTimeAxis } from './draw';
import { CanvasPen, type Pen, SvgPen } from './pen';
import { columnAt } from './series-cache';
import { save, saveBlob } from '../model/files';

const TITLE = 20;
const AXIS = 24;

function drawAll(pen: Pen, sheets: readonly Sheet[], colours: Colours): void {
  const width = sheets[0]?.width ?? 0;
  let top = 0;
  for (const sheet of sheets) {
    const shifted = new ShiftedPen(pen, top);
    shifted.rect(0, 0, width, TITLE, colours.background);
    let x = MARGIN;
    for (const trace of sheet.traces) {
      const label = trace.unit ? `${trace.label} / ${trace.unit}` : trace.label;
      shifted.rect(x, TITLE / 2 - 4, 8, 8, trace.colour);
      shifted.text(label, x + 12, TITLE / 2, { colour: colours.axis });
      x += 24 + label.length * 6.8;
    }
    drawPanel(new ShiftedPen(pen, top + TITLE), sheet);
    top += TITLE + sheet.height;
  }
  const first = sheets[0];
  if (first) {
    const cursors = [
      ...(first.cursorA === null ? [] : [{ time: first.cursorA, label: 'A', colour: colours.cursorA }]),
      ...(first.cursorB === null ? [] : [{ time: first.cursorB, label: 'B', colour: colours.cursorB }]),
    ];
    drawTimeAxis(new ShiftedPen(pen, top), width, AXIS, first.range, colours, cursors);
  }
}

function fullHeight(sheets: readonly Sheet[]): number {
  return sheets.reduce((sum, sheet) => sum + sheet.height + TITLE, AXIS);
}

export function savePng(name: string, sheets: readonly Sheet[], colours: Colours): void {
  const scale = 2;
  const canvas = document.createElement('canvas');
  canvas.width = (sheets[0]?.width ?? 0) * scale;
  canvas.height = fullHeight(sheets) * scale;
  const context = canvas.getContext('2d');
  if (!context) throw new Error('This browser draws no picture of this size: make the window smaller.');
  context.scale(scale, scale);
  drawAll(new CanvasPen(context), sheets, colours);
  canvas.toBlob((blob) => {
    if (blob) saveBlob(name, blob);
  });
}

export function svgOf(sheets: readonly Sheet[], colours: Colours): string {
  const pen = new SvgPen();
  drawAll(pen, sheets, colours);
  return pen.document(sheets[0]?.width ?? 0, fullHeight(sheets));
}

/** The columns in sight, one a line; where a column is one value, first, smallest, largest and last are that value. */
export function csvOf(sheets: readonly Sheet[]): string {
  const lines = ['signal,unit,time_s,end_s,first,min,max,last'];
  for (const sheet of sheets) {
    for (const { label, unit, series } of sheet.traces) {
      if (!series) continue;
      for (let i = columnAt(series, sheet.range.from); i < series.time.length && (series.time[i] as number) <= sheet.range.to; i++) {
        lines.push([quote(label), quote(unit), series.time[i], series.end[i], series.first[i], series.min[i], series.max[i], series.last[i]].join(','));
      }
    }
  }
  return `${lines.join('\r\n')}\r\n`;
}

export function saveSvg(name: string, sheets: readonly Sheet[], colours: Colours): void {
  save(name, svgOf(sheets, colours), 'image/svg+xml');
}

export function saveCsv(name: string, sheets: readonly Sheet[]): void {
  save(name, csvOf(sheets), 'text/csv');
}

/** Quoted as RFC 4180 section 2 has it; a name that a spreadsheet would take for a formula is led by an apostrophe. */
function quote(text: string): string {
  const safe = /^[=+\-@\t\r]/.test(text) ? `'${text}` : text;
  return /[",\r\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}

/** A pen that draws further down. */
class ShiftedPen implements Pen {
  constructor(
    private readonly pen: Pen,
    private readonly dy: number,
  ) {}

  rect(x: number, y: number, width: number, height: number, fill: string): void {
    this.pen.rect(x, y + this.dy, width, height, fill);
  }

  frame(x: number, y: number, width: number, height: number, colour: string): void {
    this.pen.frame(x, y + this.dy, width, height, colour);
  }

  line(points: readonly number[], colour: string, width: number, dash?: number[]): void {
    this.pen.line(this.#shifted(points), colour, width, dash);
  }

  dots(points: readonly number[], colour: string, size: number): void {
    this.pen.dots(this.#shifted(points), colour, size);
  }

  bars(bars: readonly number[], colour: string): void {
    const shifted = bars.map((value, i) => (i % 3 === 0 ? value : value + this.dy));
    this.pen.bars(shifted, colour);
  }

  text(text: string, x: number, y: number, options: Parameters<Pen['text']>[3]): void {
    this.pen.text(text, x, y + this.dy, options);
  }

  clipped(x: number, y: number, width: number, height: number, draw: () => void): void {
    this.pen.clipped(x, y + this.dy, width, height, draw);
  }

  #shifted(points: readonly number[]): number[] {
    return points.map((value, i) => (i % 2 === 1 ? value + this.dy : value));
  }
}
