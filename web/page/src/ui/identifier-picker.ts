// Chooses the identifier that bits, statistics and the editor are about: one choice for all views.

import type { IdRow } from '../api';
import type { App } from '../model/app';
import { idText } from '../model/format';
import { Latest } from '../model/latest';
import { Spacing } from '../model/spacing';
import { el, replace } from './dom';

export class IdentifierPicker {
  readonly element = el('select', { class: 'mono', attrs: { 'aria-label': 'Identifier' } });
  readonly #asking: Latest<null>;
  readonly #spacing = new Spacing();
  #rows: IdRow[] = [];

  constructor(private readonly app: App) {
    this.#asking = new Latest(
      () =>
        this.#spacing.run(async () => {
          this.#rows = await app.ask('ids', { at: Infinity });
          if (app.identifier === null && this.#rows[0]) app.choose(this.#rows[0]);
          this.#fill();
        }),
      (error) => app.failed(error),
    );
    this.element.addEventListener('change', () => {
      const row = this.#rows[Number(this.element.value)];
      if (row) app.choose({ channel: row.channel, id: row.id, extended: row.extended });
    });
    app.on('identifier', () => this.#show());
  }

  /** Asks for the identifiers there are now. */
  refresh(): void {
    if (this.app.summary) this.#asking.ask(null);
  }

  /** The same while a trace grows: when it is due. */
  keepUp(): void {
    this.#spacing.ask(() => this.refresh());
  }

  /** The row of the chosen identifier. */
  get row(): IdRow | null {
    const chosen = this.app.identifier;
    return this.#rows.find((r) => chosen !== null && r.channel === chosen.channel && r.id === chosen.id && r.extended === chosen.extended) ?? null;
  }

  step(by: number): void {
    const next = this.#rows[this.#rows.findIndex((r) => r === this.row) + by];
    if (next) this.app.choose({ channel: next.channel, id: next.id, extended: next.extended });
  }

  #fill(): void {
    this.#rows = [...this.#rows].sort((a, b) => a.channel - b.channel || Number(a.extended) - Number(b.extended) || a.id - b.id);
    replace(this.element, ...this.#rows.map((row, i) => el('option', { attrs: { value: i } }, `${row.channel}: ${idText(row.id, row.extended)} ${row.message ?? ''}`)));
    this.#show();
  }

  #show(): void {
    const at = this.#rows.findIndex((r) => r === this.row);
    if (at >= 0) this.element.value = String(at);
  }
}
