// An engine for the page's tests: a computed trace of any length, one record each millisecond. It never ships: the real one is `web/engine`.

import type { Answer, Engine, Gap, Interval, MessageInfo, Requests, Row, Series, SignalEdit, SignalInfo, Summary } from '../src/api';

const STEP = 0.001;
const LOSS_EVERY = 5000;
const IDS = [
  { id: 0x100, extended: false, name: 'Engine' },
  { id: 0x200, extended: false, name: null },
  { id: 0x123, extended: false, name: 'Gearbox' },
  { id: 0x18fef100, extended: true, name: null },
] as const;

const signal = (key: number, name: string, unit: string, startBit: number, bitLength: number, more: Partial<SignalInfo> = {}): SignalInfo => ({
  key,
  name,
  unit,
  comment: '',
  min: null,
  max: null,
  alarms: { min: null, max: null },
  texts: [],
  startBit,
  bitLength,
  littleEndian: true,
  signed: false,
  float: false,
  factor: 1,
  offset: 0,
  multiplex: '',
  ...more,
});

const MESSAGES: MessageInfo[] = [
  { key: 1, name: 'Engine', channel: 1, id: 0x100, extended: false, length: 8, count: 0, comment: 'From the engine', signals: [signal(11, 'Speed', 'rpm', 0, 16, { alarms: { min: 1000, max: 5000 } }), signal(12, 'Temperature', '°C', 23, 8, { littleEndian: false, offset: -40 }), signal(13, 'Low', '', 0, 8)] },
  { key: 2, name: 'Gearbox', channel: 1, id: 0x123, extended: false, length: 8, count: 0, comment: '', signals: [signal(21, 'Gear', '', 0, 4, { texts: [{ value: 0, text: 'Neutral' }, { value: 1, text: 'First' }, { value: 2, text: 'Second' }, { value: 3, text: 'Third' }] })] },
  { key: 3, name: '</script><img src=x onerror=alert(1)>', channel: null, id: 0x300, extended: false, length: 8, count: 0, comment: '', signals: [] },
];

function value(key: number, time: number): number {
  if (key === 12) return Math.round(80 + 15 * Math.sin(time / 7));
  if (key === 21) return Math.floor(time / 3) % 4;
  return Math.round(3000 + 2500 * Math.sin(time / 2) + 40 * Math.sin(time * 31));
}

function hex(bytes: number[]): string {
  return bytes.map((b) => (b & 0xff).toString(16).toUpperCase().padStart(2, '0')).join('');
}

export class FakeEngine implements Engine {
  #records = 0;
  readonly #filters: string[] = [''];
  #own = '';
  #bitrate: number | null = 500_000;
  #died = false;
  #fieldsRead = 0;
  /** Requests so far, by name. */
  readonly asked = new Map<string, number>();

  constructor(private readonly total: number) {}

  close(): void {
    this.#died = true;
  }

