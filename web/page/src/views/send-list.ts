// Frames to be sent: once, or periodically by the device, which changes counters and checksums itself; and the list of those that are sent often.

import type { App } from '../model/app';
import type { Connection } from '../live/connection';
import { parseChanges } from '../live/modifiers';
import type { State } from '../live/protocol';
import { save } from '../model/files';
import { entryText, parseEntry, parseList, type SendEntry } from '../model/send-entry';
import { button, el, field, replace } from '../ui/dom';

export class SendList {
  readonly element: HTMLElement;
  readonly #channel = el('select', { attrs: { 'aria-label': 'Channel to send on' } });
  readonly #frame = el('input', { class: 'mono', id: 'send-frame', attrs: { type: 'text', 'aria-label': 'Frame', placeholder: '123#DEADBEEF or Message:Signal=1', spellcheck: 'false', autocomplete: 'off' } });
  readonly #period = el('input', { class: 'mono', id: 'send-period', attrs: { type: 'text', 'aria-label': 'Period in milliseconds', inputmode: 'decimal', value: '100' } });
  readonly #changes = el('input', { class: 'mono', id: 'send-changes', attrs: { type: 'text', 'aria-label': 'What changes each time', placeholder: 'counter 0.0:4, checksum 1:crc8', spellcheck: 'false', autocomplete: 'off' } });
  readonly #once: HTMLButtonElement;
  readonly #start: HTMLButtonElement;
  readonly #running = el('tbody');
  readonly #list = el('tbody', { id: 'send-list' });
  readonly #runningTable: HTMLElement;
  readonly #listTable: HTMLElement;
  readonly #none = el('p', { class: 'muted' }, 'Nothing is in the send list. It is kept with the layout, and as a file it is the same as that of the live view (cantap monitor, page Send).');
  readonly #hint = el('p', { class: 'muted' });
  #can = false;
  #drawn = '';

