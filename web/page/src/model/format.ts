// Numbers, times and identifiers as they are shown. Every number that has a unit is shown with it.

import type { Summary } from '../api';

const SEPARATOR = ' '; // narrow blank that does not break

/** 1234567 → `1 234 567`. */
export function count(value: number): string {
  return String(Math.round(value)).replace(/\B(?=(\d{3})+$)/g, SEPARATOR);
}

export function plural(value: number, one: string, many = `${one}s`): string {
  return `${count(value)} ${value === 1 ? one : many}`;
}

/** How many frames are missing: after a gap, nobody knows. */
export function missing(frames: number, atLeast: boolean): string {
  if (frames === 0 && atLeast) return 'an unknown number of frames';
  return `${atLeast ? 'at least ' : ''}${plural(frames, 'frame')}`;
}

/** Identifiers as in cantap's grammar: three digits for 11 bits, eight for 29. */
export function idText(id: number, extended: boolean): string {
  return id.toString(16).toUpperCase().padStart(extended ? 8 : 3, '0');
}

/** `DEADBEEF` → `DE AD BE EF`. */
export function bytesText(hex: string): string {
  return hex.replace(/(..)(?=.)/g, '$1 ');
}

/** Seconds since the start, with microseconds: `12.345678`. */
export function seconds(value: number): string {
  return value.toFixed(6);
}

/** A stretch of time with the unit that fits: `12.5 ms`. */
export function duration(value: number): string {
  if (!Number.isFinite(value)) return '–';
  const size = Math.abs(value);
  if (size === 0) return '0 s';
  if (size < 1e-3) return `${significant(value * 1e6)} µs`;
  if (size < 1) return `${significant(value * 1e3)} ms`;
  if (size < 120) return `${significant(value)} s`;
  const sign = value < 0 ? '−' : '';
  const whole = Math.floor(size);
  const h = Math.floor(whole / 3600);
  const m = Math.floor((whole % 3600) / 60);
  const s = whole % 60;
  return h > 0 ? `${sign}${h} h ${pad2(m)} min ${pad2(s)} s` : `${sign}${m} min ${pad2(s)} s`;
}

/** Whose clock measured an interval, if the trace has two: what the device counted differs from UTC, which is corrected now and then. */
export function clock(byDevice: boolean, summary: Pick<Summary, 'deviceTimes'> | null): string {
  if (byDevice) return 'by the device’s clock';
  return summary?.deviceTimes ? 'by UTC' : '';
}

/** At most five significant digits, without trailing zeros. */
export function significant(value: number, digits = 5): string {
  if (!Number.isFinite(value)) return String(value);
  const size = Math.abs(value);
  if (size !== 0 && (size >= Math.max(1e9, 10 ** digits) || size < 1e-4)) return Number(value.toPrecision(digits)).toExponential().replace('-', '−');
  return String(Number(value.toPrecision(digits))).replace('-', '−');
}

/** A value of a signal, with its unit: whole, without the last digit that is only the arithmetic's. */
export function quantity(value: number, unit: string, digits = 15): string {
  const number = significant(value, digits);
  return unit ? `${number} ${unit}` : number;
}

/** To a tenth; what is there, but less, is not shown as nothing. */
export function percent(share: number | null): string {
  if (share === null) return '–';
  return share > 0 && share < 0.0005 ? '< 0.1 %' : `${(share * 100).toFixed(1)} %`;
}

/** In four characters where there is little room: `987`, `12.3k`, `1.23M`. */
export function shortCount(value: number): string {
  const unit = value >= 1e6 ? 1e6 : 1e3;
  if (value < 1000) return String(value);
  const digits = value / unit;
  // Cut, not rounded: what is shown was reached.
  const decimals = digits < 10 ? 2 : digits < 100 ? 1 : 0;
  return `${(Math.floor(digits * 10 ** decimals) / 10 ** decimals).toFixed(decimals)}${unit === 1e6 ? 'M' : 'k'}`;
}

export function bytes(size: number): string {
  if (size < 1000) return `${size} B`;
  if (size < 1e6) return `${significant(size / 1e3, 3)} kB`;
  if (size < 1e9) return `${significant(size / 1e6, 3)} MB`;
  return `${significant(size / 1e9, 3)} GB`;
}

export function bitrate(value: number | null): string {
  if (value === null) return 'unknown';
  return value >= 1e6 ? `${significant(value / 1e6)} Mbit/s` : `${significant(value / 1e3)} kbit/s`;
}

/** `2026-11-28 05:12:35.123456 UTC`; `ns` is nanoseconds since 1970 as decimal text. */
export function utc(ns: string, offset: number): string {
  const total = BigInt(ns) + BigInt(Math.round(offset * 1e9));
  const us = total / 1000n;
  const ms = Number(us / 1000n);
  const date = new Date(ms);
  if (Number.isNaN(date.getTime())) return '–';
  return `${date.toISOString().slice(0, 23).replace('T', ' ')}${String(us % 1000n).padStart(3, '0')}`;
}

function pad2(value: number): string {
  return String(value).padStart(2, '0');
}

/** Reads a time as docs/grammar.md has it: `1m30s`, `400ms`, `1:02:03`, or seconds. Null if it is none. */
export function parseTime(text: string): number | null {
  const trimmed = text.trim().replaceAll(SEPARATOR, '');
  if (/^-?\d+(\.\d*)?(e[+-]?\d+)?$/i.test(trimmed)) return Number(trimmed);
  const clock = /^(?:(\d+):)?(\d+):(\d+(?:\.\d*)?)$/.exec(trimmed);
  if (clock) return Number(clock[1] ?? 0) * 3600 + Number(clock[2]) * 60 + Number(clock[3]);
  const units: Record<string, number> = { d: 86400, h: 3600, min: 60, m: 60, s: 1, ms: 1e-3, us: 1e-6, µs: 1e-6, ns: 1e-9 };
  let total = 0;
  let rest = trimmed;
  if (rest === '') return null;
  while (rest !== '') {
    const part = /^(\d+(?:\.\d*)?)\s*(min|ms|us|µs|ns|d|h|m|s)\s*/.exec(rest);
    if (!part) return null;
    total += Number(part[1]) * (units[part[2] ?? ''] ?? 0);
    rest = rest.slice(part[0].length);
  }
  return total;
}
