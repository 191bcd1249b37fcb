// Measures the engine as WebAssembly under node, over a trace in a file:
//   node web/engine/measure.mjs ENGINE.wasm TRACE [DATABASE]
// Prints how long opening takes, in pieces as the page hands them over, and how long the answers that a view waits for.

import { closeSync, openSync, readFileSync, readSync, statSync } from 'node:fs';
import { basename } from 'node:path';
import { start } from './node.mjs';

const [wasm, trace, database] = process.argv.slice(2);
if (!wasm || !trace) {
  console.error('usage: node web/engine/measure.mjs ENGINE.wasm TRACE [DATABASE]');
  process.exit(2);
}
const { ask, memory } = await start(readFileSync(wasm));

function timed(name, act) {
  const begin = performance.now();
  const result = act();
  console.log(`${name.padEnd(44)} ${(performance.now() - begin).toFixed(1).padStart(9)} ms`);
  return result;
}

const size = statSync(trace).size;
const file = openSync(trace, 'r');
let summary;
const begin = performance.now();
const processor = process.cpuUsage();
let first = 0;
for (let at = 0; at < size; ) {
  const piece = Buffer.alloc(Math.min(at === 0 ? 1 << 20 : 8 << 20, size - at));
  readSync(file, piece, 0, piece.byteLength, at);
  const request = at === 0 ? 'open' : 'append';
  at += piece.byteLength;
  summary = ask(request, { name: basename(trace), more: at < size, size }, piece);
  if (!first && summary.records > 0) first = performance.now() - begin;
}
closeSync(file);
const seconds = (performance.now() - begin) / 1000;
// On a machine that does other things as well, this is less.
const busy = process.cpuUsage(processor).user / 1e6;
console.log(`${summary.format}, ${size} bytes, ${summary.records} records in ${seconds.toFixed(2)} s: ${(summary.records / seconds / 1e6).toFixed(2)} million/s, by the processor's time ${(summary.records / busy / 1e6).toFixed(2)}; first rows after ${first.toFixed(0)} ms`);
if (database) timed('database', () => ask('database', { name: basename(database), channel: null }, readFileSync(database)));
const messages = timed('messages, with the index', () => ask('messages', {}));
timed('rows, 60 in the middle', () => ask('rows', { view: 0, from: Math.floor(summary.records / 2), count: 60 }));
timed('filter by an identifier', () => ask('filter', { filter: '100-1FF' }));
timed('find bytes', () => ask('find', { view: 0, text: '* DE AD', from: -1, backwards: false }));
timed('the fixed view', () => ask('ids', { at: null }));
const signals = messages.filter((message) => message.count > 0).flatMap((message) => message.signals.map((signal) => ({ count: message.count, ...signal })));
signals.sort((a, b) => b.count - a.count);
for (const signal of signals.slice(0, 3)) {
  const all = { signal: signal.key, from: null, to: null, columns: 1200 };
  timed(`${signal.name}: ${signal.count} frames, first picture`, () => ask('series', { ...all }));
  timed(`${signal.name}: again`, () => ask('series', { ...all }));
  timed(`${signal.name}: a tenth of the time`, () => ask('series', { ...all, from: summary.duration * 0.4, to: summary.duration * 0.5 }));
  timed(`${signal.name}: a millisecond`, () => ask('series', { ...all, from: summary.duration * 0.4, to: summary.duration * 0.4 + 0.001 }));
}
ask('bitrate', { channel: summary.channels[0].channel, bitrate: 500000 });
timed('load, first picture', () => ask('load', { channel: summary.channels[0].channel, from: null, to: null, columns: 1200 }));
timed('load, again', () => ask('load', { channel: summary.channels[0].channel, from: null, to: null, columns: 1200 }));
timed('findings', () => ask('findings', {}));
console.log(`memory of the engine: ${(memory() / 1e6).toFixed(0)} MB`);
