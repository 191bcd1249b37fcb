// The fixed view: one row for each identifier, with its newest data, the bits that changed, and its period.

import type { IdRow } from '../api';
import { type App, type Identifier, sameIdentifier } from '../model/app';
import { bytesText, clock, count, idText, plural, seconds } from '../model/format';
import { Latest } from '../model/latest';
import { Spacing } from '../model/spacing';
import type { Commands } from '../ui/commands';
import { button, el, replace, select, setText } from '../ui/dom';
import { match } from '../ui/palette';
import { VirtualList } from '../ui/virtual-list';
import type { View } from './view';

const COLUMNS = [
  { name: '±', class: 'c-twist' },
  { name: 'Ch', class: 'c-channel' },
  { name: 'ID', class: 'c-id' },
  { name: 'Message', class: 'c-message' },
  { name: 'Frames', class: 'c-count' },
  { name: 'Period / ms', class: 'c-period', title: 'The median of the newest 512 frames; beside it, their smallest and largest' },
  { name: 'smallest', class: 'c-period' },
  { name: 'largest', class: 'c-period' },
  { name: 'Last / s', class: 'c-time' },
  { name: 'Data', class: 'c-data' },
];

/** Seconds within which a change fades away. */
const FADE = 2;

type Line = { kind: 'id'; row: IdRow } | { kind: 'signal'; row: IdRow; signal: number };

type Order = 'id' | 'count' | 'period' | 'change';

export class FixedView implements View {
  readonly id = 'fixed';
  readonly title = 'Fixed';
  readonly element: HTMLElement;
  readonly #list: VirtualList;
  readonly #search = el('input', { attrs: { type: 'search', placeholder: 'Search identifiers and messages', 'aria-label': 'Search identifiers and messages', spellcheck: 'false' } });
  readonly #state = el('span', { class: 'state', attrs: { role: 'status' } });
  readonly #at: HTMLInputElement;
  readonly #asking: Latest<number>;
  readonly #spacing = new Spacing();
  readonly #open = new Set<string>();
  #rows: IdRow[] = [];
  #lines: Line[] = [];
  #order: Order = 'id';
  #time = Infinity;
  #visible = false;

