// What the page asks the engine, and what the engine answers. The engine (`web/engine`) is Rust compiled to WebAssembly and runs in a
// worker; each request is one of `Requests`, and each answer has the type beside it. Nothing here depends on how the two are joined.
//
// Times are seconds since the trace's first record, as float64 (exact to well below a microsecond for any trace of a year). The start in
// UTC stands in `Summary`. Channels have the numbers that the trace gives them. Identifiers are numbers, and `extended` says their kind.

/** Losses, per stage of the law of counting. `atLeast`: the stage could not count exactly. */
export interface Loss {
  stage: string;
  channel: number | null;
  count: number;
  atLeast: boolean;
}

export interface ChannelSummary {
  channel: number;
  frames: number;
  sent: number;
  remote: number;
  errors: number;
  /** Bit per second; null if neither the trace nor the user gave it. Without it there is no bus load. */
  bitrate: number | null;
  /** 0 to 1, over the whole trace. */
  load: number | null;
}

export interface Summary {
  name: string;
  format: string;
  /** Start in UTC, nanoseconds since 1970 as a decimal string; null if the trace has no date. */
  startUtcNs: string | null;
  /** Seconds from the first record to the last. */
  duration: number;
  /** When the first record that is kept was, in seconds: a live trace forgets its oldest. */
  begin: number;
  frames: number;
  /** Records of all kinds: rows of the trace. */
  records: number;
  /** Records before them that are no longer kept. */
  forgotten: number;
  channels: ChannelSummary[];
  losses: Loss[];
  /** What of the file was not read, in words; with a count. Empty if everything was read. */
  issues: { text: string; count: number }[];
  /** True while more of the file (or of a live source) is still to come. */
  growing: boolean;
  /** 0 to 1 of the file's bytes read so far; null for a live source. */
  progress: number | null;
  /** Whether records have the time of the device that stamped them, beside UTC. */
  deviceTimes: boolean;
}

/** How long something took. Without `byDevice` it is a difference of UTC, which is corrected while a trace is recorded. */
export interface Interval {
  seconds: number;
  byDevice: boolean;
}

export type RowKind = 'data' | 'remote' | 'fd' | 'error' | 'state' | 'lost' | 'other';

/** One row of the trace. */
export interface Row {
  /** Number of the record in the whole trace, from 0. */
  index: number;
  time: number;
  /** Since the row above in the view; null for the first. */
  above: Interval | null;
  /** The stamp is an upper bound, not exact. */
  late: boolean;
  channel: number | null;
  kind: RowKind;
  id: number | null;
  extended: boolean;
  dlc: number | null;
  /** Data bytes as upper-case hex without blanks. */
  data: string;
  sent: boolean;
  /** What the record says if it is no frame (a loss, a state, an error), in words. */
  text: string;
  /** Name of the message, if a database knows it. */
  message: string | null;
}

/** One identifier on one channel: a row of the fixed view. */
export interface IdRow {
  channel: number;
  id: number;
  extended: boolean;
  message: string | null;
  count: number;
  /** Period in seconds, of the last 512 frames: median, smallest, largest. Null with fewer than two frames. */
  period: { median: number; min: number; max: number; byDevice: boolean } | null;
  lastTime: number;
  lastData: string;
  /** For each bit of the data (byte 0 bit 7 first), the time it last changed; NaN if not within the last 512 frames. */
  changed: Float64Array;
  signals: SignalValue[];
}

export interface SignalValue {
  name: string;
  /** Null: not in this frame (multiplexed away, or too short). */
  value: number | null;
  /** As it is shown: shortest number that reads back, or the value's text. */
  text: string;
  unit: string;
}

export interface MessageInfo {
  /** Key to name it in other requests. */
  key: number;
  name: string;
  channel: number | null;
  id: number;
  extended: boolean;
  length: number;
  count: number;
  comment: string;
  signals: SignalInfo[];
}

