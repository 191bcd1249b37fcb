// Which graphs stand one above the other, and what each of them draws. Signals are kept by name, so that they outlive a change of the database.

import type { FieldInfo, MessageInfo, SignalEdit, SignalInfo } from '../api';
import type { Profile, ProfileItem } from './storage';

export type Style = 'step' | 'line' | 'points';

export type Item =
  | { kind: 'signal'; channel: number | null; id: number; extended: boolean; signal: string; info: SignalInfo | null; message: string }
  | { kind: 'load'; channel: number }
  | (FieldName & { kind: 'field'; info: FieldInfo | null })
  | { kind: 'raw'; edit: SignalEdit };

/** What tells a protocol's number from the others. */
export interface FieldName {
  channel: number;
  name: string;
  between: string;
  message: string;
  which: string;
}

export interface Panel {
  /** Stable while the page lives. */
  number: number;
  items: Item[];
  style: Style;
}

export class Panels {
  list: Panel[] = [];
  #next = 1;

  constructor(private readonly changed: () => void) {}

  /** Adds a signal to a panel, or below all in one of its own. */
  add(item: Item, panel: Panel | null = null): void {
    const target = panel ?? this.#append();
    if (!target.items.some((other) => sameItem(other, item))) target.items.push(item);
    this.changed();
  }

  addSignal(message: MessageInfo, signal: SignalInfo, panel: Panel | null = null): void {
    this.add({ kind: 'signal', channel: message.channel, id: message.id, extended: message.extended, signal: signal.name, info: signal, message: message.name }, panel);
  }

  has(item: Item): boolean {
    return this.list.some((panel) => panel.items.some((other) => sameItem(other, item)));
  }

  removeItem(panel: Panel, item: Item): void {
    panel.items = panel.items.filter((other) => other !== item);
    this.list = this.list.filter((p) => p.items.length > 0);
    this.changed();
  }

  /** Takes an item out wherever it is drawn. */
  removeEverywhere(item: Item): void {
    for (const panel of this.list) panel.items = panel.items.filter((other) => !sameItem(other, item));
    this.list = this.list.filter((p) => p.items.length > 0);
    this.changed();
  }

  clear(): void {
    this.list = [];
    this.changed();
  }

  /** Moves one item into another panel. */
  moveItem(from: Panel, item: Item, to: Panel): void {
    if (from === to) return;
    from.items = from.items.filter((other) => other !== item);
    if (!to.items.some((other) => sameItem(other, item))) to.items.push(item);
    this.list = this.list.filter((p) => p.items.length > 0);
    this.changed();
  }

  /** Joins a panel with the one above it. */
  mergeUp(panel: Panel): void {
    const above = this.list[this.list.indexOf(panel) - 1];
    if (!above) return;
    for (const item of panel.items) if (!above.items.some((other) => sameItem(other, item))) above.items.push(item);
    this.list = this.list.filter((p) => p !== panel);
    this.changed();
  }

