// The page's figures against those of the command, for the same files: counts, losses, load, periods, signals at cursors and at zooms, exports.
// The engine is the one in the page as it is delivered.

import assert from 'node:assert/strict';
import { spawnSync } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import { after, test } from 'node:test';
import { gunzipSync } from 'node:zlib';
import { start } from '../../engine/node.mjs';
import { HERE } from './browser.mjs';

const page = readFileSync(process.env.CANTAP_TEST_PAGE, 'utf8');
const wasm = gunzipSync(Buffer.from(/<script[^>]*id="cantap-engine"[^>]*>([^<]*)<\/script>/.exec(page)[1], 'base64'));
const root = join(HERE, '../../..');
const folder = mkdtempSync(join(tmpdir(), 'cantap-truth-'));
after(() => rmSync(folder, { recursive: true }));

/** What the command prints. */
function cantap(...args) {
  const { status, stdout, stderr } = spawnSync(resolve(process.env.CANTAP_TEST_PROGRAM), args, { maxBuffer: 1 << 28 });
  assert.equal(status, 0, stderr.toString());
  return stdout.toString();
}

/** Two channels, remote frames, an error, losses that could only be counted as “at least”, 40 s. */
function lossy() {
  const lines = [];
  const hex = (...bytes) => bytes.map((b) => (b & 0xff).toString(16).toUpperCase().padStart(2, '0')).join('');
  for (let i = 0; i < 4000; i++) {
    const at = (ms) => `(${(1_700_000_000 + i / 100 + ms / 1000).toFixed(6)})`;
    lines.push(`${at(0)} can0 100#${hex(i, i >> 8, i * 7)}`, `${at(2)} can1 ${(0x18fef100 + (i % 3)).toString(16).toUpperCase()}#${hex(i * 31, 255, 0x11, 0x22, i >> 4, 0, 0, 1)}`);
    if (i % 700 === 350) lines.push(`${at(4)} can${Math.floor(i / 700) % 2} 20000004#0001000000000000`);
    if (i === 1234) lines.push(`${at(5)} can0 20000088#0000040200000000`);
    if (i % 50 === 7) lines.push(`${at(6)} can0 123#R`);
  }
  return `${lines.join('\n')}\n`;
}

const LOSSY_DBC = `VERSION ""
BU_: ECU
BO_ 256 Engine: 3 ECU
 SG_ Speed : 0|16@1- (0.25,-10) [0|0] "km/h" ECU
 SG_ Mode : 16|8@1+ (1,0) [0|0] "" ECU
`;

const TRACES = {
  car: { path: join(root, 'docs/screens/drive.log.xz'), bitrate: '500k', database: join(root, 'host/virtual/src/car/car.dbc') },
  vehicle: { path: join(root, 'host/protocols/tests/buses/vehicle.log'), bitrate: '500k' },
  machine: { path: join(root, 'host/protocols/tests/buses/machine.log'), bitrate: '1M' },
  boat: { path: join(root, 'host/protocols/tests/buses/boat.log'), bitrate: '250k' },
  lossy: { text: lossy(), bitrate: '250k', text_database: LOSSY_DBC },
};

const near = (a, b, tolerance, about) => assert.ok(Math.abs(a - b) <= tolerance, `${about}: ${a} in the page, ${b} from the command`);

/** The value that holds at a time, as `valueAt` in the page. */
function valueAt(series, time) {
  let column = series.end.findIndex((end) => end >= time);
  if (column < 0 || series.time[column] > time) column = (column < 0 ? series.end.length : column) - 1;
  return column < 0 ? null : series.end[column] <= time ? series.last[column] : series.min[column];
}