  constructor(
    private readonly app: App,
    commands: Commands,
    private readonly openBits: () => void,
  ) {
    this.#asking = new Latest(
      (at) =>
        this.#spacing.run(async () => {
          this.#rows = (await app.ask('ids', { at })).slice();
          this.#time = Number.isFinite(at) ? at : (app.summary?.duration ?? 0);
          this.#arrange();
        }),
      (error) => app.failed(error),
    );
    this.#list = new VirtualList('Identifiers', COLUMNS, {
      length: () => this.#lines.length,
      fill: (row, cells, index) => this.#fill(row, cells, index),
      selected: (index) => {
        const line = this.#lines[index];
        if (line && !sameIdentifier(app.identifier, line.row)) app.choose(identifierOf(line.row));
      },
      opened: (index) => this.#toggle(index),
    }, 20, 'treegrid');
    this.#list.element.addEventListener('click', (event) => {
      if ((event.target as Element).closest('.c-twist')) this.#toggle(this.#list.selected);
    });
    this.#list.element.addEventListener('keydown', (event) => {
      if (event.key === 'ArrowRight' || event.key === 'ArrowLeft' || event.key === ' ') {
        event.preventDefault();
        this.#toggle(this.#list.selected, event.key === ' ' ? undefined : event.key === 'ArrowRight');
      }
    });
    this.#at = el('input', { attrs: { type: 'range', min: 0, max: 1000, value: 1000, 'aria-label': 'Time of the fixed view' } });
    this.#at.addEventListener('input', () => this.#ask());
    this.#search.addEventListener('input', () => this.#arrange());
    const order = select(
      [
        ['id', 'by identifier'],
        ['count', 'by frames'],
        ['period', 'by period'],
        ['change', 'by last change'],
      ],
      this.#order,
      (value) => {
        this.#order = value as Order;
        this.#arrange();
      },
      'Order',
    );
    const bar = el('div', { class: 'bar' }, this.#search, order, button('Expand all', () => this.#expand(true)), button('Close all', () => this.#expand(false)), button('Bits', () => this.openBits(), { title: 'The bits of the selected identifier (x)' }), el('label', { class: 'inline' }, 'at', this.#at), this.#state);
    this.element = el('section', { class: 'view view-fixed', attrs: { 'aria-label': 'Fixed view' } }, bar, this.#list.element);
    app.on('summary', () => (app.live ? this.#spacing.ask(() => this.#ask()) : this.#ask()));
    app.on('messages', () => this.#ask());
    app.on('cursors', () => {
      if (!this.#visible || app.cursorA === null) return;
      this.#at.value = String(((app.cursorA - app.whole().from) / (app.whole().to - app.whole().from)) * 1000);
      this.#ask();
    });
    commands.add(
      { id: 'fixed.search', title: 'Fixed view: search', keys: ['/'], view: this.id, run: () => this.#search.focus() },
      { id: 'fixed.bits', title: 'Fixed view: bits of the selected identifier', keys: ['x'], view: this.id, run: () => this.openBits() },
      { id: 'fixed.expand', title: 'Fixed view: expand all', keys: ['e'], view: this.id, run: () => this.#expand(true) },
      { id: 'fixed.close', title: 'Fixed view: close all', keys: ['c'], view: this.id, run: () => this.#expand(false) },
    );
  }

  shown(): void {
    this.#visible = true;
    this.#ask();
    this.#list.refresh();
  }

  hidden(): void {
    this.#visible = false;
  }

  #ask(): void {
    if (!this.#visible || !this.app.summary) return;
    const share = Number(this.#at.value) / 1000;
    const { from, to } = this.app.whole();
    this.#asking.ask(share >= 1 ? Infinity : from + share * (to - from));
  }

  #arrange(): void {
    const query = this.#search.value.trim();
    const rows = this.#rows.filter((r) => query === '' || match(query, `${idText(r.id, r.extended)} ${r.message ?? ''}`) !== null);
    const by: Record<Order, (a: IdRow, b: IdRow) => number> = {
      id: (a, b) => a.channel - b.channel || Number(a.extended) - Number(b.extended) || a.id - b.id,
      count: (a, b) => b.count - a.count,
      period: (a, b) => (a.period?.median ?? Infinity) - (b.period?.median ?? Infinity),
      change: (a, b) => newest(b.changed) - newest(a.changed),
    };
    rows.sort(by[this.#order]);
    this.#lines = rows.flatMap((row): Line[] => [{ kind: 'id', row }, ...(this.#open.has(keyOf(row)) ? row.signals.map((_, signal): Line => ({ kind: 'signal', row, signal })) : [])]);
    setText(this.#state, `${plural(rows.length, 'identifier')} at ${seconds(this.#time)} s`);
    this.#list.refresh();
  }

  #expand(open: boolean): void {
    for (const row of this.#rows) {
      if (open) this.#open.add(keyOf(row));
      else this.#open.delete(keyOf(row));
    }
    this.#arrange();
  }

  #toggle(index: number, open?: boolean): void {
    const line = this.#lines[index];
    if (!line) return;
    const key = keyOf(line.row);
    if (open ?? !this.#open.has(key)) this.#open.add(key);
    else this.#open.delete(key);
    this.#arrange();
    this.#list.select(this.#lines.findIndex((l) => l.kind === 'id' && l.row === line.row));
  }

  #fill(row: HTMLElement, cells: HTMLElement[], index: number): boolean {
    const line = this.#lines[index];
    if (!line) return false;
    row.classList.toggle('sub', line.kind === 'signal');
    const data = cells[9] as HTMLElement;
    if (line.kind === 'signal') {
      const signal = line.row.signals[line.signal];
      const texts = ['', '', '', signal?.name ?? '', '', '', '', '', '', ''];
      for (const [i, cell] of cells.entries()) setText(cell, texts[i] ?? '');
      delete data.dataset['key'];
      setText(data, signal ? (signal.value === null ? 'not in this frame' : `${signal.text} ${signal.unit}`.trim()) : '');
      row.setAttribute('aria-level', '2');
      row.removeAttribute('aria-expanded');
      return true;
    }
    const { row: id } = line;
    const open = this.#open.has(keyOf(id));
    const texts = [id.signals.length > 0 ? (open ? '▾' : '▸') : '', String(id.channel), idText(id.id, id.extended), id.message ?? '', count(id.count), ...[id.period?.median, id.period?.min, id.period?.max].map(milliseconds), seconds(id.lastTime)];
    for (const [i, text] of texts.entries()) setText(cells[i] as HTMLElement, text);
    const by = id.period ? clock(id.period.byDevice, this.app.summary) : '';
    for (const cell of cells.slice(5, 8)) cell.title = by && `Measured ${by}`;
    row.setAttribute('aria-level', '1');
    if (id.signals.length > 0) row.setAttribute('aria-expanded', String(open));
    else row.removeAttribute('aria-expanded');
    this.#fillBytes(data, id);
    return true;
  }

  /** Bytes one by one. The ground of each is its eight bits from left to right: the more recently a bit changed, the stronger. */
  #fillBytes(cell: HTMLElement, id: IdRow): void {
    const key = `${id.channel} ${id.id} ${id.extended} ${id.lastData} ${this.#time} ${newest(id.changed)}`;
    if (cell.dataset['key'] === key && cell.childElementCount > 0) return;
    cell.dataset['key'] = key;
    replace(cell, ...bytesText(id.lastData).split(' ').filter(Boolean).map((text, byte) => this.#byte(text, id.changed.subarray(byte * 8, byte * 8 + 8))));
  }

  #byte(text: string, changed: Float64Array): HTMLElement {
    const strengths = [...changed].map((at) => (this.#time - at < FADE ? 1 - (this.#time - at) / FADE : 0));
    const element = el('span', { class: 'byte' }, text);
    if (strengths.every((s) => !(s > 0))) return element;
    const stops = strengths.map((s, bit) => `rgb(var(--heat) / ${(s * 0.55).toFixed(3)}) ${bit * 12.5}% ${(bit + 1) * 12.5}%`);
    element.style.background = `linear-gradient(90deg, ${stops.join(', ')})`;
    element.title = `bits ${strengths.map((s, bit) => (s > 0 ? 7 - bit : '')).filter((b) => b !== '').join(', ')} changed within ${FADE} s`;
    element.dataset['changed'] = String(strengths.filter((s) => s > 0).length);
    return element;
  }
}

/** With microseconds: what stands one below the other can be compared. */
function milliseconds(value: number | undefined): string {
  return value === undefined ? '–' : (value * 1e3).toFixed(3);
}

function newest(changed: Float64Array): number {
  let last = -Infinity;
  for (const at of changed) if (at > last) last = at;
  return last;
}

function keyOf(row: IdRow): string {
  return `${row.channel} ${row.id} ${row.extended}`;
}

function identifierOf(row: IdRow): Identifier {
  return { channel: row.channel, id: row.id, extended: row.extended };
}
