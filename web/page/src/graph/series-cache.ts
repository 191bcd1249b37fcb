// The columns of each drawn signal. A stretch three times as wide as what is in sight is asked for, so that panning draws from here at once and
// the engine is asked only when the edge comes near or the columns become too coarse.

import type { Series } from '../api';
import type { App, Range } from '../model/app';
import { Latest } from '../model/latest';
import type { Item } from '../model/panels';

interface Wanted {
  range: Range;
  columns: number;
}

interface Entry {
  series: Series | null;
  range: Range;
  columns: number;
  latest: Latest<Wanted>;
  failed: string | null;
  /** The trace has grown since. */
  outdated: boolean;
}

export class SeriesCache {
  readonly #entries = new Map<string, Entry>();

  constructor(
    private readonly app: App,
    private readonly arrived: () => void,
  ) {}

  /** Forgets all columns: the trace or a database changed. */
  clear(): void {
    this.#entries.clear();
  }

  /** The trace has grown: columns are drawn until newer ones are there. */
  outdate(): void {
    for (const entry of this.#entries.values()) entry.outdated = true;
  }

  /** Why a signal cannot be drawn; null if it can. */
  failure(item: Item): string | null {
    return this.#entries.get(keyOf(item))?.failed ?? null;
  }

  /** True while columns are awaited for any item. */
  get busy(): boolean {
    return [...this.#entries.values()].some((entry) => entry.latest.busy);
  }

  /** What there is of an item's columns now; better ones are asked for if these do not serve the range. */
  get(item: Item, range: Range, width: number): Series | null {
    const key = keyOf(item);
    let entry = this.#entries.get(key);
    if (!entry) {
      const made: Entry = { series: null, range: { from: NaN, to: NaN }, columns: 0, failed: null, outdated: false, latest: new Latest((wanted) => this.#fetch(item, key, made, wanted), () => undefined) };
      this.#entries.set(key, (entry = made));
    }
    if (entry.outdated || !serves(entry, range, width, this.app.whole())) {
      entry.outdated = false;
      const span = range.to - range.from;
      const whole = this.app.whole();
      const wide = { from: Math.max(whole.from, range.from - span), to: Math.min(whole.to, range.to + span) };
      const columns = Math.ceil((width * (wide.to - wide.from)) / span);
      entry.latest.ask({ range: wide, columns: Math.max(16, columns) });
    }
    return entry.series;
  }

  async #fetch(item: Item, key: string, entry: Entry, { range, columns }: Wanted): Promise<void> {
    try {
      const series = await this.#ask(item, range, columns);
      if (this.#entries.get(key) !== entry) return;
      entry.series = series;
      entry.failed = null;
    } catch (error) {
      entry.failed = error instanceof Error ? error.message : String(error);
    }
    entry.range = range;
    entry.columns = columns;
    this.arrived();
  }

  async #ask(item: Item, { from, to }: Range, columns: number): Promise<Series | null> {
    if (item.kind !== 'load') return askSeries(this.app, item, { from, to }, columns);
    const { time, load } = await this.app.ask('load', { channel: item.channel, from, to, columns });
    const share = load.map((value) => value * 100);
    return { time, end: time, first: share, min: share, max: share, last: share, values: time.length, exact: true };
  }
}

/** A signal's columns; null if no database has it any more. */
export async function askSeries(app: App, item: Exclude<Item, { kind: 'load' }>, { from, to }: Range, columns: number): Promise<Series | null> {
  if (item.kind === 'raw') return app.ask('rawSeries', { ...item.edit, from, to, columns });
  if (item.kind === 'field') return item.info ? app.ask('fieldSeries', { field: item.info.key, from, to, columns }) : null;
  return item.info ? app.ask('series', { signal: item.info.key, from, to, columns }) : null;
}

function serves(entry: Entry, range: Range, width: number, whole: Range): boolean {
  const span = range.to - range.from;
  const slack = span * 0.25;
  if (!(entry.range.from <= Math.max(whole.from, range.from - slack)) || !(entry.range.to >= Math.min(whole.to, range.to + slack))) return false;
  if (entry.failed !== null || (entry.series?.exact && !isLoad(entry))) return true;
  const columnsInSight = (entry.columns * span) / (entry.range.to - entry.range.from);
  return columnsInSight >= width * 0.6;
}

// Bus load is thinned by time, so that finer columns exist at every zoom.
function isLoad(entry: Entry): boolean {
  return entry.series !== null && entry.series.time === entry.series.end;
}

export function keyOf(item: Item): string {
  if (item.kind === 'load') return `load ${item.channel}`;
  if (item.kind === 'raw') return `raw ${JSON.stringify(item.edit)}`;
  if (item.kind === 'field') return `field ${item.info?.key} ${item.channel} ${item.name} ${item.between} ${item.message} ${item.which}`;
  return `signal ${item.channel} ${item.id} ${item.extended} ${item.signal} ${item.info?.key}`;
}

/** First column that ends at or after a time. */
export function columnAt(series: Series, time: number): number {
  let low = 0;
  let high = series.end.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if ((series.end[middle] as number) < time) low = middle + 1;
    else high = middle;
  }
  return low;
}

export interface ValueAt {
  min: number;
  max: number;
}

/** The value that held at a time: exact where a column is one value, otherwise the column's smallest and largest. Null before the first. */
export function valueAt(series: Series, time: number): ValueAt | null {
  let column = columnAt(series, time);
  if (column >= series.time.length || (series.time[column] as number) > time) column--;
  if (column < 0) return null;
  const last = series.last[column] as number;
  if ((series.end[column] as number) <= time) return { min: last, max: last };
  return { min: series.min[column] as number, max: series.max[column] as number };
}
