// The device behind a live page: its connection and channels, recording, what is sent. Only a page that a command serves has this view.

import type { App } from '../model/app';
import type { Connection } from '../live/connection';
import type { State } from '../live/protocol';
import { bitrate, bytes, count, duration, plural } from '../model/format';
import type { Commands } from '../ui/commands';
import { openDialog } from '../ui/dialog';
import { button, el, field, replace, setText } from '../ui/dom';
import { SendList } from './send-list';
import { parseRate } from './summary';
import { Vehicle } from './vehicle';
import type { View } from './view';

export class DeviceView implements View {
  readonly id = 'device';
  readonly title = 'Device';
  readonly element: HTMLElement;
  readonly #connection = el('p', { attrs: { role: 'status' } });
  readonly #devices = el('ul', { class: 'plain' });
  readonly #channels = el('tbody');
  readonly #mode = el('div', { class: 'row' });
  readonly #filters = el('input', { class: 'mono', attrs: { type: 'text', 'aria-label': 'Filters of the device', placeholder: '123:7FF 400-4FF', spellcheck: 'false', autocomplete: 'off' } });
  readonly #name = el('input', { class: 'mono', attrs: { type: 'text', 'aria-label': 'Name of the recording', spellcheck: 'false', autocomplete: 'off' } });
  readonly #around = el('input', { class: 'mono', attrs: { type: 'text', 'aria-label': 'Condition of the recording', placeholder: 'Speed > 80', spellcheck: 'false', autocomplete: 'off' } });
  readonly #before = secondsInput('Seconds before each event', 2);
  readonly #after = secondsInput('Seconds after each event', 5);
  readonly #recording = el('p', { attrs: { role: 'status' } });
  readonly #record: HTMLButtonElement;
  /** What the server may do for the page: record, filter. */
  readonly #recorder: HTMLElement;
  readonly #keeper: HTMLElement;
  readonly #filtering: HTMLElement;
  readonly #send: SendList;
  readonly #vehicle: Vehicle;
  #drawn = '';

