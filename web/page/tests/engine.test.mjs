// The engine as WebAssembly, taken out of the page as it is delivered: what the same code does natively must not need a clock, a thread or a
// file here.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';
import { gunzipSync } from 'node:zlib';
import { start } from '../../engine/node.mjs';

const page = readFileSync(process.env.CANTAP_TEST_PAGE, 'utf8');
const packed = /<script[^>]*id="cantap-engine"[^>]*>([^<]*)<\/script>/.exec(page)[1];
const wasm = gunzipSync(Buffer.from(packed, 'base64'));
const log = Array.from({ length: 400 }, (_, n) => `(${(1700000000 + n / 100).toFixed(6)}) can${n % 2} ${n % 4 === 3 ? '7E8#0102' : `123#${(n % 256).toString(16).padStart(2, '0')}00000000`}\n`).join('');
const bytes = (text) => new TextEncoder().encode(text);

test('a trace is opened in pieces, exported in every format, and read again', async () => {
  const { ask } = await start(wasm);
  const half = 8001;
  ask('open', { name: 'drive.log', more: true, size: log.length }, bytes(log.slice(0, half)));
  const summary = ask('append', { more: false }, bytes(log.slice(half)));
  assert.deepEqual([summary.records, summary.issues], [400, []]);
  for (const { name } of ask('formats', {})) {
    const file = ask('export', { view: 0, format: name, from: null, to: null });
    const again = (await start(wasm)).ask('open', { name: file.name, more: false, size: file.bytes.byteLength }, file.bytes);
    assert.equal(again.frames, 400, name);
  }
});

test('every request answers or says what to do', async () => {
  const { ask } = await start(wasm);
  assert.throws(() => ask('summary', {}), /open one first/);
  ask('open', { name: 'drive.log', more: false, size: log.length }, bytes(log));
  ask('database', { name: 'car.dbc', channel: null }, bytes('BO_ 291 Engine: 8 X\n SG_ Speed : 0|8@1+ (1,0) [0|0] "" X\n'));
  ask('bitrate', { channel: 1, bitrate: 500000 });
  const [message] = ask('messages', {});
  const id = { channel: 1, id: 0x123, extended: false };
  const window = { from: null, to: null };
  assert.equal(ask('series', { signal: message.signals[0].key, ...window, columns: 10 }).values, 200);
  assert.equal(ask('filter', { filter: 'Speed > 10 and ch == 1' }).view, 1);
  assert.ok(ask('find', { view: 0, text: '* 02', from: -1, backwards: false }).row >= 0);
  for (const [request, parameters] of [
    ['rows', { view: 0, from: 0, count: 50 }],
    ['ids', { at: null }],
    ['bits', { ...id, ...window }],
    ['periods', id],
    ['load', { channel: 1, ...window, columns: 20 }],
    ['gaps', window],
    ['conversations', { ...window, limit: 10 }],
    ['findings', {}],
  ])
    assert.ok(ask(request, parameters), request);
  assert.throws(() => ask('filter', { filter: '12g' }), /'12g' is neither/);
});

test('damaged files never stop it', async () => {
  const source = await start(wasm);
  source.ask('open', { name: 'drive.log', more: false, size: log.length }, bytes(log));
  let seed = 7;
  const random = (below) => ((seed = (seed * 1103515245 + 12345) % 2147483648) >> 8) % below;
  for (const { name } of source.ask('formats', {})) {
    const file = source.ask('export', { view: 0, format: name, from: null, to: null });
    for (let round = 0; round < 10; round++) {
      const damaged = file.bytes.slice(0, 1 + random(file.bytes.byteLength));
      for (let n = 0; n < 5; n++) damaged[random(damaged.byteLength)] = random(256);
      const { ask } = await start(wasm);
      try {
        ask('open', { name: file.name, more: false, size: damaged.byteLength }, damaged);
        ask('rows', { view: 0, from: 0, count: 100 });
      } catch (error) {
        assert.ok(!(error instanceof WebAssembly.RuntimeError), `${name}: ${error}`);
      }
    }
  }
});