for (const [name, trace] of Object.entries(TRACES)) {
  test(`${name}: the page's figures are the command's`, async () => {
    const path = join(folder, `${name}.log`);
    // Through the command, which unpacks.
    if (trace.text) writeFileSync(path, trace.text);
    else cantap('convert', trace.path, path);
    let { database } = trace;
    if (trace.text_database) writeFileSync((database = join(folder, `${name}.dbc`)), trace.text_database);
    const bytes = new Uint8Array(readFileSync(path));
    const { ask } = await start(wasm);
    ask('open', { name: `${name}.log`, more: false, size: bytes.byteLength }, bytes);
    if (database) ask('database', { name: 'the.dbc', channel: null }, new Uint8Array(readFileSync(database)));
    const stats = JSON.parse(cantap('stats', path, '-b', trace.bitrate, '--json', '--per-id', '--windows'));
    const begin = stats.first_s;
    for (const { channel, bitrate_bps } of stats.channels) ask('bitrate', { channel, bitrate: bitrate_bps });
    const summary = ask('summary', {});

    // Counts, losses, load over all.
    assert.equal(summary.frames, stats.frames);
    near(summary.duration, stats.duration_s, 1e-6, 'length');
    assert.equal(summary.losses.reduce((sum, l) => sum + l.count, 0), stats.lost);
    assert.equal(summary.losses.some((l) => l.atLeast), stats.lost_at_least);
    for (const of of stats.channels) {
      const shown = summary.channels.find((c) => c.channel === of.channel);
      assert.deepEqual([shown.frames, shown.remote, shown.sent, shown.errors], [of.frames, of.remote, of.sent, of.errors.total]);
      if (of.bus_load_pct === null) assert.equal(shown.load, null);
      else near(shown.load * 100, of.load.mean_pct, 1e-9, `load of channel ${of.channel}`);
    }
    assert.equal(ask('gaps', { from: 0, to: summary.duration }).length, stats.channels.reduce((sum, c) => sum + c.lost.gaps, 0));

    // Load of each second, to within the frame at either edge.
    for (const { channel, bitrate_bps } of stats.channels) {
      const frame_pct = (2 * 160 * 100) / bitrate_bps;
      for (const { start_s, length_s, load_pct } of stats.windows.filter((w) => w.channel === channel)) {
        if (load_pct === null) continue;
        const from = start_s - begin;
        const { load } = ask('load', { channel, from, to: from + length_s, columns: 1 });
        near(load[0] * 100, load_pct, frame_pct, `load of channel ${channel} from ${from} s`);
      }
    }

    // Identifiers and their periods.
    const ids = ask('ids', { at: null });
    assert.equal(ids.length, stats.channels.reduce((sum, c) => sum + c.ids.length, 0));
    for (const { channel, ids: list } of stats.channels) {
      for (const of of list) {
        const id = { channel, id: parseInt(of.id, 16), extended: of.extended };
        const row = ids.find((r) => r.channel === channel && r.id === id.id && r.extended === id.extended);
        assert.equal(row.count, of.count, of.id);
        near(row.lastTime, of.last_s - begin, 1e-6, of.id);
        const periods = ask('periods', id);
        // With losses on its channel, those periods are left out, and the command has them.
        if (of.period_mean_ms === null || stats.lost > 0) continue;
        near(periods.min * 1e3, of.period_min_ms, 1e-6, `${of.id}, smallest period`);
        near(periods.max * 1e3, of.period_max_ms, 1e-6, `${of.id}, largest period`);
        near(periods.mean * 1e3, of.period_mean_ms, 1e-6, `${of.id}, mean period`);
        assert.equal(periods.counts.reduce((sum, n) => sum + n, 0), of.count - 1, of.id);
      }
    }

    // Signals: values, smallest and largest at several zooms, and at cursors.
    if (database) {
      const decoded = new Map();
      for (const line of cantap('decode', path, '--db', database, '--json').trim().split('\n')) {
        const { time_s, channel, message, signals } = JSON.parse(line);
        for (const [signal, value] of Object.entries(signals ?? {})) {
          const key = `${channel} ${message}.${signal}`;
          if (!decoded.has(key)) decoded.set(key, []);
          if (typeof value === 'number') decoded.get(key).push([time_s - begin, value]);
        }
      }
      let compared = 0;
      for (const message of ask('messages', {})) {
        for (const signal of message.signals) {
          const lists = [...decoded].filter(([key]) => key.endsWith(` ${message.name}.${signal.name}`)).map(([, list]) => list);
          if (lists.length !== 1 || lists[0].length === 0) continue;
          const [values] = lists;
          const about = `${message.name}.${signal.name}`;
          for (const [a, b] of [[0, 1], [0.1, 0.9], [0.37, 0.42], [0.5, 0.501]]) {
            // Between two frames, so that no rounding decides.
            const from = a === 0 ? -1 : a * summary.duration + 0.000_000_3;
            const to = b === 1 ? summary.duration + 1 : b * summary.duration + 0.000_000_3;
            const inside = values.filter(([t]) => t >= from && t <= to).map(([, v]) => v);
            for (const columns of [7, 500]) {
              const series = ask('series', { signal: signal.key, from, to, columns });
              let [low, high] = [Infinity, -Infinity];
              for (let i = 0; i < series.time.length; i++) {
                if (series.end[i] < from || series.time[i] > to) continue;
                low = Math.min(low, series.min[i]);
                high = Math.max(high, series.max[i]);
              }
              assert.deepEqual([low, high], [Math.min(...inside), Math.max(...inside)], `${about} from ${from} to ${to}`);
            }
            const held = values.findLast(([t]) => t <= to)?.[1] ?? null;
            assert.equal(valueAt(ask('series', { signal: signal.key, from: to, to, columns: 4 }), to), held, `${about} at ${to}`);
            compared++;
          }
        }
      }
      assert.ok(compared > 3, `${compared} comparisons`);
    }

    // Everything, exported.
    const out = ask('export', { view: 0, format: 'candump', from: null, to: null });
    assert.equal(Buffer.from(out.bytes).toString(), cantap('convert', path, '-', '--to', 'candump'));
  });
}

test('a trace in zstd is the trace, whole or cut', async () => {
  const [plain, packed] = ['zstd.log', 'zstd.log.zst'].map((name) => join(folder, name));
  writeFileSync(plain, TRACES.lossy.text);
  cantap('convert', plain, packed);
  const { ask } = await start(wasm);
  const opened = (bytes) => {
    ask('open', { name: 'zstd.log.zst', more: false, size: bytes.byteLength }, bytes);
    return ask('summary', {});
  };
  const bytes = new Uint8Array(readFileSync(packed));
  const { frames } = JSON.parse(cantap('stats', plain, '--json'));
  assert.equal(opened(bytes).frames, frames);
  const cut = opened(bytes.subarray(0, bytes.length / 2));
  assert.ok(cut.frames < frames);
});
