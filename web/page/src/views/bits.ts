// An identifier's bits: a grid of bytes with the heat of their changes, signals drawn into it, and a field that is marked to become a signal.

import type { BitGrid, SignalInfo } from '../api';
import type { App } from '../model/app';
import { bitOfCell, borders, cellsOf, fieldBetween } from '../model/bit-layout';
import { bytesText, duration, percent, plural, shortCount } from '../model/format';
import type { Commands } from '../ui/commands';
import { button, el, replace, select, setText } from '../ui/dom';
import { SignalEditor } from './signal-editor';
import { OfIdentifier } from './of-identifier';
import type { View } from './view';

/** What counts: the whole trace, what the graphs show, or what lies between the cursors. */
type Window = 'all' | 'view' | 'marked';

export class BitsView implements View {
  readonly id = 'bits';
  readonly title = 'Bits';
  readonly element: HTMLElement;
  readonly #chosen: OfIdentifier;
  readonly #grid = el('div', { class: 'bit-grid', attrs: { role: 'grid', tabindex: 0, 'aria-label': 'Bits: arrows move, Shift and arrows mark, Enter makes a signal' } });
  readonly #legend = el('div', { class: 'bit-legend' });
  readonly #state = el('span', { class: 'state', attrs: { role: 'status' } });
  readonly #about = el('p', { class: 'bit-about mono', attrs: { 'aria-live': 'polite' } });
  readonly #editor: SignalEditor;
  #window: Window = 'all';
  #bits: BitGrid | null = null;
  #anchor = 0;
  #at = 0;
  #dragging = false;

