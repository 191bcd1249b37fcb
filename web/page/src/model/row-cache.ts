// Rows of a view of the trace, fetched by blocks as they come into sight. The newest request goes first; blocks long out of sight are forgotten.

import type { Row } from '../api';
import type { App } from './app';
import { Latest } from './latest';

const BLOCK = 256;
const KEPT = 64;

export class RowCache {
  view = 0;
  length = 0;
  readonly #blocks = new Map<number, Row[]>();
  readonly #latest: Latest<{ from: number; to: number }>;
  #generation = 0;

  constructor(
    private readonly app: App,
    private readonly arrived: () => void,
  ) {
    this.#latest = new Latest((wanted) => this.#fetch(wanted), (error) => app.failed(error));
  }

  get busy(): boolean {
    return this.#latest.busy;
  }

  /** Another view, or with `keep` the same one grown: then rows stay, and so do those that are on their way. */
  set(view: number, length: number, keep: boolean): void {
    if (!keep) {
      this.#blocks.clear();
      this.#generation++;
    }
    this.view = view;
    this.length = length;
  }

  /** Whether a block has all rows that there are by now. */
  #isWhole(block: number): boolean {
    return (this.#blocks.get(block)?.length ?? -1) >= Math.min(BLOCK, this.length - block * BLOCK);
  }

  get(index: number): Row | null {
    return this.#blocks.get(Math.floor(index / BLOCK))?.[index % BLOCK] ?? null;
  }

  want(from: number, to: number): void {
    for (let block = Math.floor(from / BLOCK); block * BLOCK < to; block++) {
      if (!this.#isWhole(block)) {
        this.#latest.ask({ from, to });
        return;
      }
    }
  }

  /** One row, waited for. */
  async row(index: number): Promise<Row | null> {
    return this.get(index) ?? (await this.app.ask('rows', { view: this.view, from: index, count: 1 }))[0] ?? null;
  }

  async #fetch({ from, to }: { from: number; to: number }): Promise<void> {
    const generation = this.#generation;
    for (let block = Math.floor(from / BLOCK); block * BLOCK < Math.min(to, this.length); block++) {
      if (this.#isWhole(block)) continue;
      const rows = await this.app.ask('rows', { view: this.view, from: block * BLOCK, count: BLOCK });
      if (generation !== this.#generation) return;
      this.#blocks.set(block, rows);
      const oldest = this.#blocks.keys().next().value;
      if (this.#blocks.size > KEPT && oldest !== undefined) this.#blocks.delete(oldest);
    }
    this.arrived();
  }
}
