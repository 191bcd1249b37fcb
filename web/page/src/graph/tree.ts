// The tree of messages and signals, with search; each signal's row has a small picture of its whole course.

import type { FieldInfo, MessageInfo, SignalInfo } from '../api';
import type { App } from '../model/app';
import { count, idText, plural } from '../model/format';
import { type Item, fieldItem, fieldLabel } from '../model/panels';
import { el, replace, setText } from '../ui/dom';
import { match } from '../ui/palette';
import { CanvasPen } from './pen';
import { readColours } from './colours';
import { askSeries } from './series-cache';
import { drawSparkline } from './sparkline';

const LOOK = 'Numbers that protocols name …';
const DRAG_TYPE = 'application/x-cantap-signal';

export class SignalTree {
  readonly element: HTMLElement;
  readonly #search = el('input', { attrs: { type: 'search', placeholder: 'Search messages and signals', 'aria-label': 'Search messages and signals', spellcheck: 'false' } });
  readonly #list = el('div', { class: 'tree', attrs: { role: 'tree', 'aria-label': 'Messages and signals' } });
  readonly #fieldsState = el('p', { class: 'muted fields-state', attrs: { role: 'status', hidden: true } });
  readonly #state = el('p', { class: 'muted', attrs: { role: 'status' } });
  /** Messages that were opened or closed by hand. */
  readonly #open = new Map<string, boolean>();
  readonly #observer: IntersectionObserver;
  readonly #pictures = new WeakMap<Element, Exclude<Item, { kind: 'load' }>>();

