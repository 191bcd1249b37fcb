// The page as it is delivered, over its own engine: each view's figures against those of a trace that is computed here.

import assert from 'node:assert/strict';
import { spawnSync } from 'node:child_process';
import { join } from 'node:path';
import { after, test } from 'node:test';
import { HERE, newPage, quit, saved, show, until, untilRow, untilText } from './browser.mjs';

after(quit);

const PAGE = process.env.CANTAP_TEST_PAGE;
const FRAMES = 4000;

const speed = (i) => 400 + Math.round(300 * Math.sin(i / 100));
const hex = (bytes) => bytes.map((b) => (b & 0xff).toString(16).toUpperCase().padStart(2, '0')).join('');

/** A frame of 100 each 10 ms, and of 18FEF100 half a period later; one exchange of UDS in between. */
function lines() {
  const all = [];
  const at = (us) => `(1700000000.${String(us).padStart(6, '0')})`.replace(/\((\d+)\.(\d+)\)/, (_, s, u) => `(${Number(s) + Math.floor(us / 1e6)}.${String(us % 1e6).padStart(6, '0')})`);
  for (let i = 0; i < FRAMES; i++) {
    const raw = speed(i);
    all.push(`${at(i * 10_000)} can0 100#${hex([raw, raw >> 8, i % 4, 0, i >> 8, i, 0, 0])}`);
    all.push(`${at(i * 10_000 + 5000)} can0 18FEF100#${hex([0xff, i, i >> 8, 0, 0, 0, 0, 0])}`);
    if (i === 1000) all.push(`${at(i * 10_000 + 6000)} can0 7E0#0322F190AAAAAAAA`, `${at(i * 10_000 + 8000)} can0 7E8#037F2231AAAAAAAA`);
  }
  return all;
}

const DBC = `VERSION ""
BS_:
BU_: ECU
BO_ 256 Engine: 8 ECU
 SG_ Speed : 0|16@1+ (0.25,0) [0|250] "km/h" ECU
 SG_ Mode : 16|2@1+ (1,0) [0|3] "" ECU
 SG_ Total : 16|48@1+ (1,0) [0|0] "" ECU
CM_ SG_ 256 Speed "</script><img src=x onerror=alert(1)>";
VAL_ 256 Mode 0 "off" 1 "on" 2 "</b>hot" 3 "cold" ;
`;

const file = (name, text) => ({ name, mimeType: 'application/octet-stream', buffer: Buffer.from(text) });

async function opened(view) {
  const page = await newPage({ file: PAGE });
  await page.locator('main.start input[type=file]').setInputFiles([file('drive.log', `${lines().join('\n')}\n`), file('car.dbc', DBC)]);
  await page.locator('.shell[data-growing=false]').waitFor();
  await until(page, 'the database is there', () => document.querySelector('#view-summary').textContent.includes('car.dbc'));
  await show(page, view);
  return page;
}

test('summary: frames, length and channel are those of the file', async () => {
  const page = await opened('summary');
  await untilText(page, '#view-summary', `Frames8 002`);
  await untilText(page, '#view-summary', 'Start2023-11-14 22:13:20.000000 UTC');
  await page.done();
});

test('trace: rows, decoded signals, filters and conditions, search', async () => {
  const page = await opened('trace');
  await page.locator('#view-trace .list').focus();
  await page.keyboard.press('Home');
  await untilRow(page, 0);
  await untilText(page, '#view-trace .details', 'Speed100km/h');
  await untilText(page, '#view-trace .details', 'Modeoff');
  await page.locator('#trace-filter').fill('100');
  await untilText(page, '#view-trace .state', '4 000 of 8 002 records');
  const fast = Array.from({ length: FRAMES }, (_, i) => speed(i)).filter((raw) => raw * 0.25 > 150).length;
  await page.locator('#trace-filter').fill('Speed > 150');
  await untilText(page, '#view-trace .state', `${String(fast).replace(/\B(?=(\d{3})+$)/g, ' ')} of 8 002 records`);
  await page.locator('#trace-filter').fill('Speed >');
  await until(page, 'the filter is refused with words', () => document.querySelector('#view-trace .state.bad')?.textContent.length > 10);
  await page.locator('#trace-filter').fill('');
  await untilText(page, '#view-trace .state', '8 002 records');
  await page.locator('#view-trace .list').focus();
  await page.keyboard.press('Home');
  await page.locator('#trace-find').fill('7E8');
  await untilText(page, '#view-trace .list-row.selected', '03 7F 22 31');
  await page.done();
});

