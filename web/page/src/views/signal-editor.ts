// Makes a signal of marked bits, or changes one: what it would look like is drawn while it is typed. Signals made here are the user's own
// database, which is undone and redone as a whole and saved as a DBC.

import type { BitGrid, SignalEdit, SignalInfo } from '../api';
import type { App, Identifier } from '../model/app';
import { type BitField, cellsOf } from '../model/bit-layout';
import { save } from '../model/files';
import { idText, plural, quantity } from '../model/format';
import { Latest } from '../model/latest';
import { button, el, field, setText } from '../ui/dom';
import { readColours } from '../graph/colours';
import { CanvasPen } from '../graph/pen';
import { drawSparkline } from '../graph/sparkline';

const PICTURE = { width: 320, height: 90 };

/** What a DBC allows as a name (DBC file format, "C_identifier"). */
const NAME = /^[A-Za-z_][A-Za-z0-9_]{0,127}$/;

export class SignalEditor {
  readonly element: HTMLElement;
  readonly #message = text('Message');
  readonly #name = text('Signal name');
  readonly #start = number('Start bit', '0');
  readonly #length = number('Bits', '1');
  readonly #little = el('input', { attrs: { type: 'checkbox', 'aria-label': 'Little-endian (Intel)' } });
  readonly #signed = el('input', { attrs: { type: 'checkbox', 'aria-label': 'Signed' } });
  readonly #factor = number('Factor', '1');
  readonly #offset = number('Offset', '0');
  readonly #unit = text('Unit');
  readonly #texts = el('textarea', { attrs: { rows: 3, 'aria-label': 'Texts of values', placeholder: '0 off\n1 on', spellcheck: 'false' } });
  readonly #picture = el('canvas', { attrs: { width: PICTURE.width * 2, height: PICTURE.height * 2, role: 'img', 'aria-label': 'Course of the signal' } });
  readonly #range = el('p', { class: 'mono', attrs: { role: 'status' } });
  readonly #problem = el('p', { class: 'bad', attrs: { role: 'alert' } });
  readonly #preview: Latest<null>;
  #identifier: Identifier | null = null;
  #bits: BitGrid | null = null;