  async ask<K extends keyof Requests>(request: K, parameters: Requests[K]['in']): Promise<Answer<K>> {
    this.asked.set(request, (this.asked.get(request) ?? 0) + 1);
    await Promise.resolve();
    if (this.#died) throw Object.assign(new Error('the engine has stopped: it met a fault. What is shown stays'), { name: 'EngineDied' });
    const handler = this.#handlers[request] as (p: Requests[K]['in']) => Answer<K>;
    return handler(parameters);
  }

  #summary(growing = false): Summary {
    const lost = Math.floor(this.#records / LOSS_EVERY);
    const frames = this.#records - lost;
    return {
      name: 'drive.log',
      format: 'candump',
      startUtcNs: '1764306755123456789',
      begin: 0,
      forgotten: 0,
      duration: Math.max(0, this.#records - 1) * STEP,
      frames,
      records: this.#records,
      channels: [{ channel: 1, frames, sent: 12, remote: 0, errors: 3, bitrate: this.#bitrate, load: this.#bitrate === null ? null : 0.231 }],
      losses: lost === 0 ? [] : [{ stage: 'device queue', channel: 1, count: lost * 7, atLeast: true }],
      issues: [],
      growing,
      deviceTimes: true,
      progress: growing ? 0.5 : 1,
    };
  }

  #row(index: number): Row {
    const base: Row = { index, time: index * STEP, above: null, late: index % 97 === 5, channel: 1, kind: 'data', id: null, extended: false, dlc: null, data: '', sent: false, text: '', message: null };
    if (index % LOSS_EVERY === LOSS_EVERY - 1) return { ...base, kind: 'lost', text: 'at least 7 frames lost in the device queue' };
    const which = IDS[index % 4] as (typeof IDS)[number];
    const speed = value(11, base.time);
    const data = index % 4 === 0 ? [speed, speed >> 8, value(12, base.time) + 40, 0, 0, 0, index >> 8, index] : index % 4 === 2 ? [value(21, base.time), 0, 0, 0] : [index >> 24, index >> 16, index >> 8, index];
    return { ...base, id: which.id, extended: which.extended, dlc: data.length, data: hex(data), message: which.name, sent: index % 1000 === 1 };
  }

  /** Every filter but the empty one takes one identifier of four. */
  #at(view: number, row: number): number {
    const text = this.#filters[view] ?? '';
    if (text === '') return row;
    return row * 4 + Math.max(0, IDS.findIndex((i) => i.id === parseInt(text, 16)));
  }

  /** By a device whose clock is 400 ppm fast. */
  #interval(from: number, to: number): Interval {
    return { seconds: (to - from) * 1.0004, byDevice: true };
  }

  #length(view: number): number {
    return (this.#filters[view] ?? '') === '' ? this.#records : Math.floor(this.#records / 4);
  }

  #series(key: number, from: number, to: number, columns: number): Series {
    const period = STEP * 4;
    const end = (this.#records - 1) * STEP;
    const first = Math.max(0, Math.floor(from / period));
    const last = Math.min(Math.floor(end / period), Math.ceil(to / period));
    const n = Math.max(0, last - first + 1);
    const exact = n <= columns;
    const width = exact ? n : columns;
    const arrays = [0, 1, 2, 3, 4, 5].map(() => new Float64Array(width)) as [Float64Array, Float64Array, Float64Array, Float64Array, Float64Array, Float64Array];
    for (let c = 0; c < width; c++) {
      const a = first + Math.floor((c * n) / width);
      const b = Math.max(a, first + Math.floor(((c + 1) * n) / width) - 1);
      const samples = exact ? [a] : [a, a + Math.floor((b - a) / 3), a + Math.floor((2 * (b - a)) / 3), b];
      const values = samples.map((s) => value(key, s * period));
      const column = [a * period, b * period, values[0] as number, Math.min(...values), Math.max(...values), values[values.length - 1] as number];
      for (const [i, array] of arrays.entries()) array[c] = column[i] as number;
    }
    const [time, endTime, firstValue, min, max, lastValue] = arrays;
    return { time, end: endTime, first: firstValue, min, max, last: lastValue, values: n, exact };
  }

  #gaps(): Gap[] {
    const gaps: Gap[] = [];
    for (let i = LOSS_EVERY - 1; i < this.#records && gaps.length < 1000; i += LOSS_EVERY) gaps.push({ from: (i - 40) * STEP, to: i * STEP, channel: 1, stage: 'device queue', count: 7, atLeast: true });
    return gaps;
  }

  #messages(): MessageInfo[] {
    const messages = MESSAGES.map((m) => ({ ...m, count: m.key === 3 ? 0 : Math.floor(this.#records / 4), signals: [...m.signals] }));
    for (const line of this.#own.split('\n').filter((l) => l.startsWith('{'))) {
      const edit = JSON.parse(line) as SignalEdit;
      let message = messages.find((m) => m.id === edit.id && m.extended === edit.extended);
      if (!message) messages.push((message = { key: 100 + messages.length, name: edit.messageName, channel: 1, id: edit.id, extended: edit.extended, length: 8, count: 1, comment: '', signals: [] }));
      message.signals = [...message.signals.filter((s) => s.name !== edit.name), signal(1000 + line.length, edit.name, edit.unit, edit.startBit, edit.bitLength, edit)];
    }
    return messages;
  }

  readonly #handlers: { [K in keyof Requests]: (p: Requests[K]['in']) => Answer<K> } = {
    open: ({ bytes, more, name }) => {
      const text = new TextDecoder().decode(bytes.subarray(0, 20));
      if (text.startsWith('garbage')) throw new Error(`${name} is no format that cantap reads: see “cantap convert --list-formats”.`);
      this.#records = more ? Math.floor(this.total / 2) : this.total;
      return this.#summary(more);
    },
    append: ({ bytes, more }) => {
      if (new TextDecoder().decode(bytes.subarray(0, 3)) === 'cut') throw new Error('the file ends in the middle of a record.');
      this.#records = more ? this.#records : this.total;
      return this.#summary(more);
    },
    summary: () => this.#summary(),
    bitrate: ({ bitrate }) => ((this.#bitrate = bitrate), this.#summary()),
    database: () => ({ messages: 2, signals: 4, warnings: [] }),
    connections: () => ({}),
    messages: () => this.#messages(),
    filter: ({ filter }) => {
      if (filter !== '' && !/^[0-9A-F]+$/i.test(filter)) throw new Error(`“${filter}” is no filter: write identifiers such as 123.`);
      let view = this.#filters.indexOf(filter);
      if (view < 0) view = this.#filters.push(filter) - 1;
      return { view, rows: this.#length(view) };
    },
    rows: ({ view, from, count }) =>
      Array.from({ length: Math.max(0, Math.min(count, this.#length(view) - from)) }, (_, i) => {
        const [index, above] = [this.#at(view, from + i), this.#at(view, from + i - 1)];
        return { ...this.#row(index), above: from + i > 0 ? this.#interval(above * STEP, index * STEP) : null };
      }),
    rowAt: ({ view, time }) => ({ row: Math.min(this.#length(view) - 1, Math.ceil(time / STEP / ((this.#filters[view] ?? '') === '' ? 1 : 4))) }),
    find: ({ view, text, from, backwards }) => {
      for (let row = from + (backwards ? -1 : 1), tries = 0; row >= 0 && row < this.#length(view) && tries < 100_000; row += backwards ? -1 : 1, tries++) {
        const found = this.#row(this.#at(view, row));
        if (found.id === parseInt(text, 16) || found.data.includes(text.toUpperCase()) || found.kind === text) return { row };
      }
      return { row: null };
    },
    decode: ({ index }) => {
      const row = this.#row(index);
      const message = this.#messages().find((m) => m.id === row.id && m.extended === row.extended);
      return (message?.signals ?? []).map((s) => ({ name: s.name, value: value(s.key, row.time), text: s.texts.find((t) => t.value === value(s.key, row.time))?.text ?? String(value(s.key, row.time)), unit: s.unit }));
    },
    ids: ({ at }) => {
      const end = Math.min(at, (this.#records - 1) * STEP);
      return IDS.map(({ id, extended, name }, i) => {
        const index = Math.max(i, Math.floor(end / STEP / 4) * 4 + i - 4);
        const row = this.#row(index);
        const changed = new Float64Array(row.data.length * 4).fill(NaN);
        for (let bit = changed.length - 1, age = 0; bit >= 0; bit -= 1, age += 0.3) changed[bit] = row.time - age;
        return { channel: 1, id, extended, message: name, count: Math.floor(this.#records / 4), period: { median: 0.004, min: 0.0039, max: 0.0061, byDevice: true }, lastTime: row.time, lastData: row.data, changed, signals: this.#handlers.decode({ index }) };
      });
    },
    bits: ({ id, extended }) => {
      const message = this.#messages().find((m) => m.id === id && m.extended === extended);
      const length = id === 0x100 ? 8 : 4;
      const frames = Math.floor(this.#records / 4);
      return { length, flips: Uint32Array.from({ length: length * 8 }, (_, i) => (i % 11 === 3 ? 0 : Math.floor(frames / (1 + (length * 8 - i))))), ones: new Uint32Array(length * 8).fill(Math.floor(frames / 3)), frames, signals: message?.signals ?? [] };
    },
    series: ({ signal: key, from, to, columns }) => this.#series(key, from, to, columns),
    rawSeries: ({ from, to, columns }) => this.#series(11, from, to, columns),
    load: ({ from, to, columns }) => ({ time: Float64Array.from({ length: columns }, (_, i) => from + ((to - from) * i) / columns), load: Float64Array.from({ length: columns }, (_, i) => 0.25 + 0.1 * Math.sin(from + ((to - from) * i) / columns)) }),
    gaps: () => this.#gaps(),
    interval: ({ from, to }) => this.#interval(from, to),
    periods: () => ({ edges: Float64Array.from({ length: 41 }, (_, i) => 0.0038 + i * 0.00006), counts: Uint32Array.from({ length: 40 }, (_, i) => Math.round(9000 * Math.exp(-((i - 5) ** 2) / 4)) + (i === 37 ? 1 : 0)), min: 0.0039, max: 0.0061, mean: 0.004, deviation: 0.00012, byDevice: true }),
    conversations: () => ({
      events: Array.from({ length: 300 }, (_, i) => ({ time: i * 0.05, end: i * 0.05 + 0.012, took: this.#interval(0, 0.012), channel: 1, protocol: i % 3 ? 'UDS' : 'J1939', kind: i % 2 ? 'answer' : 'request', from: i % 2 ? 'ECU 7E8' : 'tester', to: i % 3 ? (i % 2 ? 'tester' : 'ECU 7E8') : '', text: `ReadDataByIdentifier F190, part ${i}`, failed: i % 17 === 0 })),
      total: 300,
      nodes: [
        { channel: 1, protocol: 'canopen', node: '5', state: 'operational', stateSince: 2.5, drive: 'fault', driveSince: 4.999, events: 40, faults: 1, missed: 2, identity: null, codes: { emergency: '0x2310 continuous overcurrent' }, last: 9 },
        { channel: 1, protocol: 'j1939', node: '0', state: null, stateSince: null, drive: null, driveSince: null, events: 260, faults: 0, missed: 0, identity: 'engine, manufacturer <b>1</b>', codes: {}, last: 9.5 },
      ],
      notCounted: 0,
    }),
    fields: ({ records }) => {
      this.#fieldsRead = Math.min(this.#records, this.#fieldsRead + records);
      const field = { channel: 1, between: '0 > all', message: 'EEC1 engine', which: '', count: this.#fieldsRead / 4 };
      return {
        fields: [
          { ...field, key: 0, name: 'j1939.engine_speed', unit: 'rpm', texts: [] },
          { ...field, key: 1, name: 'canopen.nmt_state', between: '5', message: 'state', unit: '', texts: [{ value: 0, text: 'boot-up' }, { value: 1, text: 'stopped' }, { value: 2, text: 'operational' }, { value: 3, text: 'pre-operational' }] },
        ],
        read: this.#fieldsRead,
        leftOut: 0,
      };
    },
    fieldSeries: ({ field, from, to, columns }) => this.#series(field === 0 ? 11 : 21, from, to, columns),
    findings: () => [
      { severity: 'error', text: 'At least 7 frames were lost in the device queue.', time: 4.999, channel: 1, id: null, extended: false },
      { severity: 'warning', text: 'The period of 100 was missed once, 6.1 ms instead of 4 ms.', time: 2.5, channel: 1, id: 0x100, extended: false },
      { severity: 'info', text: 'Message <b>X</b> never occurs.', time: null, channel: null, id: null, extended: false },
    ],
    editSignal: (edit) => ({ dbc: (this.#own = `${this.#own}${JSON.stringify(edit)}\n`) }),
    setOwnDatabase: ({ dbc }) => ((this.#own = dbc), { messages: 1, signals: 1, warnings: [] }),
    export: ({ format, from, to }) => ({ name: `drive.${format}`, bytes: new TextEncoder().encode(`${format} ${from} ${to}\n`), omitted: [] }),
    formats: () => [
      { name: 'candump', extension: 'log', about: 'can-utils text' },
      { name: 'asc', extension: 'asc', about: 'Vector text' },
    ],
    boardUsb: () => ({ vendorId: 1, productId: 2 }),
    boardOpen: noBoard,
    boardTake: noBoard,
    boardStop: noBoard,
    boardVanished: noBoard,
  };
}

/** A board needs the real engine: `board.test.mjs`. */
function noBoard(): never {
  throw new Error('the tests’ engine has no board.');
}