  /** Gives each item of a panel one of its own. */
  split(panel: Panel): void {
    const at = this.list.indexOf(panel);
    if (at < 0 || panel.items.length < 2) return;
    const parts = panel.items.map((item) => ({ number: this.#next++, items: [item], style: panel.style }));
    this.list.splice(at, 1, ...parts);
    this.changed();
  }

  movePanel(panel: Panel, by: -1 | 1): void {
    const at = this.list.indexOf(panel);
    const other = this.list[at + by];
    if (!other) return;
    this.list[at + by] = panel;
    this.list[at] = other;
    this.changed();
  }

  setStyle(panel: Panel, style: Style): void {
    panel.style = style;
    this.changed();
  }

  /** Finds each signal in the databases that are loaded now. */
  resolve(messages: MessageInfo[]): void {
    for (const panel of this.list) {
      for (const item of panel.items) {
        if (item.kind !== 'signal') continue;
        const message =
          messages.find((m) => m.id === item.id && m.extended === item.extended && (item.channel === null || m.channel === null || m.channel === item.channel)) ?? null;
        item.info = message?.signals.find((s) => s.name === item.signal) ?? null;
        item.message = message?.name ?? item.message;
      }
    }
  }

  /** Finds each number in those that protocols have now. */
  resolveFields(fields: readonly FieldInfo[]): void {
    for (const panel of this.list) for (const item of panel.items) if (item.kind === 'field') item.info = fields.find((field) => sameField(field, item)) ?? null;
  }

  /** Whether one of a protocol's numbers is to be drawn. */
  get hasFields(): boolean {
    return this.list.some((panel) => panel.items.some((item) => item.kind === 'field'));
  }

  profile(): Profile['panels'] {
    return this.list.map((panel) => ({ style: panel.style, items: panel.items.flatMap(profileItem) })).filter((p) => p.items.length > 0);
  }

  restore(panels: Profile['panels']): void {
    this.list = panels
      .map((panel) => ({
        number: this.#next++,
        style: panel.style === 'line' || panel.style === 'points' ? panel.style : ('step' as Style),
        items: panel.items.map((item): Item => (item.kind === 'load' ? { ...item } : item.kind === 'field' ? { ...item, info: null } : { ...item, info: null, message: '' })),
      }))
      .filter((p) => p.items.length > 0);
  }

  #append(): Panel {
    const panel: Panel = { number: this.#next++, items: [], style: 'step' };
    this.list.push(panel);
    return panel;
  }
}

function sameField(a: FieldName, b: FieldName): boolean {
  return a.channel === b.channel && a.name === b.name && a.between === b.between && a.message === b.message && a.which === b.which;
}

/** An item that draws a protocol's number. */
export function fieldItem(info: FieldInfo): Item {
  const { channel, name, between, message, which } = info;
  return { kind: 'field', channel, name, between, message, which, info };
}

/** A protocol's number, without its protocol. */
export function fieldLabel({ name, which }: FieldName): string {
  const short = name.slice(name.indexOf('.') + 1);
  return which === '' ? short : `${short} (${which})`;
}

export function sameItem(a: Item, b: Item): boolean {
  if (a.kind === 'field') return b.kind === 'field' && sameField(a, b);
  if (a.kind === 'load') return b.kind === 'load' && a.channel === b.channel;
  if (a.kind === 'raw') return b.kind === 'raw' && a.edit.channel === b.edit.channel && a.edit.id === b.edit.id && a.edit.extended === b.edit.extended && a.edit.name === b.edit.name;
  return b.kind === 'signal' && a.id === b.id && a.extended === b.extended && a.channel === b.channel && a.signal === b.signal;
}

export function itemLabel(item: Item): string {
  if (item.kind === 'load') return `Bus load, channel ${item.channel}`;
  if (item.kind === 'raw') return item.edit.name;
  if (item.kind === 'field') return `${item.between} ${item.message}: ${fieldLabel(item)}`;
  return item.message ? `${item.message}.${item.signal}` : item.signal;
}

export function itemUnit(item: Item): string {
  if (item.kind === 'load') return '%';
  if (item.kind === 'raw') return item.edit.unit;
  return item.info?.unit ?? '';
}

export function itemTexts(item: Item): { value: number; text: string }[] {
  if (item.kind === 'signal' || item.kind === 'field') return item.info?.texts ?? [];
  return item.kind === 'raw' ? item.edit.texts : [];
}

function profileItem(item: Item): ProfileItem[] {
  if (item.kind === 'load') return [{ kind: 'load', channel: item.channel }];
  if (item.kind === 'field') return [{ kind: 'field', channel: item.channel, name: item.name, between: item.between, message: item.message, which: item.which }];
  if (item.kind === 'signal') return [{ kind: 'signal', channel: item.channel, id: item.id, extended: item.extended, signal: item.signal }];
  return [];
}
