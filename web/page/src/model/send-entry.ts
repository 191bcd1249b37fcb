// A line of a send list, as the live view writes and reads it (`tui/src/app/entry.rs`):
// `[CHANNEL:]FRAME [PERIOD] [counter=…] [random=…] [checksum=…] [group=…]`, or a message with its signals in place of the frame.

import type { Change } from '../live/protocol';

export interface SendEntry {
  /** As written: so it is saved again. */
  text: string;
  channel: number;
  /** What the server takes: a frame or a message. */
  frame: string;
  /** Milliseconds; null to send it once at a time. */
  periodMs: number | null;
  changes: Change[];
}

/** More than anybody has; a file that was chosen by mistake has more. */
const MOST = 500;

const UNITS_MS: Record<string, number> = { ns: 1e-6, us: 1e-3, 'µs': 1e-3, ms: 1, s: 1e3, m: 6e4, min: 6e4, h: 3.6e6, d: 8.64e7 };
const TIME = /^(?:\d+\.?\d*|\.\d+)(?:[a-zµ]+(?:(?:\d+\.?\d*|\.\d+)[a-zµ]+)*)?$/;

/** A period in milliseconds: `100ms`, `1m30s`, `0.5` for half a second. */
function period(text: string): number {
  let ms = 0;
  let before = Infinity;
  if (TIME.test(text)) {
    if (/^[\d.]+$/.test(text)) ms = Number(text) * 1000;
    else {
      for (const [, number, unit] of text.matchAll(/([\d.]+)([a-zµ]+)/g)) {
        const factor = UNITS_MS[unit ?? ''] ?? NaN;
        ms += factor < before ? Number(number) * factor : NaN;
        before = factor;
      }
    }
  }
  if (!(ms > 0)) throw new Error(`“${text}” is no period: write it as 100ms or 1.5s`);
  return ms;
}

function change(name: string, value: string): Change {
  const counter = /^(\d+)(?:\.(\d+):(\d+))?$/.exec(value);
  if (name === 'counter' && counter) return { counter: { byte: Number(counter[1]), lowBit: Number(counter[2] ?? 0), bits: Number(counter[3] ?? 8) } };
  if (name === 'random' && /^\d+$/.test(value)) return { random: { byte: Number(value) } };
  const checksum = /^(\d+):(xor|sum|crc8)$/.exec(value);
  if (name === 'checksum' && checksum) return { checksum: { byte: Number(checksum[1]), algorithm: checksum[2] as 'xor' | 'sum' | 'crc8' } };
  throw new Error(`“${name}=${value}” is unknown: there are counter=7, counter=7.0:4, random=2, checksum=1:crc8 (xor, sum) and group=NAME`);
}

/** Where the frame or message ends: at the first blank that is in neither quotes nor brackets. */
function endOfFrame(text: string): number {
  let quoted = false;
  let depth = 0;
  for (let at = 0; at < text.length; at++) {
    const letter = text.charAt(at);
    if (letter === '"') quoted = !quoted;
    else if (quoted) continue;
    else if (letter === '(') depth++;
    else if (letter === ')') depth = Math.max(0, depth - 1);
    else if (depth === 0 && /\s/.test(letter)) return at;
  }
  return text.length;
}

/** Throws with what to write if it is none. Whether the frame or message is one is for the server to say, which has the databases. */
export function parseEntry(line: string): SendEntry {
  const text = line.trim();
  const end = endOfFrame(text);
  let frame = text.slice(0, end);
  let channel = 1;
  const place = /^(?:(\d+)|(?:can|vcan|vxcan|slcan)(\d+)):/.exec(frame);
  if (place) {
    channel = place[1] === undefined ? Number(place[2]) + 1 : Number(place[1]);
    frame = frame.slice(place[0].length);
  }
  if (!/.[#:]/.test(frame)) throw new Error(`“${frame}” is neither a frame, such as 123#DEADBEEF, nor a message, such as Engine:Speed=80`);
  if (channel < 1 || channel > 255) throw new Error(`There is no channel ${channel}`);
  let periodMs: number | null = null;
  const changes: Change[] = [];
  for (const word of text.slice(end).split(/\s+/).filter((w) => w !== '')) {
    const at = word.indexOf('=');
    if (at < 0) {
      if (periodMs !== null) throw new Error(`“${word}” is one period too many`);
      periodMs = period(word);
    } else if (!(word.startsWith('group=') && word.length > 6)) changes.push(change(word.slice(0, at), word.slice(at + 1)));
  }
  if (periodMs === null && changes.length > 0) throw new Error('counter=, random= and checksum= need a period, such as 100ms');
  // A checksum is over everything else that changes.
  changes.sort((a, b) => Number('checksum' in a) - Number('checksum' in b));
  return { text, channel, frame, periodMs, changes };
}

/** The line for what the page's fields have. */
export function entryText(channel: number, frame: string, periodMs: number | null, changes: readonly Change[]): string {
  const words = changes.map((c) => {
    if ('counter' in c) return `counter=${c.counter.byte}.${c.counter.lowBit}:${c.counter.bits}`;
    return 'random' in c ? `random=${c.random.byte}` : `checksum=${c.checksum.byte}:${c.checksum.algorithm}`;
  });
  return [`${channel}:${frame}`, ...(periodMs === null ? [] : [`${periodMs}ms`, ...words])].join(' ');
}

/** A file's entries: one a line, `#` at the beginning for a comment. If one is wrong, there are none. */
export function parseList(text: string): SendEntry[] {
  const entries = text.split(/\r?\n/).flatMap((line, at) => {
    if (line.trim() === '' || line.trim().startsWith('#')) return [];
    try {
      return [parseEntry(line)];
    } catch (error) {
      throw new Error(`line ${at + 1}: ${error instanceof Error ? error.message : String(error)}.`);
    }
  });
  if (entries.length > MOST) throw new Error(`${entries.length} entries are too many: a list has at most ${MOST}.`);
  return entries;
}