export interface SignalInfo {
  /** Key to name it in other requests: stable while the database does not change. */
  key: number;
  name: string;
  unit: string;
  comment: string;
  /** Limits as the database has them; null if it gives none. */
  min: number | null;
  max: number | null;
  /** Below and above which a signal file sets an alarm. */
  alarms: { min: number | null; max: number | null };
  /** Texts of values, if it has any: then a digital lane serves better than a line. */
  texts: { value: number; text: string }[];
  startBit: number;
  bitLength: number;
  littleEndian: boolean;
  signed: boolean;
  float: boolean;
  factor: number;
  offset: number;
  /** Empty: always there. Otherwise e.g. `m3`, as a DBC writes it; `M` for the multiplexer itself. */
  multiplex: string;
}

/**
 * A signal over time, thinned to columns so that no single value is lost: each column holds the first, smallest, largest and last value
 * of its stretch. All arrays have the same length; a column without a value is left out. The last value before the window and the first
 * after it are columns of their own at both ends, so that lines reach the picture's edges.
 */
export interface Series {
  /** Time of the column's first value. */
  time: Float64Array;
  /** Time of its last value. */
  end: Float64Array;
  first: Float64Array;
  min: Float64Array;
  max: Float64Array;
  last: Float64Array;
  /** Values behind the columns. */
  values: number;
  /** True if each column is exactly one value: the picture is exact. */
  exact: boolean;
}

/** A stretch in which frames are known to be missing, or the device was off the bus. */
export interface Gap {
  from: number;
  to: number;
  channel: number | null;
  stage: string;
  count: number;
  atLeast: boolean;
}

export interface BitGrid {
  /** Bytes that were seen for this identifier at most. */
  length: number;
  /** For each bit (byte 0 bit 7 first): how often it changed in the window. */
  flips: Uint32Array;
  /** How often it was 1. */
  ones: Uint32Array;
  /** Frames in the window. */
  frames: number;
  signals: SignalInfo[];
}

export interface Finding {
  severity: 'info' | 'warning' | 'error';
  /** What was found, in a sentence. */
  text: string;
  /** Where to look: seconds, and an identifier. */
  time: number | null;
  channel: number | null;
  id: number | null;
  extended: boolean;
}

/** As the options of `cantap conversations` are written: `7E0:7E8` or a maker, `7F0:7F1`, `1620=uavcan.si.sample.voltage.Scalar.1.0`. */
export interface Connections {
  pairs: string[];
  xcp: string[];
  ccp: string[];
  subjects: string[];
}

/** A conversation's event: a request, an answer, an announcement. */
export interface ProtocolEvent {
  time: number;
  end: number;
  took: Interval;
  channel: number;
  protocol: string;
  kind: string;
  from: string;
  to: string;
  text: string;
  failed: boolean;
}

/** A node of a bus as its protocol shows it, at the end of the stretch that was asked for. Times are those of the change, null if there is none. */
export interface ProtocolNode {
  channel: number;
  protocol: string;
  /** Its number, or its identifier. */
  node: string;
  /** In words: that of a CANopen node, or that its heartbeat is missing. */
  state: string | null;
  stateSince: number | null;
  /** Its state as a drive (CiA 402), in words. */
  drive: string | null;
  driveSince: number | null;
  events: number;
  faults: number;
  /** Heartbeats and answers to guarding that did not come. */
  missed: number;
  identity: string | null;
  /** Trouble codes, by the list they are in. */
  codes: Record<string, string>;
  last: number;
}

/** A number that a protocol has in its messages. */
export interface FieldInfo {
  /** Key to name it in other requests: stable until the trace or a database changes. */
  key: number;
  channel: number;
  /** The protocol, a dot, and the field, as conditions have it: `j1939.engine_speed`. */
  name: string;
  /** Who says it to whom. */
  between: string;
  message: string;
  /** Which of several things of the same name it is about; mostly empty. */
  which: string;
  unit: string;
  /** Values that were read so far. */
  count: number;
  /** What each value stands for; empty if it is a quantity. */
  texts: { value: number; text: string }[];
}

