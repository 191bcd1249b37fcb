// The exact values at the two cursors, and how far they are apart. What is drawn is thinned to columns; these are asked for one by one.

import type { Interval } from '../api';
import type { App } from '../model/app';
import { Latest } from '../model/latest';
import type { Item } from '../model/panels';
import { askSeries, keyOf, valueAt } from './series-cache';

interface Entry {
  time: number;
  value: number | null;
  latest: Latest<number>;
}

export class CursorValues {
  readonly #entries = new Map<string, Entry>();
  readonly #asking: Latest<{ from: number; to: number }>;
  #interval: { from: number; to: number; answer: Interval } | null = null;

  constructor(
    private readonly app: App,
    private readonly arrived: () => void,
  ) {
    this.#asking = new Latest(
      async ({ from, to }) => {
        this.#interval = { from, to, answer: await app.ask('interval', { from, to }) };
        this.arrived();
      },
      () => undefined,
    );
  }

  clear(): void {
    this.#interval = null;
    this.#entries.clear();
  }

  /** From cursor A to B; null until it is known. */
  interval(from: number, to: number): Interval | null {
    const known = this.#interval;
    if (known?.from === from && known.to === to) return known.answer;
    this.#asking.ask({ from, to });
    return null;
  }

  /** The value that holds at the cursor: null before the first, undefined until it is known (and for bus load, which has no single values). */
  get(item: Item, cursor: 'A' | 'B', time: number): number | null | undefined {
    if (item.kind === 'load') return undefined;
    const key = `${cursor} ${keyOf(item)}`;
    let entry = this.#entries.get(key);
    if (!entry) {
      const made: Entry = {
        time: NaN,
        value: null,
        latest: new Latest(
          async (at) => {
            const series = await askSeries(this.app, item, { from: at, to: at }, 4);
            made.value = series ? (valueAt(series, at)?.min ?? null) : null;
            made.time = at;
            this.arrived();
          },
          () => undefined,
        ),
      };
      this.#entries.set(key, (entry = made));
    }
    if (entry.time === time) return entry.value;
    entry.latest.ask(time);
    return undefined;
  }
}
