// One way to draw for the screen, the PNG and the SVG, so that what is saved is what was seen.

export interface TextOptions {
  colour: string;
  align?: 'left' | 'center' | 'right';
  size?: number;
  /** Shortened with “…” beyond this many pixels. */
  maxWidth?: number;
}

export interface Pen {
  rect(x: number, y: number, width: number, height: number, fill: string): void;
  frame(x: number, y: number, width: number, height: number, colour: string): void;
  /** x and y in turn; NaN lifts the pen. */
  line(points: readonly number[], colour: string, width: number, dash?: number[]): void;
  dots(points: readonly number[], colour: string, size: number): void;
  /** Upright lines, a pixel wide: x, top and bottom in turn. Thousands of them take a fraction of the time of a line. */
  bars(bars: readonly number[], colour: string): void;
  /** `y` is the middle of the text. */
  text(text: string, x: number, y: number, options: TextOptions): void;
  clipped(x: number, y: number, width: number, height: number, draw: () => void): void;
}

const FONT = 'ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace';
/** Segments that are stroked at once: the time for one stroke grows faster than its length. */
const PIECE = 100;
/** Width of a character of the monospaced face, as a share of its size. */
const ADVANCE = 0.603;

function shorten(text: string, size: number, maxWidth: number | undefined): string {
  if (maxWidth === undefined) return text;
  const fits = Math.floor(maxWidth / (size * ADVANCE));
  if (text.length <= fits) return text;
  return fits < 2 ? '' : `${text.slice(0, fits - 1)}…`;
}

export class CanvasPen implements Pen {
  constructor(readonly context: CanvasRenderingContext2D) {}

  rect(x: number, y: number, width: number, height: number, fill: string): void {
    this.context.fillStyle = fill;
    this.context.fillRect(x, y, width, height);
  }

  frame(x: number, y: number, width: number, height: number, colour: string): void {
    this.context.strokeStyle = colour;
    this.context.lineWidth = 1;
    this.context.setLineDash([]);
    this.context.strokeRect(x + 0.5, y + 0.5, width - 1, height - 1);
  }

  line(points: readonly number[], colour: string, width: number, dash: number[] = []): void {
    const c = this.context;
    c.strokeStyle = colour;
    c.lineWidth = width;
    c.lineJoin = 'bevel';
    c.setLineDash(dash);
    c.beginPath();
    let down = false;
    let since = 0;
    for (let i = 0; i + 1 < points.length; i += 2) {
      const x = points[i] as number;
      const y = points[i + 1] as number;
      if (Number.isNaN(x) || Number.isNaN(y)) down = false;
      else if (!down) {
        c.moveTo(x, y);
        down = true;
      } else {
        c.lineTo(x, y);
        if (++since >= PIECE) {
          c.stroke();
          c.beginPath();
          c.moveTo(x, y);
          since = 0;
        }
      }
    }
    c.stroke();
  }

  dots(points: readonly number[], colour: string, size: number): void {
    this.context.fillStyle = colour;
    for (let i = 0; i + 1 < points.length; i += 2) this.context.fillRect((points[i] as number) - size / 2, (points[i + 1] as number) - size / 2, size, size);
  }

  bars(bars: readonly number[], colour: string): void {
    this.context.fillStyle = colour;
    for (let i = 0; i + 2 < bars.length; i += 3) {
      const top = bars[i + 1] as number;
      this.context.fillRect((bars[i] as number) - 0.5, top, 1, (bars[i + 2] as number) - top);
    }
  }

  text(text: string, x: number, y: number, { colour, align = 'left', size = 11, maxWidth }: TextOptions): void {
    const c = this.context;
    c.fillStyle = colour;
    c.font = `${size}px ${FONT}`;
    c.textAlign = align;
    c.textBaseline = 'middle';
    c.fillText(shorten(text, size, maxWidth), x, y);
  }

  clipped(x: number, y: number, width: number, height: number, draw: () => void): void {
    this.context.save();
    this.context.beginPath();
    this.context.rect(x, y, width, height);
    this.context.clip();
    draw();
    this.context.restore();
  }
}

export class SvgPen implements Pen {
  readonly #parts: string[] = [];
  #clips = 0;

  rect(x: number, y: number, width: number, height: number, fill: string): void {
    this.#parts.push(`<rect x="${n(x)}" y="${n(y)}" width="${n(width)}" height="${n(height)}" fill="${escape(fill)}"/>`);
  }

  frame(x: number, y: number, width: number, height: number, colour: string): void {
    this.#parts.push(`<rect x="${n(x + 0.5)}" y="${n(y + 0.5)}" width="${n(Math.max(0, width - 1))}" height="${n(Math.max(0, height - 1))}" fill="none" stroke="${escape(colour)}"/>`);
  }

  line(points: readonly number[], colour: string, width: number, dash: number[] = []): void {
    let path = '';
    let down = false;
    for (let i = 0; i + 1 < points.length; i += 2) {
      const x = points[i] as number;
      const y = points[i + 1] as number;
      if (Number.isNaN(x) || Number.isNaN(y)) down = false;
      else {
        path += `${down ? 'L' : 'M'}${n(x)} ${n(y)}`;
        down = true;
      }
    }
    if (path !== '') this.#parts.push(`<path d="${path}" fill="none" stroke="${escape(colour)}" stroke-width="${width}"${dash.length > 0 ? ` stroke-dasharray="${dash.join(' ')}"` : ''}/>`);
  }

  dots(points: readonly number[], colour: string, size: number): void {
    let path = '';
    for (let i = 0; i + 1 < points.length; i += 2) path += `M${n((points[i] as number) - size / 2)} ${n((points[i + 1] as number) - size / 2)}h${size}v${size}h-${size}z`;
    if (path !== '') this.#parts.push(`<path d="${path}" fill="${escape(colour)}"/>`);
  }

  bars(bars: readonly number[], colour: string): void {
    const lines: number[] = [];
    for (let i = 0; i + 2 < bars.length; i += 3) lines.push(bars[i] as number, bars[i + 1] as number, bars[i] as number, bars[i + 2] as number, NaN, NaN);
    this.line(lines, colour, 1);
  }

  text(text: string, x: number, y: number, { colour, align = 'left', size = 11, maxWidth }: TextOptions): void {
    const anchor = { left: 'start', center: 'middle', right: 'end' }[align];
    this.#parts.push(`<text x="${n(x)}" y="${n(y)}" fill="${escape(colour)}" font-size="${size}" text-anchor="${anchor}" dominant-baseline="central">${escape(shorten(text, size, maxWidth))}</text>`);
  }

  clipped(x: number, y: number, width: number, height: number, draw: () => void): void {
    const id = `clip${++this.#clips}`;
    this.#parts.push(`<clipPath id="${id}"><rect x="${n(x)}" y="${n(y)}" width="${n(width)}" height="${n(height)}"/></clipPath><g clip-path="url(#${id})">`);
    draw();
    this.#parts.push('</g>');
  }

  document(width: number, height: number): string {
    return `<svg xmlns="http://www.w3.org/2000/svg" width="${width}" height="${height}" viewBox="0 0 ${width} ${height}" font-family="${escape(FONT)}">${this.#parts.join('')}</svg>\n`;
  }
}

function n(value: number): string {
  return String(Math.round(value * 100) / 100);
}

function escape(text: string): string {
  // Control characters that XML does not allow are left out: a name in a database may hold any.
  return text.replace(/[\u0000-\u0008\u000b\u000c\u000e-\u001f\ufffe\uffff]/g, '').replace(/[<>&"']/g, (c) => `&#${c.charCodeAt(0)};`);
}
