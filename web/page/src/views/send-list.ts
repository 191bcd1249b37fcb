// Frames to be sent: once, or periodically by the device, which changes counters and checksums itself.

import type { App } from '../model/app';
import type { Connection } from '../live/connection';
import { parseChanges } from '../live/modifiers';
import type { State } from '../live/protocol';
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
  readonly #hint = el('p', { class: 'muted' });
  #drawn = '';

  constructor(
    private readonly app: App,
    private readonly live: Connection,
  ) {
    this.#once = button('Send once', () => this.#sendOnce());
    this.#start = button('Send periodically', () => this.#startPeriodic());
    this.#frame.addEventListener('keydown', (event) => event.key === 'Enter' && this.#sendOnce());
    const head = ['Channel', 'Frame', 'Period', ''];
    this.element = el(
      'div',
      {},
      el('div', { class: 'row' }, field('Channel', this.#channel), field('Frame', this.#frame), this.#once),
      el('div', { class: 'row' }, field('Period / ms', this.#period), field('Changes', this.#changes, 'counter BYTE.LOWBIT:BITS, random BYTE, checksum BYTE:xor|sum|crc8'), this.#start),
      this.#hint,
      el('table', { class: 'numbers' }, el('caption', {}, 'Sent by the device until it is stopped, or no page is open any more'), el('thead', {}, el('tr', {}, ...head.map((h) => el('th', { attrs: { scope: 'col' } }, h)))), this.#running),
    );
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

  draw(state: State): void {
    const key = JSON.stringify([state.periodic, state.channels.map((c) => c.channel), state.isNormal, state.maySend]);
    if (key === this.#drawn) return;
    this.#drawn = key;
    const chosen = this.#channel.value;
    replace(this.#channel, ...state.channels.map((c) => el('option', { attrs: { value: c.channel } }, String(c.channel))));
    if (chosen !== '') this.#channel.value = chosen;
    const can = state.maySend && state.isNormal;
    this.#once.disabled = this.#start.disabled = !can;
    this.#hint.textContent = can ? '' : state.maySend ? 'The channels only listen: let them take part first.' : `This server only listens: start ${this.live.command} with ${state.sendOption}.`;
    this.#hint.hidden = can;
    replace(
      this.#running,
      ...state.periodic.map((entry) =>
        el('tr', {}, el('td', {}, String(entry.channel)), el('td', { class: 'mono' }, entry.frame), el('td', {}, `${entry.periodMs} ms`), el('td', {}, button('Stop', () => void this.live.ask('stopPeriodic', { channel: entry.channel, slot: entry.slot }).catch(this.#refused), { attrs: { 'aria-label': `Stop ${entry.frame}` } }))),
      ),
    );
  }
}