/** A DBC's signal as the user draws it; see `editSignal`. */
export interface SignalEdit {
  channel: number;
  id: number;
  extended: boolean;
  messageName: string;
  name: string;
  startBit: number;
  bitLength: number;
  littleEndian: boolean;
  signed: boolean;
  factor: number;
  offset: number;
  unit: string;
  texts: { value: number; text: string }[];
}

/** A channel of a board that the page has open. */
export interface BoardChannel {
  channel: number;
  /** Bit/s. */
  bitrate: number;
  mode: string;
  /** `active`, `warning`, `passive`, `bus-off`; empty until the board has said. */
  state: string;
  /** Transmit and receive error counters. */
  counters: [number, number];
  /** Frames that came, those that were lost, and those that the board has counted: the sum of both, once the channel is closed. */
  received: number;
  lost: number;
  counted: number;
}

/** A session with a board on a serial port of the browser. */
export interface BoardState {
  stage: 'greeting' | 'opening' | 'listening' | 'stopping' | 'over';
  /** Why it is over, in words; null if it is not, or was closed. */
  error: string | null;
  device: string | null;
  firmware: string | null;
  channels: BoardChannel[];
  /** Messages that were damaged on their way; what they held is counted as lost. */
  corrupt: number;
  /** Of the stamps' UTC; null until it is known. */
  uncertaintyNs: number | null;
  /** To be written to the port. */
  write: Uint8Array;
}