  constructor(
    private readonly app: App,
    private readonly live: Connection,
    commands: Commands,
    exportAll: () => void,
  ) {
    this.#record = button('Record', () => this.toggleRecording(), { class: 'primary' });
    this.#send = new SendList(app, live);
    this.#vehicle = new Vehicle(app, live);
    this.#recorder = el(
      'div',
      { attrs: { hidden: '' } },
      el('div', { class: 'row' }, field(`File in the folder of ${live.command}`, this.#name, 'The suffix names the format: .blf, .log, .asc, .mf4 …'), this.#record),
      el('div', { class: 'row' }, field('Only around', this.#around, 'A condition, such as Speed > 80, id == 0x123 or error; empty for everything.'), field('Seconds before', this.#before), field('Seconds after', this.#after)),
      this.#recording,
    );
    this.#keeper = el(
      'div',
      { attrs: { hidden: '' } },
      el('p', {}, 'This server records nothing for pages. What arrives is kept in this page, the newest 8 million records of it, until it is closed. Save it as a file before that.'),
      el('div', { class: 'row' }, button('Save …', exportAll, { id: 'live-save' })),
    );
    this.#filtering = section('Filters of the device', el('div', { class: 'row' }, field('Receive only', this.#filters, 'Several separated by blanks; empty for everything. What they keep back is neither shown nor recorded.'), button('Apply', () => this.#applyFilters())));
    const head = ['Channel', 'Bit rate', 'State', 'Error counters, send / receive'];
    this.element = el(
      'section',
      { class: 'view view-device', attrs: { 'aria-label': 'Device' } },
      el(
        'div',
        { class: 'page-scroll', attrs: { tabindex: 0, role: 'group', 'aria-label': 'Device, sending and vehicle' } },
        section('Connection', this.#connection, this.#devices),
        section('Channels', el('table', { class: 'numbers' }, el('thead', {}, el('tr', {}, ...head.map((h) => el('th', { attrs: { scope: 'col' } }, h)))), this.#channels), this.#mode),
        section('Recording', this.#recorder, this.#keeper),
        this.#filtering,
        section('Send', this.#send.element),
        section('Vehicle', this.#vehicle.element),
      ),
    );
    this.#name.value = proposedName();
    app.on('live-state', () => this.#draw());
    commands.add(
      { id: 'live.record', title: 'Recording: begin or end', keys: ['R'], run: () => this.toggleRecording() },
      { id: 'live.listen', title: 'Device: only listen', run: () => this.#setMode(false) },
      { id: 'live.normal', title: 'Device: take part in the bus', run: () => this.#askNormal() },
      { id: 'live.vehicle', title: 'Vehicle: ask by OBD-II, or end that', run: () => this.#vehicle.toggle() },
    );
    this.#draw();
  }

  shown(): void {
    this.#draw();
  }

  #refused = (error: unknown): void => this.app.failed(error);

  toggleRecording(): void {
    const { live } = this;
    if (live.state && !live.state.mayRecord) return;
    if (live.state?.recording) {
      void live.ask('stopRecording', {}).catch(this.#refused);
      return;
    }
    const name = this.#name.value.trim();
    const around = this.#around.value.trim();
    const only = around === '' ? null : { around, beforeS: Number(this.#before.value), afterS: Number(this.#after.value) };
    void live.ask('record', { name, only }).then(() => (this.#name.value = proposedName()), this.#refused);
  }

  #applyFilters(): void {
    const filters = this.#filters.value.split(/\s+/).filter((f) => f !== '');
    void this.live.ask('filters', { filters }).catch(this.#refused);
  }

  #setMode(normal: boolean): void {
    void this.live.ask('mode', { normal, confirmed: normal }).catch(this.#refused);
  }

  #askNormal(): void {
    const rates = (this.live.state?.channels ?? []).map((c) => `channel ${c.channel} at ${bitrate(c.bitrate)}`).join(', ');
    openDialog(
      'Take part in the bus?',
      [el('p', {}, `The device will acknowledge frames, and send what you tell it to: ${rates}.`), el('p', { class: 'bad' }, 'A wrong bit rate disturbs the bus, and frames that are sent can move things. Only on a bus on which that can do no harm.')],
      [{ label: 'Only listen', primary: true }, { label: 'Take part', run: () => this.#setMode(true) }],
    );
  }

  #askBitrate(channel: number, now: number | null): void {
    const input = el('input', { class: 'mono', attrs: { type: 'text', 'aria-label': 'Bit rate', value: now ?? '', inputmode: 'decimal' } });
    const problem = el('p', { class: 'bad', attrs: { role: 'alert' } });
    openDialog(`Bit rate of channel ${channel} of the device`, [field('Bit/s', input, 'for example 500000, 500k, 1M'), el('p', { class: 'muted' }, 'The channels are opened anew: for a moment nothing is received, and afterwards they only listen.'), problem], [
      {
        label: 'Set',
        primary: true,
        run: () => {
          const value = parseRate(input.value);
          if (value === null) {
            problem.textContent = `“${input.value}” is no bit rate: write for example 500k.`;
            return false;
          }
          void this.live.ask('bitrate', { channel, bitrate: value }).catch(this.#refused);
          return true;
        },
      },
      {
        label: 'Find it by listening',
        run: () => void this.live.ask('bitrate', { channel, bitrate: null }).catch(this.#refused),
      },
      { label: 'Cancel' },
    ]);
    input.select();
  }

  #draw(): void {
    if (this.element.hidden) return;
    const { live } = this;
    const { state } = live;
    const behind = live.latest - live.next;
    setText(this.#connection, live.status === 'open' ? `Connected. ${plural(live.next, 'record')} received${behind > 0 ? `, ${count(behind)} behind` : ''}.${state && state.pages > 1 ? ` ${plural(state.pages, 'page')} are open.` : ''}` : live.reason || 'Connecting …');
    this.#connection.classList.toggle('bad', live.status === 'lost' || live.status === 'ended');
    if (!state) return;
    this.#recorder.hidden = !state.mayRecord;
    this.#keeper.hidden = state.mayRecord;
    this.#filtering.hidden = !state.mayConfigure;
    this.#drawRecording(state);
    this.#send.draw(state);
    this.#vehicle.draw(state);
    const key = JSON.stringify([state.devices, state.channels, state.isNormal, state.maySend, state.mayConfigure, state.filters, state.ended]);
    if (key === this.#drawn) return;
    this.#drawn = key;
    replace(this.#devices, state.ended ? el('li', { class: 'bad' }, state.ended) : null, ...state.devices.map((d) => el('li', { class: d.isThere ? '' : 'bad' }, `${d.name}: ${d.isThere ? 'connected' : `gone (${d.reason ?? 'unknown'})`}`)));
    replace(
      this.#channels,
      ...state.channels.map((c) =>
        el('tr', {}, el('th', { attrs: { scope: 'row' } }, String(c.channel)), el('td', {}, state.mayConfigure ? button(bitrate(c.bitrate), () => this.#askBitrate(c.channel, c.bitrate), { class: 'link', attrs: { 'aria-label': `Bit rate of channel ${c.channel}: ${bitrate(c.bitrate)}, change` } }) : bitrate(c.bitrate)), el('td', { class: c.state === 'active' ? '' : 'bad' }, c.state), el('td', { class: c.counters[0] + c.counters[1] > 0 ? 'bad' : '' }, c.counters.join(' / '))),
      ),
    );
    replace(
      this.#mode,
      el('span', { id: 'live-mode', class: state.isNormal ? 'bad' : '' }, state.isNormal ? 'The channels take part in their buses. ' : 'The channels only listen. '),
      state.isNormal ? button('Only listen', () => this.#setMode(false)) : state.maySend ? button('Take part …', () => this.#askNormal()) : el('span', { class: 'muted' }, `To send, start ${live.command} with ${state.sendOption}.`),
      state.isNormal ? button('Back from bus-off', () => void live.ask('recover', {}).catch(this.#refused)) : null,
    );
    if (document.activeElement !== this.#filters) this.#filters.value = state.filters.join(' ');
  }

  #drawRecording({ recording }: State): void {
    setText(this.#record, recording ? 'Stop recording' : 'Record');
    for (const input of [this.#name, this.#around, this.#before, this.#after]) input.disabled = recording !== null;
    setText(this.#recording, recording ? recordingText(recording) : `Nothing is recorded now. A recording has everything that arrives, whatever this page shows, and goes on when it is closed.`);
  }
}

function secondsInput(label: string, value: number): HTMLInputElement {
  return el('input', { attrs: { type: 'number', min: 0, max: 86400, step: 'any', value, 'aria-label': label } });
}

function recordingText({ name, condition, events, records, seconds, bytes: size }: NonNullable<State['recording']>): string {
  if (condition !== null && events === 0) return `Armed: ${name} begins when ${condition}. Until then there is no file.`;
  const counted = `${name}: ${duration(seconds)}, ${bytes(size)}, ${plural(records, 'record')}`;
  return condition === null ? counted : `${counted}, around ${plural(events, 'event')} of ${condition}`;
}

/** A name of its own for each recording, by the time. */
function proposedName(): string {
  const now = new Date();
  const two = (n: number): string => String(n).padStart(2, '0');
  return `cantap-${now.getFullYear()}${two(now.getMonth() + 1)}${two(now.getDate())}-${two(now.getHours())}${two(now.getMinutes())}${two(now.getSeconds())}.blf`;
}

function section(title: string, ...children: HTMLElement[]): HTMLElement {
  return el('section', { class: 'block' }, el('h3', {}, title), ...children);
}