  constructor(
    private readonly app: App,
    private readonly live: Connection,
  ) {
    this.#once = button('Send once', () => this.#sendOnce());
    this.#start = button('Send periodically', () => this.#startPeriodic());
    this.#frame.addEventListener('keydown', (event) => event.key === 'Enter' && this.#sendOnce());
    const head = ['Channel', 'Frame', 'Period', ''];
    const heads = (names: string[]): HTMLElement => el('thead', {}, el('tr', {}, ...names.map((h) => el('th', { attrs: { scope: 'col' } }, h))));
    this.#runningTable = el('table', { class: 'numbers' }, el('caption', {}, 'Sent by the device until it is stopped, or no page is open any more'), heads(head), this.#running);
    this.#listTable = el('table', { class: 'numbers' }, el('caption', {}, 'Send list'), heads(['Entry', '']), this.#list);
    this.element = el(
      'div',
      {},
      el('div', { class: 'row' }, field('Channel', this.#channel), field('Frame', this.#frame), this.#once),
      el('div', { class: 'row' }, field('Period / ms', this.#period), field('Changes', this.#changes, 'counter BYTE.LOWBIT:BITS, random BYTE, checksum BYTE:xor|sum|crc8'), this.#start),
      this.#hint,
      this.#runningTable,
      this.#listTable,
      this.#none,
      el('div', { class: 'row' }, button('Add once', () => this.#add(false), { title: 'Puts channel and frame from above into the list' }), button('Add periodic', () => this.#add(true), { title: 'Puts channel, frame, period and changes from above into the list' }), button('Save the list …', () => save('send-list.txt', this.#text()), { id: 'send-save' }), button('Add a file …', () => this.#choose(), { id: 'send-load' })),
    );
    app.on('profile', () => this.#drawList());
    this.#drawList();
  }

  #refused = (error: unknown): void => this.app.failed(error);

  get #on(): { channel: number; frame: string } {
    return { channel: Number(this.#channel.value), frame: this.#frame.value.trim() };
  }

  #sendOnce(): void {
    if (!this.#once.disabled) void this.live.ask('send', this.#on).catch(this.#refused);
  }

  #startPeriodic(): void {
    try {
      const periodMs = Number(this.#period.value.replace(',', '.'));
      if (!(periodMs > 0)) throw new Error(`“${this.#period.value}” is no period: write milliseconds, such as 10 or 0.5.`);
      void this.live.ask('periodic', { ...this.#on, periodMs, modifiers: parseChanges(this.#changes.value) }).catch(this.#refused);
    } catch (error) {
      this.app.failed(error);
    }
  }

  #text(): string {
    return this.app.profile.sendList.map((line) => `${line}\n`).join('');
  }

  #keep(list: string[]): void {
    this.app.profile.sendList = list;
    this.app.saveProfile();
  }

  #add(periodic: boolean): void {
    try {
      const { channel, frame } = this.#on;
      const periodMs = Number(this.#period.value.replace(',', '.'));
      if (periodic && !(periodMs > 0)) throw new Error(`“${this.#period.value}” is no period: write milliseconds, such as 10 or 0.5.`);
      const text = entryText(channel || 1, frame, periodic ? periodMs : null, parseChanges(this.#changes.value));
      this.#keep([...this.app.profile.sendList, parseEntry(text).text]);
    } catch (error) {
      this.app.failed(error);
    }
  }

  #choose(): void {
    const picker = el('input', { attrs: { type: 'file', accept: '.txt,text/plain', 'aria-label': 'Send list' } });
    picker.addEventListener('change', () => {
      const file = picker.files?.[0];
      const failed = (error: unknown): void => this.app.notify('error', `${file?.name}: ${error instanceof Error ? error.message : String(error)}`);
      void file
        ?.text()
        .then((text) => this.#keep([...this.app.profile.sendList, ...parseList(text).map((entry) => entry.text)]))
        .catch(failed);
    });
    picker.click();
  }

  #send({ channel, frame, periodMs, changes }: SendEntry): void {
    const done = periodMs === null ? this.live.ask('send', { channel, frame }) : this.live.ask('periodic', { channel, frame, periodMs, modifiers: changes });
    void done.catch(this.#refused);
  }

  #drawList(): void {
    const { sendList } = this.app.profile;
    this.#none.hidden = sendList.length > 0;
    this.#listTable.hidden = sendList.length === 0;
    const row = (line: string, at: number): HTMLElement => {
      const entry = parseEntry(line);
      const run = button(entry.periodMs === null ? 'Send' : 'Start', () => this.#send(entry), { attrs: { 'aria-label': `${entry.periodMs === null ? 'Send' : 'Start'} ${line}` } });
      run.disabled = !this.#can;
      const remove = button('Remove', () => this.#keep(sendList.filter((_, other) => other !== at)), { attrs: { 'aria-label': `Remove ${line}` } });
      return el('tr', {}, el('td', { class: 'mono' }, line), el('td', {}, run, ' ', remove));
    };
    replace(this.#list, ...sendList.map(row));
  }

  draw(state: State): void {
    const key = JSON.stringify([state.periodic, state.channels.map((c) => c.channel), state.isNormal, state.maySend]);
    if (key === this.#drawn) return;
    this.#drawn = key;
    const chosen = this.#channel.value;
    replace(this.#channel, ...state.channels.map((c) => el('option', { attrs: { value: c.channel } }, String(c.channel))));
    if (chosen !== '') this.#channel.value = chosen;
    const can = state.maySend && state.isNormal;
    this.#once.disabled = this.#start.disabled = !can;
    this.#can = can;
    this.#drawList();
    this.#hint.textContent = can ? '' : state.maySend ? 'The channels only listen: let them take part first.' : `This server only listens: start ${this.live.command} with ${state.sendOption}.`;
    this.#hint.hidden = can;
    this.#runningTable.hidden = state.periodic.length === 0;
    replace(
      this.#running,
      ...state.periodic.map((entry) =>
        el('tr', {}, el('td', {}, String(entry.channel)), el('td', { class: 'mono' }, entry.frame), el('td', {}, `${entry.periodMs} ms`), el('td', {}, button('Stop', () => void this.live.ask('stopPeriodic', { channel: entry.channel, slot: entry.slot }).catch(this.#refused), { attrs: { 'aria-label': `Stop ${entry.frame}` } }))),
      ),
    );
  }
}
