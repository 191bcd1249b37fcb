// What server and page say to each other; see `host/ui/src/session.rs`, `state.rs` and `request.rs`.

/** What the server put into the page; `command` is the one that serves it, `cantap ui` or `cantap serve`. */
export type Served = { version: 1; name: string; databases: import('../model/report').ServedDatabase[]; connections: import('../api').Connections | null } & (
  | { kind: 'device'; command: string }
  | { kind: 'trace'; size: number; bitrates: { channel: number; bitrate: number; dataBitrate: number | null }[] }
);

export interface DeviceState {
  name: string;
  isThere: boolean;
  reason: string | null;
}

export interface ChannelState {
  channel: number;
  /** Bit/s. */
  bitrate: number | null;
  /** `active`, `warning`, `passive`, `bus-off`. */
  state: string;
  /** Transmit and receive error counters. */
  counters: [number, number];
}

export interface PeriodicState {
  channel: number;
  slot: number;
  frame: string;
  periodMs: number;
}

/** What an ECU has answered; the parameter is empty for trouble codes. */
export interface VehicleRow {
  parameter: string;
  name: string;
  ecu: string;
  value: string;
  /** It has answered the last time. */
  isCurrent: boolean;
  /** The least and the most so far, of numbers. */
  range: [string, string] | null;
}

export interface State {
  maySend: boolean;
  /** Choose bit rates and filters. */
  mayConfigure: boolean;
  /** Begin recordings in the server's folder. */
  mayRecord: boolean;
  /** The command's option that allows sending. */
  sendOption: string;
  devices: DeviceState[];
  channels: ChannelState[];
  isNormal: boolean;
  filters: string[];
  /** With a condition, `events` says how often it came true; there is no file before. */
  recording: { name: string; records: number; bytes: number; seconds: number; condition: string | null; events: number } | null;
  periodic: PeriodicState[];
  /** What a vehicle answers, once it was asked. */
  vehicle: { isAsked: boolean; text: string; rows: VehicleRow[] } | null;
  pages: number;
  ended: string | null;
}

/** What changes in a periodic frame each time; bytes are counted from 0. */
export type Change = { counter: { byte: number; lowBit: number; bits: number } } | { random: { byte: number } } | { checksum: { byte: number; algorithm: 'xor' | 'sum' | 'crc8' } };

/** Each request: what it takes, and what it answers. */
export interface Requests {
  record: { in: { name: string; only: { around: string; beforeS: number; afterS: number } | null }; out: Record<string, never> };
  stopRecording: { in: Record<string, never>; out: Record<string, never> };
  /** Without a bit rate, it is found by listening. */
  bitrate: { in: { channel: number; bitrate: number | null }; out: Record<string, never> };
  filters: { in: { filters: string[] }; out: Record<string, never> };
  mode: { in: { normal: boolean; confirmed: boolean }; out: Record<string, never> };
  send: { in: { channel: number; frame: string }; out: Record<string, never> };
  periodic: { in: { channel: number; frame: string; periodMs: number; modifiers: Change[] }; out: { slot: number } };
  stopPeriodic: { in: { channel: number; slot: number }; out: Record<string, never> };
  recover: { in: Record<string, never>; out: Record<string, never> };
  askVehicle: { in: { on: boolean }; out: Record<string, never> };
}

/** JSON from the server. */
export type FromServer =
  | { type: 'hello'; run: string; version: string }
  | ({ type: 'state' } & State)
  | { type: 'notice'; number: number | null; level: 'info' | 'warning'; text: string }
  | { type: 'answer'; number: number; ok?: unknown; error?: string };

/** Bytes before the records of a binary message: the numbers of the first record, of the one after the last, and of all so far. */
export const HEADER = 24;