/** Each request: what it takes, and what it answers. A refused one answers `{ error: string }`, which says what to do next. */
export interface Requests {
  /**
   * Takes a file whole, or its first piece if `more` follows. The format is recognised by name and content. Without a `size` and with `more`
   * to come it is live: chunks of packed records (`host/trace/src/packed.rs`), each behind its length (4 bytes, little-endian). Of those the
   * newest `keep` are kept, 8 million if it is not given.
   */
  open: { in: { name: string; bytes: Uint8Array; more: boolean; size: number | null; keep?: number }; out: Summary };
  /** The next piece of the file that `open` began. */
  append: { in: { bytes: Uint8Array; more: boolean }; out: Summary };
  summary: { in: Record<string, never>; out: Summary };
  /** In bit/s; `dataBitrate` is that of data phases of CAN FD. */
  bitrate: { in: { channel: number; bitrate: number; dataBitrate?: number }; out: Summary };
  /**
   * Adds a database (DBC, KCD, SYM, ARXML, DBF: recognised by name and content), for one channel or all; or what describes conversations (A2L, ODX,
   * PDX, CDD, EDS, DSDL, by name).
   */
  database: { in: { name: string; bytes: Uint8Array; channel: number | null }; out: { messages: number; signals: number; warnings: string[] } };
  /** Replaces what is known of who talks to whom where a trace does not show it. After the databases that name its data types. */
  connections: { in: Connections; out: Record<string, never> };
  /** All messages: those of databases, and whether they occur. */
  messages: { in: Record<string, never>; out: MessageInfo[] };
  /**
   * A filter as of candump (several separated by blanks: any may match), or a condition as of `cantap search` (docs/grammar.md); an empty text:
   * everything. Counts, and names the view that `rows` reads. The eight views used last are kept, and that of everything.
   */
  filter: { in: { filter: string }; out: { view: number; rows: number } };
  rows: { in: { view: number; from: number; count: number }; out: Row[] };
  /** The row of a view at or after a time. */
  rowAt: { in: { view: number; time: number }; out: { row: number } };
  /**
   * The next row after `from` (or before, backwards) that matches: bytes as of `cantap search --data` (`11 ?? 3?`, `* DE AD` for anywhere), or a
   * filter or condition. −1 is before the first row.
   */
  find: { in: { view: number; text: string; from: number; backwards: boolean }; out: { row: number | null } };
  /** A row's signals. */
  decode: { in: { index: number }; out: SignalValue[] };
  /** The fixed view at a time (Infinity: the end). */
  ids: { in: { at: number }; out: IdRow[] };
  bits: { in: { channel: number; id: number; extended: boolean; from: number; to: number }; out: BitGrid };
  /** At most `columns` columns between the times. */
  series: { in: { signal: number; from: number; to: number; columns: number }; out: Series };
  /** A whole field of an identifier as a signal that no database has. */
  rawSeries: { in: SignalEdit & { from: number; to: number; columns: number }; out: Series };
  /** 0 to 1 per column; NaN where it cannot be known, such as without a bit rate. */
  load: { in: { channel: number; from: number; to: number; columns: number }; out: { time: Float64Array; load: Float64Array } };
  gaps: { in: { from: number; to: number }; out: Gap[] };
  /** From one time to another, which may be between records. */
  interval: { in: { from: number; to: number }; out: Interval };
  /**
   * Periods of one identifier: a histogram, `counts[i]` between `edges[i]` and `edges[i + 1]` seconds. Periods in which frames of the channel
   * were lost are left out. Empty, with zeros, if there is none.
   */
  periods: {
    in: { channel: number; id: number; extended: boolean };
    out: { edges: Float64Array; counts: Uint32Array; min: number; max: number; mean: number; deviation: number; byDevice: boolean };
  };
  /** `notCounted`: events of nodes, services and objects beyond those that are kept. */
  conversations: { in: { from: number; to: number; limit: number }; out: { events: ProtocolEvent[]; total: number; nodes: ProtocolNode[]; notCounted: number } };
  /**
   * Reads the next `records` records for numbers that protocols have in their messages, and lists what was found so far in the first `read`
   * records. `leftOut`: values beyond those that are kept.
   */
  fields: { in: { records: number }; out: { fields: FieldInfo[]; read: number; leftOut: number } };
  /** As `series`. */
  fieldSeries: { in: { field: number; from: number; to: number; columns: number }; out: Series };
  findings: { in: Record<string, never>; out: Finding[] };
  /** Adds or changes a signal of the user's own database; undo and redo are the page's, by the whole text. */
  editSignal: { in: SignalEdit; out: { dbc: string } };
  /** Replaces the user's own database by this text. */
  setOwnDatabase: { in: { dbc: string }; out: { messages: number; signals: number; warnings: string[] } };
  /** What a view holds between the times, in a format's name (`candump`, `asc`, `trc`, `csv`, `blf` …), ready to be saved. */
  export: { in: { view: number; format: string; from: number; to: number }; out: { name: string; bytes: Uint8Array; omitted: string[] } };
  formats: { in: Record<string, never>; out: { name: string; extension: string; about: string }[] };
  /** How a board is recognised among USB devices. */
  boardUsb: { in: Record<string, never>; out: { vendorId: number; productId: number } };
  /**
   * Begins a session with a board that only listens, on a port that has just been opened: in a new live trace, or `again` in the one that an
   * earlier session has left. `bitrates` are those of channels 1 and 2 in bit/s, null for one that stays closed. Times are milliseconds since 1970.
   */
  boardOpen: { in: { name: string; bitrates: [number | null, number | null]; now: number; again: boolean }; out: BoardAnswer };
  /** What came from the port; also with nothing, at least every 100 ms. */
  boardTake: { in: { pieces: { bytes: Uint8Array; at: number }[]; now: number }; out: BoardAnswer };
  /** Closes the channels; `boardTake` then goes on until the stage is `over`. */
  boardStop: { in: Record<string, never>; out: BoardAnswer };
  /** The port is gone. */
  boardVanished: { in: { reason: string }; out: BoardAnswer };
}

export interface BoardAnswer {
  board: BoardState;
  summary: Summary;
}

export type Answer<K extends keyof Requests> = Requests[K]['out'];

/** The engine, wherever it runs. */
export interface Engine {
  ask<K extends keyof Requests>(request: K, parameters: Requests[K]['in']): Promise<Answer<K>>;
  close(): void;
}