  constructor(
    private readonly app: App,
    private readonly added: () => void,
  ) {
    this.#observer = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        if (!entry.isIntersecting) continue;
        this.#observer.unobserve(entry.target);
        const item = this.#pictures.get(entry.target);
        if (item) void this.#picture(entry.target as HTMLCanvasElement, item);
      }
    });
    this.#search.addEventListener('input', () => this.show());
    this.#list.addEventListener('keydown', (event) => this.#key(event));
    this.element = el('aside', { class: 'signal-tree', attrs: { 'aria-label': 'Signals' } }, this.#search, this.#state, this.#fieldsState, this.#list);
    app.on('messages', () => this.show());
    app.on('fields', () => this.show());
    app.on('fields-read', () => this.#states());
    app.on('panels', () => this.#marks());
    app.on('steady', () => {
      if (this.#list.childElementCount === 0) this.show();
    });
  }

  focus(): void {
    this.#search.focus();
  }

  show(): void {
    const query = this.#search.value.trim();
    const { messages, summary } = this.app;
    const rows: HTMLElement[] = (summary?.channels ?? []).filter((c) => query === '' || match(query, `bus load channel ${c.channel}`) !== null).map((c) => this.#loadRow(c.channel, c.bitrate));
    let shown = 0;
    for (const message of [...messages].sort((a, b) => Number(b.count > 0) - Number(a.count > 0) || a.name.localeCompare(b.name))) {
      const name = match(query, `${message.name} ${idText(message.id, message.extended)}`) !== null;
      const signals = name ? message.signals : message.signals.filter((s) => match(query, `${message.name} ${s.name} ${s.comment}`) !== null);
      if (!name && signals.length === 0) continue;
      shown += signals.length;
      const key = `${message.key}`;
      const open = this.#open.get(key) ?? ((query !== '' && shown < 60) || messages.length <= 6);
      rows.push(this.#messageRow(message, key, open));
      if (open) rows.push(...signals.map((signal) => this.#signalRow(message, signal)));
    }
    rows.push(...this.#fieldRows(query));
    replace(this.#list, ...rows);
    setText(this.#state, messages.length === 0 ? 'No database: add one (DBC, KCD, SYM, ARXML) to see signals, take bits in the view “Bits”, or see what protocols name.' : `${plural(messages.length, 'message')}, ${plural(shown, 'signal')}`);
    this.#states();
    const first = this.#list.querySelector<HTMLElement>('[role=treeitem]');
    if (first) first.tabIndex = 0;
    this.#marks();
  }

  /** What protocols have in their messages, by who says which of them. */
  #fieldRows(query: string): HTMLElement[] {
    const { fields } = this.app;
    if (!fields.wanted) {
      if (query !== '' && match(query, LOOK) === null) return [];
      const row = el('div', { class: 'tree-message tree-look', title: 'Reads the trace by the protocols that it shows', attrs: { role: 'treeitem', tabindex: -1, 'aria-level': 1 } }, el('span', { class: 'tree-name' }, LOOK));
      row.addEventListener('click', () => {
        fields.look();
        this.show();
      });
      return [row];
    }
    const groups = new Map<string, FieldInfo[]>();
    for (const field of fields.list) {
      if (query !== '' && match(query, `${field.message} ${field.between} ${field.name} ${field.which}`) === null) continue;
      const of = `fields ${field.channel} ${field.name.split('.')[0]} ${field.between} ${field.message}`;
      groups.set(of, [...(groups.get(of) ?? []), field]);
    }
    const rows: HTMLElement[] = [];
    for (const [key, list] of [...groups].sort(([a], [b]) => a.localeCompare(b))) {
      const open = this.#open.get(key) ?? (query !== '' || groups.size <= 6);
      const [first] = list as [FieldInfo];
      const frames = Math.max(...list.map((field) => field.count));
      rows.push(this.#groupRow(key, `${first.between} ${first.message}`, first.name.split('.')[0] ?? '', `Channel ${first.channel}`, frames, open));
      if (open) rows.push(...list.map((field) => this.#fieldRow(field)));
    }
    return rows;
  }

  #fieldRow(field: FieldInfo): HTMLElement {
    const picture = this.#canvas(fieldItem(field) as Exclude<Item, { kind: 'load' }>);
    return this.#row(fieldItem(field), fieldLabel(field), field.unit, field.name, picture);
  }

  /** How far the trace was read by its protocols. */
  #states(): void {
    const { wanted, list, read, reading, leftOut } = this.app.fields;
    this.#fieldsState.hidden = !wanted;
    const found = reading ? `${count(read)} of ${plural(this.app.summary?.records ?? 0, 'record')} read by protocols` : list.length === 0 ? 'No protocol has a number here' : `${plural(list.length, 'number')} of protocols`;
    setText(this.#fieldsState, `${found}${leftOut > 0 ? `; ${plural(leftOut, 'value')} left out, because there are too many` : ''}`);
  }

  #messageRow(message: MessageInfo, key: string, open: boolean): HTMLElement {
    return this.#groupRow(key, message.name, idText(message.id, message.extended), message.comment, message.count, open);
  }

  #groupRow(key: string, name: string, about: string, comment: string, frames: number, open: boolean): HTMLElement {
    const row = el(
      'div',
      { class: `tree-message${frames === 0 ? ' muted' : ''}`, title: comment, attrs: { role: 'treeitem', tabindex: -1, 'aria-level': 1, 'aria-expanded': String(open) } },
      el('span', { class: 'twist', attrs: { 'aria-hidden': 'true' } }, open ? '▾' : '▸'),
      el('span', { class: 'tree-name' }, name),
      el('span', { class: 'mono muted' }, about),
      el('span', { class: 'mono number' }, frames === 0 ? 'absent' : count(frames)),
    );
    row.addEventListener('click', () => {
      this.#open.set(key, !open);
      this.show();
      this.#focusText(name);
    });
    return row;
  }

  #canvas(item: Exclude<Item, { kind: 'load' }>): HTMLCanvasElement {
    const picture = el('canvas', { class: 'sparkline', attrs: { width: 160, height: 36, 'aria-hidden': 'true' } });
    this.#pictures.set(picture, item);
    this.#observer.observe(picture);
    return picture;
  }

  #signalRow(message: MessageInfo, signal: SignalInfo): HTMLElement {
    const item = { kind: 'signal', channel: message.channel, id: message.id, extended: message.extended, signal: signal.name, info: signal, message: message.name } as const;
    return this.#row(item, signal.name, signal.unit, signal.comment, this.#canvas(item));
  }

  #loadRow(channel: number, bitrate: number | null): HTMLElement {
    const item: Item = { kind: 'load', channel };
    return this.#row(item, `Bus load, channel ${channel}`, bitrate === null ? 'no bit rate' : '%', bitrate === null ? 'The trace gives no bit rate: set it in the summary.' : '', null);
  }

  #row(item: Item, name: string, unit: string, comment: string, picture: HTMLCanvasElement | null): HTMLElement {
    const row = el(
      'div',
      { class: 'tree-signal', title: comment, attrs: { role: 'treeitem', tabindex: -1, 'aria-level': picture ? 2 : 1, draggable: 'true' } },
      el('span', { class: 'tick', attrs: { 'aria-hidden': 'true' } }),
      el('span', { class: 'tree-name' }, name),
      el('span', { class: 'muted' }, unit),
      picture,
    );
    row.addEventListener('click', () => this.#toggle(item));
    row.addEventListener('dragstart', (event) => event.dataTransfer?.setData(DRAG_TYPE, JSON.stringify(dragged(item))));
    this.#items.set(row, item);
    return row;
  }

  readonly #items = new WeakMap<Element, Item>();

  #toggle(item: Item): void {
    if (this.app.panels.has(item)) this.app.panels.removeEverywhere(item);
    else this.app.panels.add(item);
    this.added();
  }

  #marks(): void {
    for (const row of this.#list.children) {
      const item = this.#items.get(row);
      if (!item) continue;
      const on = this.app.panels.has(item);
      row.setAttribute('aria-selected', String(on));
      setText(row.firstElementChild as Element, on ? '✓' : '');
    }
  }

  #key(event: KeyboardEvent): void {
    const rows = [...this.#list.querySelectorAll<HTMLElement>('[role=treeitem]')];
    const at = rows.indexOf(event.target as HTMLElement);
    if (at < 0) return;
    const row = rows[at] as HTMLElement;
    const expanded = row.getAttribute('aria-expanded');
    const moves: Record<string, number> = { ArrowDown: at + 1, ArrowUp: at - 1, Home: 0, End: rows.length - 1 };
    const next = rows[moves[event.key] ?? -1];
    if (next) {
      row.tabIndex = -1;
      next.tabIndex = 0;
      next.focus();
    } else if (event.key === 'Enter' || event.key === ' ' || (event.key === 'ArrowRight' && expanded === 'false') || (event.key === 'ArrowLeft' && expanded === 'true')) row.click();
    else return;
    event.preventDefault();
  }

  #focusText(name: string): void {
    for (const row of this.#list.querySelectorAll<HTMLElement>('.tree-message')) {
      if (row.querySelector('.tree-name')?.textContent === name) {
        row.tabIndex = 0;
        row.focus();
        return;
      }
    }
  }

  async #picture(canvas: HTMLCanvasElement, item: Exclude<Item, { kind: 'load' }>): Promise<void> {
    try {
      const whole = this.app.whole();
      const series = await askSeries(this.app, item, whole, 80);
      const context = canvas.getContext('2d');
      if (!context || !series) return;
      context.scale(2, 2);
      drawSparkline(new CanvasPen(context), series, whole, 80, 18, readColours(canvas).lines[0] ?? 'gray');
    } catch {
      // A picture less: the signal's row itself says all that is needed.
    }
  }
}

function dragged(item: Item): unknown {
  return item.kind === 'signal' ? { kind: item.kind, channel: item.channel, id: item.id, extended: item.extended, signal: item.signal } : item;
}

/** The signal that is dropped; null if it is something else. */
export function droppedItem(transfer: DataTransfer | null, app: App): Item | null {
  const text = transfer?.getData(DRAG_TYPE);
  if (!text) return null;
  const item = JSON.parse(text) as Item;
  if (item.kind === 'field') return { ...item, info: app.fields.list.find((field) => field.key === item.info?.key) ?? null };
  if (item.kind !== 'signal') return item;
  const message = app.messages.find((m) => m.id === item.id && m.extended === item.extended && m.channel === item.channel);
  return { ...item, info: message?.signals.find((s) => s.name === item.signal) ?? null, message: message?.name ?? '' };
}