test('graphs: every value is in the columns, and texts are lanes', async () => {
  const page = await opened('graphs');
  await page.locator('#view-graphs .tree-signal', { hasText: 'Speed' }).click();
  await until(page, 'columns', () => document.querySelector('#view-graphs').dataset.busy === 'false' && document.querySelectorAll('.panel').length === 1);
  const csv = (await saved(page, () => page.getByRole('button', { name: 'CSV' }).click())).bytes.toString();
  const rows = csv.trim().split('\r\n').slice(1).map((line) => line.split(',').map(Number));
  const raws = Array.from({ length: FRAMES }, (_, i) => speed(i) * 0.25);
  assert.equal(Math.min(...rows.map((r) => r[5])), Math.min(...raws));
  assert.equal(Math.max(...rows.map((r) => r[6])), Math.max(...raws));
  for (const [, , time, end, first, min, max, last] of rows) {
    const [a, b] = [Math.round(time * 100), Math.round(end * 100)];
    const part = raws.slice(a, b + 1);
    assert.deepEqual([first, min, max, last], [part[0], Math.min(...part), Math.max(...part), part.at(-1)], `from ${time} to ${end}`);
  }
  await page.locator('#view-graphs .tree-signal', { hasText: 'Mode' }).click();
  await until(page, 'a lane', () => document.querySelectorAll('.panel.digital').length === 1);
  await page.done();
});

test('a value of many digits is shown whole at a cursor', async () => {
  const page = await opened('graphs');
  await page.locator('#view-graphs .tree-signal', { hasText: 'Total' }).click();
  await page.locator('#view-graphs .graph-stack').focus();
  await page.keyboard.press(':');
  await page.getByLabel('Time', { exact: true }).fill('0.041');
  await page.keyboard.press('Enter');
  await untilText(page, '#view-graphs .legend', 'A 67108864');
  await page.done();
});

test('fixed view and periods give the identifier’s period', async () => {
  const page = await opened('fixed');
  await untilText(page, '#view-fixed .list-layer', '100Engine4 00010.000');
  await page.locator('#view-fixed .list').focus();
  await page.keyboard.press('Home');
  await show(page, 'statistics');
  await untilText(page, '#view-statistics', 'Mean10 ms');
  await untilText(page, '#view-statistics', 'Periods3 999');
  await page.done();
});

test('bits: changes are counted, a signal is made of them, and its DBC is read again, by cantools too', async (t) => {
  const page = await opened('bits');
  await untilText(page, '#view-bits .state', '4 000 frames');
  assert.match(await page.locator('#bit-23').getAttribute('aria-label'), /byte 2 bit 0: 3.999 changes/);
  const from = await page.locator('#bit-40').boundingBox();
  const to = await page.locator('#bit-47').boundingBox();
  await page.mouse.move(from.x + 5, from.y + 5);
  await page.mouse.down();
  await page.mouse.move(to.x + 5, to.y + 5);
  await page.mouse.up();
  await page.keyboard.press('s');
  await page.getByLabel('Signal name').fill('Counter');
  await untilText(page, '.signal-editor [role=status]', '0 … 255, 4 000 values');
  await page.getByRole('button', { name: 'Make the signal' }).click();
  await until(page, 'the signal is there', () => [...document.querySelectorAll('.bit-legend button')].some((b) => b.textContent.startsWith('Counter ')));
  const dbc = await saved(page, () => page.getByRole('button', { name: 'Save DBC' }).click());
  assert.match(dbc.bytes.toString(), /BO_ 256 \w+: 8 [\s\S]*SG_ Counter : 40\|8@1\+ \(1,0\)/);
  // Not strict: the database that was opened has overlapping signals.
  const program = "import cantools, sys; print([(s.name, s.start, s.length) for s in cantools.database.load_string(sys.stdin.read(), 'dbc', strict=False).get_message_by_frame_id(256).signals])";
  const cantools = spawnSync(process.env.CANTAP_PYTHON ?? 'python3', ['-c', program], { input: dbc.bytes, encoding: 'utf8' });
  if (cantools.error || cantools.stderr.includes("No module named 'cantools'")) t.diagnostic('cantools is not there: only our own reader has read the DBC');
  else assert.ok(cantools.stdout.includes("('Counter', 40, 8)"), cantools.stderr + cantools.stdout);
  await page.done();
});