  constructor(
    private readonly app: App,
    private readonly marked: () => BitField,
    orderChanged: () => void,
  ) {
    this.#little.checked = true;
    this.#preview = new Latest(() => this.#draw(), (error) => setText(this.#problem, error instanceof Error ? error.message : String(error)));
    const form = el(
      'form',
      { class: 'editor-form', attrs: { 'aria-label': 'Signal' } },
      el('h3', {}, 'Signal of the marked bits'),
      this.#picture,
      this.#range,
      field('Message', this.#message),
      field('Name', this.#name),
      el('div', { class: 'pair' }, field('Start bit', this.#start), field('Bits', this.#length)),
      el('div', { class: 'pair' }, field('Little-endian', this.#little), field('Signed', this.#signed)),
      el('div', { class: 'pair' }, field('Factor', this.#factor), field('Offset', this.#offset)),
      field('Unit', this.#unit),
      field('Texts of values', this.#texts, 'one a line: number, blank, text'),
      this.#problem,
      el('div', { class: 'dialog-actions' }, el('button', { class: 'primary', attrs: { type: 'submit' } }, 'Make the signal'), button('Only draw it', () => this.#drawOnly())),
    );
    form.addEventListener('submit', (event) => {
      event.preventDefault();
      void this.#make();
    });
    form.addEventListener('input', () => this.#preview.ask(null));
    this.#little.addEventListener('change', orderChanged);
    this.element = el('aside', { class: 'signal-editor', attrs: { 'aria-label': 'Signal editor', tabindex: 0 } }, form);
    app.on('own', () => this.#preview.ask(null));
  }

  get littleEndian(): boolean {
    return this.#little.checked;
  }

  identifierChanged(identifier: Identifier, bits: BitGrid): void {
    const other = this.#identifier === null || this.#identifier.id !== identifier.id || this.#identifier.channel !== identifier.channel || this.#identifier.extended !== identifier.extended;
    this.#identifier = identifier;
    this.#bits = bits;
    if (other) {
      const known = this.app.messages.find((m) => m.id === identifier.id && m.extended === identifier.extended && (m.channel === null || m.channel === identifier.channel));
      this.#message.value = known?.name ?? `Msg_${idText(identifier.id, identifier.extended)}`;
      this.#name.value = '';
    }
    this.#preview.ask(null);
  }

  markedChanged(): void {
    const marked = this.marked();
    this.#start.value = String(marked.startBit);
    this.#length.value = String(marked.bitLength);
    this.#preview.ask(null);
  }

  /** Leads the keyboard to the form. */
  begin(): void {
    if (this.#name.value === '') this.#name.value = `Bits_${this.#start.value}_${this.#length.value}`;
    this.#name.focus();
    this.#name.select();
  }

  edit(signal: SignalInfo): void {
    this.#name.value = signal.name;
    this.#start.value = String(signal.startBit);
    this.#length.value = String(signal.bitLength);
    this.#little.checked = signal.littleEndian;
    this.#signed.checked = signal.signed;
    this.#factor.value = String(signal.factor);
    this.#offset.value = String(signal.offset);
    this.#unit.value = signal.unit;
    this.#texts.value = signal.texts.map((t) => `${t.value} ${t.text}`).join('\n');
    this.#name.focus();
    this.#preview.ask(null);
  }

  /** What the form says, or why it cannot be. */
  #read(): SignalEdit | string {
    const identifier = this.#identifier;
    if (!identifier) return 'Choose an identifier first.';
    const edit: SignalEdit = {
      ...identifier,
      messageName: this.#message.value.trim(),
      name: this.#name.value.trim() || 'preview',
      startBit: Number(this.#start.value),
      bitLength: Number(this.#length.value),
      littleEndian: this.#little.checked,
      signed: this.#signed.checked,
      factor: Number(this.#factor.value),
      offset: Number(this.#offset.value),
      unit: this.#unit.value.trim(),
      texts: [],
    };
    if (!NAME.test(edit.messageName) || !NAME.test(edit.name)) return 'Names in a DBC are letters, digits and underscores, a letter first.';
    if (!Number.isInteger(edit.bitLength) || edit.bitLength < 1 || edit.bitLength > 64) return 'A signal has 1 to 64 bits.';
    const size = (this.#bits?.length ?? 0) * 8;
    if (!Number.isInteger(edit.startBit) || edit.startBit < 0 || cellsOf(edit).some((cell) => cell < 0 || cell >= size)) return `The field reaches beyond the frame’s ${size} bits: choose another start or length.`;
    if (!Number.isFinite(edit.factor) || edit.factor === 0) return 'The factor is a number other than 0.';
    if (!Number.isFinite(edit.offset)) return 'The offset is a number.';
    for (const line of this.#texts.value.split('\n').filter((l) => l.trim() !== '')) {
      const parts = /^\s*(-?\d+)\s+(.+)$/.exec(line);
      if (!parts) return `“${line.trim()}”: a text of a value is a whole number, a blank and the text.`;
      edit.texts.push({ value: Number(parts[1]), text: (parts[2] ?? '').trim() });
    }
    return edit;
  }

  async #draw(): Promise<void> {
    const edit = this.#read();
    if (typeof edit === 'string') {
      setText(this.#problem, edit);
      return;
    }
    const whole = this.app.whole();
    const series = await this.app.ask('rawSeries', { ...edit, ...whole, columns: PICTURE.width });
    setText(this.#problem, '');
    const context = this.#picture.getContext('2d');
    if (!context) return;
    const colours = readColours(this.#picture);
    context.setTransform(2, 0, 0, 2, 0, 0);
    const pen = new CanvasPen(context);
    pen.rect(0, 0, PICTURE.width, PICTURE.height, colours.background);
    drawSparkline(pen, series, whole, PICTURE.width, PICTURE.height, colours.lines[0] ?? 'gray');
    let low = Infinity;
    let high = -Infinity;
    for (let i = 0; i < series.time.length; i++) {
      low = Math.min(low, series.min[i] as number);
      high = Math.max(high, series.max[i] as number);
    }
    setText(this.#range, Number.isFinite(low) ? `${quantity(low, edit.unit)} … ${quantity(high, edit.unit)}, ${plural(series.values, 'value')}` : 'no value in this trace');
  }

  #drawOnly(): void {
    const edit = this.#read();
    if (typeof edit === 'string') return;
    this.app.panels.add({ kind: 'raw', edit });
    this.app.notify('info', `${edit.name} is in the graphs.`);
  }

  async #make(): Promise<void> {
    const edit = this.#name.value.trim() === '' ? 'Give the signal a name.' : this.#read();
    if (typeof edit === 'string') {
      setText(this.#problem, edit);
      this.#name.focus();
      return;
    }
    try {
      const { dbc } = await this.app.ask('editSignal', edit);
      this.app.own.push(dbc);
      this.app.changed('signals', false);
      await this.app.refresh();
      this.app.emit('own');
      this.#addToGraphs(edit);
      this.app.notify('info', `${edit.messageName}.${edit.name} is made, and in the graphs.`);
    } catch (error) {
      setText(this.#problem, error instanceof Error ? error.message : String(error));
    }
  }

  #addToGraphs(edit: SignalEdit): void {
    for (const message of this.app.messages) {
      if (message.id !== edit.id || message.extended !== edit.extended || (message.channel !== null && message.channel !== edit.channel)) continue;
      const signal = message.signals.find((s) => s.name === edit.name);
      if (!signal) continue;
      this.app.panels.addSignal(message, signal);
      return;
    }
  }

  async undo(): Promise<void> {
    await this.#step(this.app.own.undo(), 'There is nothing to undo.');
  }

  async redo(): Promise<void> {
    await this.#step(this.app.own.redo(), 'There is nothing to redo.');
  }

  async #step(dbc: string | null, nothing: string): Promise<void> {
    if (dbc === null) {
      this.app.notify('info', nothing);
      return;
    }
    try {
      await this.app.setOwn(dbc);
      this.app.changed('signals', dbc === '');
    } catch (error) {
      this.app.failed(error);
    }
  }

  save(): void {
    if (this.app.own.current === '') this.app.notify('info', 'No signal was made here yet.');
    else {
      this.app.saved('signals');
      save('own.dbc', this.app.own.current);
    }
  }
}

function text(label: string): HTMLInputElement {
  return el('input', { attrs: { type: 'text', 'aria-label': label, spellcheck: 'false', autocomplete: 'off' } });
}

function number(label: string, value: string): HTMLInputElement {
  return el('input', { class: 'mono', attrs: { type: 'text', inputmode: 'decimal', 'aria-label': label, value } });
}
