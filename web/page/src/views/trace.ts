// The trace: every record a row, of a filter's or of all.

import type { Row, SignalValue } from '../api';
import type { App } from '../model/app';
import { bytesText, clock, count, idText, plural, seconds, utc } from '../model/format';
import { Latest } from '../model/latest';
import { RowCache } from '../model/row-cache';
import type { Commands } from '../ui/commands';
import { button, el, replace, select, setText } from '../ui/dom';
import { VirtualList } from '../ui/virtual-list';
import type { View } from './view';

const COLUMNS = [
  { name: 'No.', class: 'c-number' },
  { name: 'Time / s', class: 'c-time' },
  { name: 'Ch', class: 'c-channel' },
  { name: 'Dir', class: 'c-direction' },
  { name: 'Kind', class: 'c-kind' },
  { name: 'ID', class: 'c-id' },
  { name: 'Message', class: 'c-message' },
  { name: 'DLC', class: 'c-dlc' },
  { name: 'Data', class: 'c-data' },
];

const KINDS: Record<Row['kind'], string> = { data: '', remote: 'RTR', fd: 'FD', error: 'error', state: 'state', lost: 'LOST', other: 'other' };

export class TraceView implements View {
  readonly id = 'trace';
  readonly title = 'Trace';
  readonly element: HTMLElement;
  readonly list: VirtualList;
  readonly #cache: RowCache;
  readonly #filter = el('input', { id: 'trace-filter', attrs: { type: 'text', placeholder: 'Filter: 123, 100-1FF, can0, 18FEF1??, pgn:61444 …', 'aria-label': 'Filter', spellcheck: 'false', autocomplete: 'off' } });
  readonly #find = el('input', { id: 'trace-find', attrs: { type: 'text', placeholder: 'Find: filter or bytes', 'aria-label': 'Find', spellcheck: 'false', autocomplete: 'off' } });
  readonly #state = el('span', { class: 'state', attrs: { role: 'status' } });
  readonly #details = el('aside', { class: 'details', attrs: { 'aria-label': 'Selected record', tabindex: 0 } });
  readonly #time: HTMLSelectElement;
  readonly #filtering: Latest<{ text: string; keep: boolean }>;
  readonly #finding: Latest<{ backwards: boolean; from: number }>;
  readonly #decoding: Latest<number>;
  #applied = '';
  #ready = false;
  #visible = false;
  #follow = false;
  #forgotten = 0;

