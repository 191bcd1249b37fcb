// The board that the page has open itself, without a server: who it is, its channels with what came and what was lost, closing and saving.

import type { Board } from '../live/board';
import type { App } from '../model/app';
import { bitrate, count, plural } from '../model/format';
import { button, el, replace, setText } from '../ui/dom';
import { openBoard } from './open-board';
import type { View } from './view';

export class BoardView implements View {
  readonly id = 'board';
  readonly title = 'Board';
  readonly element: HTMLElement;
  readonly #connection = el('p', { attrs: { role: 'status' } });
  readonly #device = el('p');
  readonly #channels = el('tbody');
  readonly #damaged = el('p', { class: 'bad' });
  readonly #close: HTMLButtonElement;
  readonly #again: HTMLButtonElement;
  readonly #new: HTMLButtonElement;
  readonly #rates: HTMLButtonElement;
  readonly #law = el('p', { class: 'muted' });

  constructor(
    private readonly app: App,
    private readonly board: Board,
    exportAll: () => void,
  ) {
    this.#close = button('Close the board', () => void board.stop(), { class: 'primary', id: 'board-close' });
    this.#again = button('Go on in this trace …', () => void openBoard(app, { again: true }), { id: 'board-again' });
    this.#new = button('Another trace …', () => void openBoard(app), { id: 'board-new' });
    this.#rates = button('Bit rates …', () => void openBoard(app, { again: true, same: true }), { id: 'board-rates' });
    const head = ['Channel', 'Bit rate', 'Mode', 'State', 'Error counters, send / receive', 'Frames received', 'Lost', 'Counted by the board'];
    this.element = el(
      'section',
      { class: 'view view-device', attrs: { 'aria-label': 'Board' } },
      el(
        'div',
        { class: 'page-scroll', attrs: { tabindex: 0, role: 'group', 'aria-label': 'Board and channels' } },
        section('Connection', this.#connection, this.#device, el('div', { class: 'row' }, this.#close, this.#again, this.#new)),
        section('Channels, since the board was opened', el('table', { class: 'numbers' }, el('thead', {}, el('tr', {}, ...head.map((h) => el('th', { attrs: { scope: 'col' } }, h)))), this.#channels), this.#law, this.#damaged, el('div', { class: 'row' }, this.#rates)),
        section('Recording', el('p', {}, 'Everything that arrives is kept in this page, the newest 8 million records of it, until it is closed. Save it as a file before that.'), el('div', { class: 'row' }, button('Save …', exportAll, { id: 'board-save' }))),
      ),
    );
    app.on('live-state', () => this.#draw());
    this.#draw();
  }

  shown(): void {
    this.#draw();
  }

  #draw(): void {
    const { board, app } = this;
    const { board: state, isOpen } = board;
    // Another trace may have taken the place of the board's.
    const isShown = app.live === board;
    setText(this.#connection, !isOpen ? board.reason : board.status === 'open' ? `Open, and only listening. ${plural(board.next, 'record')} received.` : 'Waiting for the board’s answer …');
    this.#connection.classList.toggle('bad', board.status === 'lost');
    this.#close.hidden = !isOpen;
    this.#new.hidden = isOpen;
    this.#again.hidden = isOpen || !isShown;
    this.#rates.hidden = board.status !== 'open';
    if (!state) return;
    setText(this.#device, state.device === null ? '' : `${state.device}, firmware ${state.firmware ?? ''}${state.uncertaintyNs === null ? '' : `; times are UTC to within ${(state.uncertaintyNs / 1e6).toFixed(3)} ms`}`);
    replace(
      this.#channels,
      ...state.channels.map((c) =>
        el('tr', {}, el('th', { attrs: { scope: 'row' } }, String(c.channel)), el('td', {}, bitrate(c.bitrate)), el('td', { class: c.mode === 'listen-only' ? '' : 'bad' }, c.mode), el('td', { class: c.state === 'active' ? '' : 'bad' }, c.state), el('td', { class: c.counters[0] + c.counters[1] > 0 ? 'bad' : '' }, c.counters.join(' / ')), el('td', { class: 'received' }, count(c.received)), el('td', { class: c.lost > 0 ? 'lost bad' : 'lost' }, count(c.lost)), el('td', { class: 'counted' }, count(c.counted))),
      ),
    );
    const ended = state.stage === 'over' && state.error === null;
    // The board counts in 32 bits.
    const agree = state.channels.every((c) => (c.received + c.lost - c.counted) % 2 ** 32 === 0);
    setText(this.#law, !ended ? 'The board’s count is up to a second old.' : agree ? 'Received and lost together are what the board has counted.' : 'The counts do not agree: frames are missing that nobody has named.');
    this.#law.classList.toggle('bad', ended && !agree);
    this.#damaged.hidden = state.corrupt === 0;
    setText(this.#damaged, `Damaged on their way: ${plural(state.corrupt, 'message')}; what they held is counted as lost, where it is known. Try another cable or port.`);
  }
}

function section(title: string, ...children: HTMLElement[]): HTMLElement {
  return el('section', { class: 'block' }, el('h3', {}, title), ...children);
}
