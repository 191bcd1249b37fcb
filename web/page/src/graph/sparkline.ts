// A signal's whole course in a few pixels.

import type { Series } from '../api';
import type { Range } from '../model/app';
import type { Pen } from './pen';

export function drawSparkline(pen: Pen, series: Series, range: Range, width: number, height: number, colour: string): void {
  let low = Infinity;
  let high = -Infinity;
  for (let i = 0; i < series.time.length; i++) {
    low = Math.min(low, series.min[i] as number);
    high = Math.max(high, series.max[i] as number);
  }
  if (!Number.isFinite(low)) return;
  const span = high - low;
  const x = (t: number): number => ((t - range.from) / (range.to - range.from)) * width;
  const y = (v: number): number => (span === 0 ? height / 2 : height - 1.5 - ((v - low) / span) * (height - 3));
  const points: number[] = [];
  for (let i = 0; i < series.time.length; i++) {
    const at = x(series.time[i] as number);
    points.push(at, y(series.first[i] as number), at, y(series.min[i] as number), at, y(series.max[i] as number), x(series.end[i] as number), y(series.last[i] as number));
  }
  pen.line(points, colour, 1);
}