  constructor(
    private readonly app: App,
    commands: Commands,
  ) {
    this.#chosen = new OfIdentifier(app, () => this.#fetch());
    this.#editor = new SignalEditor(app, () => this.#markedField(), () => this.#mark());
    const windows = select(
      [
        ['all', 'whole trace'],
        ['view', 'what the graphs show'],
        ['marked', 'between the cursors'],
      ],
      this.#window,
      (value) => {
        this.#window = value as Window;
        this.#chosen.ask();
      },
      'Stretch of time',
    );
    const bar = el(
      'div',
      { class: 'bar' },
      ...this.#chosen.controls,
      windows,
      button('Undo', () => void this.#editor.undo(), { title: 'Undo the last change of a signal (Ctrl+Z)' }),
      button('Redo', () => void this.#editor.redo(), { title: 'Redo (Ctrl+Y)' }),
      button('Save DBC', () => this.#editor.save(), { title: 'Save the signals that were made here' }),
      this.#state,
    );
    this.element = el('section', { class: 'view view-bits', attrs: { 'aria-label': 'Bits' } }, bar, el('div', { class: 'split bits-split' }, el('div', { class: 'bit-side' }, this.#grid, this.#about, this.#legend), this.#editor.element));
    this.#grid.addEventListener('keydown', (event) => this.#key(event));
    this.#grid.addEventListener('pointerdown', (event) => this.#down(event));
    this.#grid.addEventListener('pointermove', (event) => this.#move(event));
    addEventListener('pointerup', () => (this.#dragging = false));
    app.on('messages', () => this.#chosen.ask());
    app.on('range', () => this.#window === 'view' && this.#chosen.ask());
    app.on('cursors', () => this.#window === 'marked' && this.#chosen.ask());
    commands.add(
      ...this.#chosen.commands(this.id, this.title),
      { id: 'bits.signal', title: 'Bits: make a signal of the marked bits', keys: ['s'], view: this.id, run: () => this.#editor.begin() },
      { id: 'bits.undo', title: 'Bits: undo the last change of a signal', keys: ['Ctrl+z'], view: this.id, run: () => void this.#editor.undo() },
      { id: 'bits.redo', title: 'Bits: redo', keys: ['Ctrl+y', 'Ctrl+Shift+z'], view: this.id, run: () => void this.#editor.redo() },
      { id: 'bits.save', title: 'Bits: save the signals made here as DBC', keys: ['Ctrl+s'], view: this.id, run: () => this.#editor.save() },
    );
  }

  shown(): void {
    this.#chosen.shown();
  }

  hidden(): void {
    this.#chosen.hidden();
  }

  async #fetch(): Promise<void> {
    const chosen = this.app.identifier;
    if (!chosen) return;
    const range = this.#window === 'view' ? this.app.range : this.#window === 'marked' ? this.app.marked : { from: -Infinity, to: Infinity };
    if (!range) {
      setText(this.#state, 'Put the cursors A and B first (keys a and b in trace or graphs).');
      return;
    }
    this.#bits = await this.app.ask('bits', { ...chosen, from: range.from, to: range.to });
    this.#draw();
    this.#editor.identifierChanged(chosen, this.#bits);
  }

  #markedField(): { startBit: number; bitLength: number; littleEndian: boolean } {
    return fieldBetween(this.#anchor, this.#at, this.#editor.littleEndian);
  }

  #draw(): void {
    const bits = this.#bits;
    if (!bits) return;
    // The period is that of the newest frames, and not of a stretch.
    const period = this.#window === 'all' ? this.#chosen.picker.row?.period : null;
    setText(this.#state, `${plural(bits.frames, 'frame')}${period ? `, lately one every ${duration(period.median)}` : ''}`);
    const cells = bits.length * 8;
    this.#anchor = Math.min(this.#anchor, Math.max(0, cells - 1));
    this.#at = Math.min(this.#at, Math.max(0, cells - 1));
    const places = bits.signals.map((signal) => new Set(cellsOf(signal)));
    const last = bytesText(this.#chosen.picker.row?.lastData ?? '').split(' ');
    const rows: HTMLElement[] = [el('div', { class: 'bit-row head', attrs: { role: 'row' } }, el('span', { attrs: { role: 'columnheader' } }, 'Byte'), ...[7, 6, 5, 4, 3, 2, 1, 0].map((b) => el('span', { attrs: { role: 'columnheader' } }, String(b))), el('span', { title: 'The newest data of the trace', attrs: { role: 'columnheader' } }, 'last'))];
    for (let byte = 0; byte < bits.length; byte++) {
      const row = el('div', { class: 'bit-row', attrs: { role: 'row' } }, el('span', { class: 'mono', attrs: { role: 'rowheader' } }, String(byte)));
      for (let column = 0; column < 8; column++) row.append(this.#cell(bits, byte * 8 + column, places));
      row.append(el('span', { class: 'mono last-byte', attrs: { role: 'gridcell' } }, last[byte] ?? ''));
      rows.push(row);
    }
    replace(this.#grid, ...rows);
    replace(this.#legend, ...bits.signals.map((signal, i) => this.#legendEntry(signal, i)), bits.signals.length === 0 ? el('p', { class: 'muted' }, 'No database knows a signal here. Mark bits and press s to make one.') : null);
    this.#mark();
  }

  #cell(bits: BitGrid, cell: number, places: readonly Set<number>[]): HTMLElement {
    const flips = bits.flips[cell] ?? 0;
    const ones = bits.ones[cell] ?? 0;
    const share = bits.frames > 1 ? flips / (bits.frames - 1) : 0;
    // Rare changes must be seen, too: the square root lifts them.
    const heat = flips === 0 ? 0 : Math.max(1, Math.ceil(Math.sqrt(share) * 9));
    // A bit that is always 1 is not one that changed once.
    const shown = flips === 0 ? (ones > 0 ? '=1' : '=0') : shortCount(flips);
    const element = el('span', { class: `bit heat${heat}`, id: `bit-${cell}`, attrs: { role: 'gridcell', 'aria-label': `${shown}, byte ${cell >> 3} bit ${bitOfCell(cell) & 7}: ${plural(flips, 'change')}, 1 in ${ones} of ${plural(bits.frames, 'frame')}` } }, shown);
    element.dataset['cell'] = String(cell);
    let depth = 0;
    for (const [i, cells] of places.entries()) {
      if (!cells.has(cell)) continue;
      const side = borders(cell, cells);
      const outline = el('i', { class: `outline line-${i % 8} depth${Math.min(depth, 3)}${side.top ? ' top' : ''}${side.right ? ' right' : ''}${side.bottom ? ' bottom' : ''}${side.left ? ' left' : ''}`, attrs: { 'aria-hidden': 'true' } });
      element.append(outline);
      depth++;
    }
    return element;
  }

  #legendEntry(signal: SignalInfo, i: number): HTMLElement {
    const about = `${signal.startBit}|${signal.bitLength}@${signal.littleEndian ? 1 : 0}${signal.signed ? '−' : '+'}${signal.multiplex ? ` ${signal.multiplex}` : ''}`;
    const entry = button(signal.name, () => this.#editor.edit(signal), { class: `signal-entry line-${i % 8}`, title: `${signal.comment}\nEdit a copy of it in your own database`.trim() });
    entry.append(' ', el('span', { class: 'mono muted' }, about));
    return entry;
  }

  #mark(): void {
    const bits = this.#bits;
    if (!bits || bits.length === 0) return;
    const field = this.#markedField();
    const marked = new Set(cellsOf(field));
    for (const cell of this.#grid.querySelectorAll<HTMLElement>('.bit')) {
      const number = Number(cell.dataset['cell']);
      cell.classList.toggle('marked', marked.has(number));
      cell.classList.toggle('at', number === this.#at);
      cell.setAttribute('aria-selected', String(marked.has(number)));
    }
    this.#grid.setAttribute('aria-activedescendant', `bit-${this.#at}`);
    const at = this.#at;
    const flips = bits.flips[at] ?? 0;
    const names = bits.signals.filter((s) => cellsOf(s).includes(at)).map((s) => s.name);
    setText(this.#about, `byte ${at >> 3} bit ${bitOfCell(at) & 7}: ${flips === 0 ? 'never changed' : plural(flips, 'change')}, set in ${percent(bits.frames ? (bits.ones[at] ?? 0) / bits.frames : null)} of the frames${names.length > 0 ? `, in ${names.join(', ')}` : ''} · marked: start ${field.startBit}, ${field.bitLength} bit, ${field.littleEndian ? 'little' : 'big'}-endian`);
    this.#editor.markedChanged();
  }

  #key(event: KeyboardEvent): void {
    const cells = (this.#bits?.length ?? 0) * 8;
    const moves: Record<string, number> = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -8, ArrowDown: 8 };
    const by = moves[event.key];
    if (by !== undefined) {
      event.preventDefault();
      const next = this.#at + by;
      if (next < 0 || next >= cells) return;
      this.#at = next;
      if (!event.shiftKey) this.#anchor = next;
      this.#mark();
    } else if (event.key === 'Enter') {
      event.preventDefault();
      this.#editor.begin();
    }
  }

  #cellAt(event: PointerEvent): number | null {
    const cell = document.elementFromPoint(event.clientX, event.clientY)?.closest<HTMLElement>('.bit');
    return cell?.dataset['cell'] === undefined ? null : Number(cell.dataset['cell']);
  }

  #down(event: PointerEvent): void {
    const cell = this.#cellAt(event);
    if (cell === null) return;
    this.#dragging = true;
    this.#at = cell;
    if (!event.shiftKey) this.#anchor = cell;
    this.#mark();
  }

  #move(event: PointerEvent): void {
    if (!this.#dragging) return;
    const cell = this.#cellAt(event);
    if (cell === null || cell === this.#at) return;
    this.#at = cell;
    this.#mark();
  }
}