test('conversations: a refused UDS request is marked as failed', async () => {
  const page = await opened('conversations');
  await page.keyboard.press('/');
  await page.keyboard.type('refusal F190');
  await until(page, 'a failed exchange', () => document.querySelectorAll('#view-conversations .list:not([hidden]) .list-row.failed:not([hidden])').length >= 1);
  await page.done();
});

test('conversations: who is not known is not drawn as somebody who is', async () => {
  const page = await newPage({ file: PAGE });
  await page.locator('main.start input[type=file]').setInputFiles([join(HERE, '../../../host/protocols/tests/buses/machine.log')]);
  await page.locator('.shell[data-growing=false]').waitFor();
  await show(page, 'conversations');
  await until(page, 'what the master writes comes from the edge', () => {
    const row = [...document.querySelectorAll('#view-conversations .list:not([hidden]) .list-row:not([hidden])')].find((r) => r.textContent.includes('SDO write 1017:00'));
    return row.querySelector('svg').getAttribute('aria-label') === 'unknown to 5' && row.querySelector('line.arrow.unknown').getAttribute('x1') === '1';
  });
  await page.done();
});

test('without a database: CANopen nodes have their states, and what protocols name is drawn', async () => {
  const page = await newPage({ file: PAGE });
  await page.locator('main.start input[type=file]').setInputFiles([join(HERE, '../../../host/protocols/tests/buses/machine.log')]);
  await page.locator('.shell[data-growing=false]').waitFor();
  await show(page, 'conversations');
  await page.getByLabel('Shape').selectOption('nodes');
  await untilText(page, '#view-conversations .list:not([hidden]) .list-layer', 'canopen');
  const nodes = await page.locator('#view-conversations .list:not([hidden]) .list-layer .list-row:not([hidden])').evaluateAll((rows) => rows.map((row) => [...row.children].map((cell) => cell.textContent)));
  assert.deepEqual(nodes.map((cells) => [1, 2, 3, 5].map((i) => cells[i])), [['canopen', '5', 'boot-up', 'operation enabled'], ['canopen', '6', 'operational', '']]);
  await show(page, 'graphs');
  await page.locator('.tree-look').click();
  await untilText(page, '.fields-state', 'of protocols');
  await page.getByLabel('Search messages and signals').fill('nmt_state');
  await page.locator('#view-graphs .tree-signal', { hasText: 'nmt_state' }).first().click();
  await until(page, 'its states are a lane', () => document.querySelector('.panel')?.classList.contains('digital') && document.querySelector('#view-graphs').dataset.busy === 'false');
  await page.done();
});

test('an export of everything as candump is the file, line for line', async () => {
  const page = await opened('trace');
  await page.getByRole('button', { name: 'Export …' }).click();
  await page.getByLabel('Format', { exact: true }).selectOption('candump');
  const out = await saved(page, () => page.getByRole('button', { name: 'Export', exact: true }).click());
  assert.deepEqual(out.bytes.toString().trim().split('\n').map((l) => l.replace(/ [RT]$/, '')), lines());
  await page.done();
});

test('a file of no known format is refused in words, and the page goes on', async () => {
  const page = await newPage({ file: PAGE });
  await page.locator('main.start input[type=file]').setInputFiles([file('x.bin', Buffer.from([0, 1, 2, 3, 255, 254]))]);
  await page.locator('.notice.error').waitFor();
  await page.locator('main.start input[type=file]').setInputFiles([file('drive.log', lines()[0])]);
  await page.locator('.shell').waitFor();
  await page.locator('.shell > input[type=file]').setInputFiles([file('y.bin', Buffer.from([0, 1, 2, 3, 255, 254]))]);
  await until(page, 'the second file is refused, too', () => document.querySelectorAll('.notice.error').length === 2);
  await show(page, 'trace');
  await page.locator('#trace-filter').fill('100');
  await untilText(page, '#view-trace .state', '1 of 1 record');
  await page.done();
});
