// Axes: where ticks stand and how they are written.

export interface Ticks {
  values: number[];
  step: number;
}

/** Ticks at 1, 2 or 5 times a power of ten, at most `most` of them. */
export function ticks(from: number, to: number, most: number): Ticks {
  const span = to - from;
  if (!(span > 0) || !Number.isFinite(span)) return { values: [from], step: 1 };
  const raw = span / Math.max(1, most);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * (raw / power <= 1 ? 1 : raw / power <= 2 ? 2 : raw / power <= 5 ? 5 : 10);
  const values: number[] = [];
  for (let i = Math.ceil(from / step - 1e-9); i * step <= to + step * 1e-9; i++) values.push(i * step);
  return { values, step };
}

/** A tick's number with just the decimals that its step needs. */
export function tickText(value: number, step: number): string {
  const decimals = Math.min(12, Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
  const size = Math.abs(value);
  if (size >= 1e10 || (size > 0 && size < 1e-6)) return Number(value.toPrecision(4)).toExponential();
  const text = (size < step / 2 ? 0 : value).toFixed(decimals);
  return text.replace('-', '−');
}

/** The texts of an axis' ticks, no two alike: of numbers with too many digits for that, those behind the first say how much more they are. */
export function tickTexts({ values, step }: Ticks): string[] {
  const texts = values.map((value) => tickText(value, step));
  const [first] = values;
  if (first === undefined || new Set(texts).size === texts.length) return texts;
  return texts.map((text, i) => (i === 0 ? `≈${text}` : `+${tickText(i * step, step)}`));
}

export interface Scale {
  from: number;
  to: number;
  /** Pixels of `from` and `to`. */
  start: number;
  end: number;
}

export function toPixel(scale: Scale, value: number): number {
  return scale.start + ((value - scale.from) / (scale.to - scale.from)) * (scale.end - scale.start);
}

export function fromPixel(scale: Scale, pixel: number): number {
  return scale.from + ((pixel - scale.start) / (scale.end - scale.start)) * (scale.to - scale.from);
}