  constructor(
    private readonly app: App,
    commands: Commands,
    private readonly openExport: () => void,
  ) {
    this.#cache = new RowCache(app, () => this.list.refresh());
    this.list = new VirtualList('Trace', COLUMNS, {
      length: () => this.#cache.length,
      fill: (row, cells, index) => this.#fill(row, cells, index),
      visible: (from, to) => this.#cache.want(Math.max(0, from - 1), to),
      selected: (index) => this.#selected(index),
      opened: (index) => void this.#opened(index),
    });
    this.#filtering = new Latest((wanted) => this.#apply(wanted.text, wanted.keep), (error) => this.#refused(error));
    this.#finding = new Latest((wanted) => this.#search(wanted.backwards, wanted.from), (error) => this.#refused(error));
    this.#decoding = new Latest((index) => this.#show(index), (error) => app.failed(error));
    this.#time = select(
      [
        ['relative', 'since start'],
        ['absolute', 'UTC'],
        ['delta', 'since the row above'],
      ],
      app.profile.timeStyle,
      (value) => this.#setTime(value),
      'Times',
    );
    this.#filter.addEventListener('input', () => this.#filtering.ask({ text: this.#filter.value, keep: false }));
    this.#filter.addEventListener('keydown', (event) => {
      if (event.key === 'Enter' || event.key === 'ArrowDown') this.list.element.focus();
      if (event.key === 'Enter') this.#remember();
    });
    this.#find.addEventListener('input', () => this.#finding.ask({ backwards: false, from: Math.max(-1, this.list.selected - 1) }));
    this.#find.addEventListener('keydown', (event) => {
      if (event.key === 'Enter') this.#next(event.shiftKey);
      else if (event.key === 'Escape') this.list.element.focus();
    });
    const remembered = el('datalist', { id: 'trace-filters' });
    this.#filter.setAttribute('list', remembered.id);
    const fillRemembered = (): void => replace(remembered, ...app.profile.filters.map((f) => el('option', { attrs: { value: f } })));
    fillRemembered();
    app.on('profile', fillRemembered);
    const bar = el(
      'div',
      { class: 'bar' },
      this.#filter,
      remembered,
      this.#find,
      button('↑', () => this.#next(true), { title: 'Find previous (N)', attrs: { 'aria-label': 'Find previous' } }),
      button('↓', () => this.#next(false), { title: 'Find next (n)', attrs: { 'aria-label': 'Find next' } }),
      this.#time,
      button('Export …', () => this.openExport()),
      this.#state,
    );
    this.element = el('section', { class: 'view view-trace', attrs: { 'aria-label': 'Trace' } }, bar, el('div', { class: 'split' }, this.list.element, this.#details));
    this.#emptyDetails();
    app.on('summary', () => this.#grown());
    app.on('live', () => this.#setFollow(app.following && !app.paused));
    app.on('messages', () => this.#filtering.ask({ text: this.#filter.value, keep: false }));
    app.on('goto', () => void this.#goto());
    commands.add(
      { id: 'trace.filter', title: 'Filter the trace', keys: ['/', 'f'], view: this.id, run: () => this.#filter.focus() },
      { id: 'trace.find', title: 'Find in the trace', keys: ['Ctrl+f'], view: this.id, run: () => this.#find.focus() },
      { id: 'trace.next', title: 'Find next', keys: ['n', 'F3'], view: this.id, run: () => this.#next(false) },
      { id: 'trace.previous', title: 'Find previous', keys: ['N', 'Shift+F3'], view: this.id, run: () => this.#next(true) },
      { id: 'trace.clear', title: 'Show all rows (clear the filter)', keys: ['Escape'], view: this.id, run: () => this.setFilter('') },
      { id: 'trace.time', title: 'Times: since start, UTC, since the row above', keys: ['t'], view: this.id, run: () => this.#cycleTime() },
      { id: 'trace.follow', title: 'Follow the newest row', keys: ['F'], view: this.id, run: () => this.#setFollow(!this.#follow) },
      { id: 'trace.top', title: 'First row', keys: ['g'], view: this.id, run: () => this.list.select(0) },
      { id: 'trace.end', title: 'Last row', keys: ['G'], view: this.id, run: () => this.list.select(this.#cache.length - 1) },
      { id: 'trace.only', title: 'Filter: only the selected identifier', keys: ['o'], view: this.id, run: () => this.#only() },
      { id: 'trace.mark-a', title: 'Put cursor A at the selected row', keys: ['a'], view: this.id, run: () => void this.#mark('A') },
      { id: 'trace.mark-b', title: 'Put cursor B at the selected row', keys: ['b'], view: this.id, run: () => void this.#mark('B') },
    );
  }

  get view(): number {
    return this.#cache.view;
  }

  get filter(): string {
    return this.#applied;
  }

  get rows(): number {
    return this.#cache.length;
  }

  shown(): void {
    this.#visible = true;
    if (!this.#ready && this.app.summary) this.#filtering.ask({ text: this.#filter.value, keep: false });
    this.list.refresh();
    void this.#goto();
  }

  hidden(): void {
    this.#visible = false;
  }

  setFilter(text: string): void {
    this.#filter.value = text;
    this.#filtering.ask({ text, keep: false });
    this.list.element.focus();
  }

  #remember(): void {
    const text = this.#filter.value.trim();
    if (text === '') return;
    this.app.profile.filters = [text, ...this.app.profile.filters.filter((f) => f !== text)].slice(0, 20);
    this.app.saveProfile();
  }

  #grown(): void {
    if (this.#filtering.busy) return;
    this.#filtering.ask({ text: this.#applied, keep: true });
  }

  async #apply(text: string, keep: boolean): Promise<void> {
    if (!this.app.summary) return;
    const anchor = this.list.selected >= 0 ? this.#cache.get(this.list.selected) : null;
    const { view, rows } = await this.app.ask('filter', { filter: text.trim() });
    this.#filter.removeAttribute('aria-invalid');
    const { forgotten } = this.app.summary;
    // Rows have other numbers when older ones are gone.
    const moved = forgotten !== this.#forgotten;
    this.#forgotten = forgotten;
    this.#cache.set(view, rows, keep && text === this.#applied && !moved);
    const changed = text !== this.#applied || moved;
    this.#applied = text;
    this.#ready = true;
    setText(this.#state, text.trim() === '' ? plural(rows, 'record') : `${count(rows)} of ${plural(this.app.summary.records, 'record')}`);
    this.#state.classList.remove('bad');
    this.list.refresh();
    if (changed && anchor && rows > 0 && !this.#follow) this.list.select((await this.app.ask('rowAt', { view, time: anchor.time })).row);
    else if (this.#follow && rows > 0) this.list.select(rows - 1);
  }

  /** A filter that is being typed is refused in place: the rows of the last good one stay. */
  #refused(error: unknown): void {
    if (this.app.dead !== null) return;
    setText(this.#state, error instanceof Error ? error.message : String(error));
    this.#state.classList.add('bad');
    if (document.activeElement === this.#filter) this.#filter.setAttribute('aria-invalid', 'true');
  }

  #next(backwards: boolean): void {
    this.#finding.ask({ backwards, from: this.list.selected });
  }

  async #search(backwards: boolean, from: number): Promise<void> {
    const text = this.#find.value.trim();
    if (text === '') return;
    const { row } = await this.app.ask('find', { view: this.#cache.view, text, from, backwards });
    this.#find.setAttribute('aria-invalid', String(row === null));
    this.#state.classList.toggle('bad', row === null);
    if (row === null) setText(this.#state, `“${text}”: none ${backwards ? 'above' : 'below'} row ${count(Math.max(0, from) + 1)}`);
    else {
      setText(this.#state, `“${text}”: row ${count(row + 1)} of ${count(this.#cache.length)}`);
      this.list.select(row);
    }
  }

  #fill(row: HTMLElement, cells: HTMLElement[], index: number): boolean {
    const record = this.#cache.get(index);
    const [no, time, channel, direction, kind, id, message, dlc, data] = cells as [HTMLElement, HTMLElement, HTMLElement, HTMLElement, HTMLElement, HTMLElement, HTMLElement, HTMLElement, HTMLElement];
    row.dataset['kind'] = record?.kind ?? '';
    if (!record) {
      setText(no, count(index + 1));
      for (const cell of cells.slice(1)) setText(cell, '');
      setText(data, '…');
      return false;
    }
    setText(no, count(record.index + 1));
    setText(time, this.#timeText(record));
    time.classList.toggle('late', record.late);
    time.title = record.late ? 'Late stamp: the frame ended no later than this' : '';
    setText(channel, record.channel === null ? '' : String(record.channel));
    setText(direction, record.id === null ? '' : record.sent ? 'TX' : 'RX');
    setText(kind, KINDS[record.kind]);
    setText(id, record.id === null ? '' : idText(record.id, record.extended));
    setText(message, record.message ?? '');
    setText(dlc, record.dlc === null ? '' : String(record.dlc));
    setText(data, record.text === '' ? bytesText(record.data) : record.data === '' ? record.text : `${bytesText(record.data)}  ${record.text}`);
    return true;
  }

  #timeText(record: Row): string {
    const mark = record.late ? '≤' : '';
    const style = this.app.profile.timeStyle;
    if (style === 'absolute' && this.app.summary?.startUtcNs) return mark + utc(this.app.summary.startUtcNs, record.time).slice(11);
    if (style === 'delta') {
      return mark + (record.above ? `${record.above.seconds < 0 ? '−' : '+'}${Math.abs(record.above.seconds).toFixed(6)}` : seconds(record.time));
    }
    return mark + seconds(record.time);
  }

  #setTime(value: string): void {
    if (value === 'absolute' && !this.app.summary?.startUtcNs) this.app.notify('info', 'This trace has no date: its times are since its start.');
    this.app.profile.timeStyle = value === 'absolute' || value === 'delta' ? value : 'relative';
    this.#time.value = this.app.profile.timeStyle;
    this.app.saveProfile();
    this.list.refresh();
  }

  #cycleTime(): void {
    const order = ['relative', 'absolute', 'delta'];
    this.#setTime(order[(order.indexOf(this.app.profile.timeStyle) + 1) % order.length] as string);
  }

  #setFollow(on: boolean): void {
    this.#follow = on;
    setText(this.#state, on ? 'following the newest row' : 'no longer following');
    if (on) this.list.select(this.#cache.length - 1);
  }

  #selected(index: number): void {
    if (index < this.#cache.length - 1) this.#follow = false;
    // Nobody reads the details of a row that is gone in a moment.
    if (!this.#follow || !this.app.live) this.#decoding.ask(index);
  }

  async #show(index: number): Promise<void> {
    const row = await this.#cache.row(index);
    if (!row) return;
    if (row.id !== null && row.channel !== null) this.app.choose({ channel: row.channel, id: row.id, extended: row.extended });
    const signals = row.id !== null && row.message !== null ? await this.app.ask('decode', { index: row.index }) : [];
    const start = this.app.summary?.startUtcNs;
    const facts: [string, string][] = [
      ['Record', `${count(row.index + 1)} of ${count((this.app.summary?.records ?? 0) + (this.app.summary?.forgotten ?? 0))}`],
      ['Time', `${row.late ? '≤ ' : ''}${seconds(row.time)} s`],
      ...(start ? [['UTC', utc(start, row.time)] as [string, string]] : []),
      ...(row.above ? [['Since the row above', `${row.above.seconds.toFixed(6)} s ${clock(row.above.byDevice, this.app.summary)}`.trim()] as [string, string]] : []),
      ...(row.late ? [['Stamp', 'late: the frame ended no later than this'] as [string, string]] : []),
      ...(row.channel === null ? [] : [['Channel', String(row.channel)] as [string, string]]),
      ...(row.id === null ? [] : [['Identifier', `${idText(row.id, row.extended)}, ${row.extended ? '29' : '11'} bit${row.sent ? ', sent' : ''}`] as [string, string]]),
      ...(row.dlc === null ? [] : [['DLC', `${row.dlc}${row.kind === 'fd' ? ', CAN FD' : row.kind === 'remote' ? ', remote' : ''}`] as [string, string]]),
      ...(row.data === '' ? [] : [['Data', bytesText(row.data)] as [string, string], ['Text', asciiText(row.data)] as [string, string]]),
      ...(row.text === '' ? [] : [['What', row.text] as [string, string]]),
    ];
    replace(
      this.#details,
      el('h3', {}, row.message ?? (row.id === null ? KINDS[row.kind] || 'Record' : 'No message known')),
      el('dl', {}, ...facts.flatMap(([name, value]) => [el('dt', {}, name), el('dd', {}, value)])),
      signals.length > 0 ? signalTable(signals) : row.id !== null ? el('p', { class: 'muted' }, row.message === null ? 'Add a database (DBC, KCD, SYM, ARXML) to see its signals.' : 'This message has no signals.') : null,
    );
  }

  #emptyDetails(): void {
    replace(this.#details, el('p', { class: 'muted' }, 'Select a row to see its bytes and signals.'));
  }

  async #opened(index: number): Promise<void> {
    const row = await this.#cache.row(index);
    if (row) this.app.goto(row.time);
  }

  async #mark(which: 'A' | 'B'): Promise<void> {
    const row = this.list.selected >= 0 ? await this.#cache.row(this.list.selected) : null;
    if (row) this.app.setCursor(which, row.time);
  }

  #only(): void {
    const chosen = this.app.identifier;
    if (chosen) this.setFilter(`${idText(chosen.id, chosen.extended)}`);
  }

  async #goto(): Promise<void> {
    const target = this.app.target;
    if (!target || !this.#visible || !this.#ready) return;
    this.app.target = null;
    try {
      this.list.select((await this.app.ask('rowAt', { view: this.#cache.view, time: target.time })).row);
    } catch (error) {
      this.app.failed(error);
    }
  }
}

export function signalTable(signals: readonly SignalValue[]): HTMLTableElement {
  return el(
    'table',
    { class: 'signals' },
    el('thead', {}, el('tr', {}, el('th', { attrs: { scope: 'col' } }, 'Signal'), el('th', { class: 'number', attrs: { scope: 'col' } }, 'Value'), el('th', { attrs: { scope: 'col' } }, 'Unit'))),
    el('tbody', {}, ...signals.map((s) => el('tr', { class: s.value === null ? 'muted' : '' }, el('td', {}, s.name), el('td', { class: 'number' }, s.value === null ? 'not in this frame' : s.text), el('td', {}, s.unit)))),
  );
}

function asciiText(hex: string): string {
  let text = '';
  for (let i = 0; i + 1 < hex.length; i += 2) {
    const code = parseInt(hex.slice(i, i + 2), 16);
    text += code >= 0x20 && code < 0x7f ? String.fromCharCode(code) : '·';
  }
  return text;
}

