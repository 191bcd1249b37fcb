import assert from 'node:assert/strict';
import { after, test } from 'node:test';
import { openTrace, opened, quit, saved, show, until, untilText } from './browser.mjs';

after(quit);

const signal = (page, name) => page.locator('#view-graphs .tree-signal', { hasText: name });
const range = (page) => page.locator('#view-graphs').evaluate((e) => [Number(e.dataset.from), Number(e.dataset.to)]);
const settled = (page) => until(page, 'all columns are there', () => document.querySelector('#view-graphs').dataset.busy === 'false');

async function withGraphs(...names) {
  const page = await opened('graphs');
  for (const name of names) await signal(page, name).click();
  await settled(page);
  return page;
}

async function middle(page, number = 0) {
  const box = await page.locator('.panel-canvas canvas').nth(number).boundingBox();
  return { x: box.x + box.width / 2, y: box.y + box.height / 2, box };
}

test('a click adds a signal and a second one takes it away; keys do, too', async () => {
  const page = await withGraphs('Speed');
  assert.equal(await page.locator('.panel').count(), 1);
  await signal(page, 'Speed').click();
  await until(page, 'no graph is left', () => document.querySelectorAll('.panel').length === 0);
  await page.locator('#view-graphs .tree-message').first().focus();
  await page.keyboard.press('ArrowDown');
  await page.keyboard.press('Enter');
  await until(page, 'one graph', () => document.querySelectorAll('.panel').length === 1);
  await page.done();
});

test('wheel and drag zoom, Shift and drag pan, undo and fit lead back', async () => {
  const page = await withGraphs('Speed');
  assert.deepEqual(await range(page), [0, 19.999]);
  const { x, y } = await middle(page);
  await page.mouse.move(x, y);
  await page.mouse.wheel(0, -400);
  await until(page, 'zoomed in', () => Number(document.querySelector('#view-graphs').dataset.to) < 18);
  const wheeled = await range(page);
  await page.mouse.down();
  await page.mouse.move(x + 100, y);
  await page.mouse.up();
  await until(page, 'zoomed into the box', (to) => Number(document.querySelector('#view-graphs').dataset.to) < to, wheeled[1]);
  const boxed = await range(page);
  assert.ok(boxed[1] - boxed[0] < (wheeled[1] - wheeled[0]) * 0.12);
  await page.keyboard.down('Shift');
  await page.mouse.down();
  await page.mouse.move(x - 50, y);
  await page.mouse.up();
  await page.keyboard.up('Shift');
  await until(page, 'panned', (from) => Number(document.querySelector('#view-graphs').dataset.from) > from, boxed[0]);
  const panned = await range(page);
  assert.ok(Math.abs(panned[1] - panned[0] - (boxed[1] - boxed[0])) < 1e-9);
  for (let i = 0; i < 2; i++) await page.keyboard.press('Backspace');
  await until(page, 'undone', (to) => Number(document.querySelector('#view-graphs').dataset.to) === to, wheeled[1]);
  await page.keyboard.press('0');
  await until(page, 'everything', () => Number(document.querySelector('#view-graphs').dataset.to) === 19.999);
  await page.done();
});

test('two cursors give the exact values at their times, and the differences', async () => {
  const page = await withGraphs('Temperature');
  const { y, box } = await middle(page);
  await page.mouse.click(box.x + 66 + (box.width - 70) * 0.25, y);
  await page.keyboard.down('Shift');
  await page.mouse.click(box.x + 66 + (box.width - 70) * 0.5, y);
  await page.keyboard.up('Shift');
  await untilText(page, '#view-graphs .state', 'Δt');
  await until(page, 'both values', () => /A \d+ °C.*B \d+ °C.*Δy/.test(document.querySelector('.legend').textContent));
  const text = await page.locator('.legend').textContent();
  const [a, b] = [/A (\d+)/.exec(text)[1], /B (\d+)/.exec(text)[1]].map(Number);
  const state = await page.locator('#view-graphs .state').textContent();
  const [ta, tb] = [/A ([\d.]+) s/.exec(state)[1], /B ([\d.]+) s/.exec(state)[1]].map(Number);
  // The tests' device is 400 ppm fast.
  const apart = /Δt ([\d.]+) s .* by the device’s clock/.exec(state)[1];
  assert.ok(Math.abs(apart - (tb - ta) * 1.0004) < 3e-6, state);
  const at = (t) => Math.round(80 + 15 * Math.sin((Math.floor(t / 0.004 + 1e-9) * 0.004) / 7));
  assert.deepEqual([a, b], [at(ta), at(tb)]);
  await page.keyboard.press('m');
  await until(page, 'between the cursors', () => Number(document.querySelector('#view-graphs').dataset.from) > 4);
  await page.done();
});

test('graphs are merged and split, by buttons and by dragging', async () => {
  const page = await withGraphs('Speed', 'Temperature');
  await page.getByRole('button', { name: /^Join Engine.Temperature/ }).click();
  await until(page, 'one graph', () => document.querySelectorAll('.panel').length === 1);
  assert.equal(await page.locator('.legend').count(), 2);
  await page.getByRole('button', { name: /^Split/ }).click();
  await until(page, 'two graphs', () => document.querySelectorAll('.panel').length === 2);
  await page.locator('.legend', { hasText: 'Temperature' }).dragTo(page.locator('.panel').first());
  await until(page, 'one graph again', () => document.querySelectorAll('.panel').length === 1);
  await signal(page, 'Gear').dragTo(page.locator('.panel').first());
  await until(page, 'three in one', () => document.querySelectorAll('.legend').length === 3);
  await page.done();
});

test('signals with texts are lanes; styles change what is drawn', async () => {
  const page = await withGraphs('Gear', 'Speed');
  await until(page, 'a lane', () => document.querySelector('.panel').classList.contains('digital'));
  const picture = () => page.locator('.panel-canvas canvas').nth(1).evaluate((c) => c.toDataURL());
  const step = await picture();
  await page.locator('.panel').nth(1).locator('select').selectOption('points');
  await settled(page);
  await until(page, 'another picture', (old) => document.querySelectorAll('.panel-canvas canvas')[1].toDataURL() !== old, step);
  await page.done();
});

test('the smallest and largest value of each column are drawn: a single frame among a million is in sight', async () => {
  const page = await withGraphs('Speed');
  const svg = (await saved(page, () => page.getByRole('button', { name: 'SVG' }).click())).bytes.toString();
  const csv = (await saved(page, () => page.getByRole('button', { name: 'CSV' }).click())).bytes.toString();
  const rows = csv.trim().split('\r\n').slice(1).map((line) => line.split(',').map(Number));
  assert.ok(rows.length > 500);
  const low = Math.min(...rows.map((r) => r[5]));
  const high = Math.max(...rows.map((r) => r[6]));
  const path = /<path d="(M[^"]{1000,})"/.exec(svg)[1];
  const ys = [...path.matchAll(/[ML][\d.]+ ([\d.]+)/g)].map((m) => Number(m[1]));
  const height = Number(/clipPath id="clip1"><rect[^>]*height="([\d.]+)"/.exec(svg)[1]);
  // The axis has 6 % beyond the values: so their extremes lie at 6/112 of the height from either edge.
  const share = (Math.max(...ys) - Math.min(...ys)) / (height - 10);
  assert.ok(Math.abs(share - 1 / 1.12) < 0.01, `share ${share}, values ${low} to ${high}`);
  await page.done();
});

test('what is saved is well-formed: PNG by its signature, SVG by a parser, CSV by its columns', async () => {
  const page = await withGraphs('Speed', 'Gear');
  const png = await saved(page, () => page.getByRole('button', { name: 'PNG' }).click());
  assert.equal(png.name, 'drive.log.png');
  assert.deepEqual([...png.bytes.subarray(0, 4)], [0x89, 0x50, 0x4e, 0x47]);
  const svg = await saved(page, () => page.getByRole('button', { name: 'SVG' }).click());
  assert.equal(await page.evaluate((text) => new DOMParser().parseFromString(text, 'image/svg+xml').querySelector('parsererror'), svg.bytes.toString()), null);
  assert.match(svg.bytes.toString(), />Second</);
  const csv = await saved(page, () => page.getByRole('button', { name: 'CSV' }).click());
  assert.match(csv.bytes.toString(), /^signal,unit,time_s,end_s,first,min,max,last\r\nEngine\.Speed,rpm,0,/);
  await page.done();
});

test('what is above and below the limits of an alarm is shaded', async () => {
  const page = await withGraphs('Speed');
  const shades = await page.evaluate(() => ['--alarm-above', '--alarm-below'].map((name) => getComputedStyle(document.querySelector('#view-graphs')).getPropertyValue(name).trim()));
  const svg = (await saved(page, () => page.getByRole('button', { name: 'SVG' }).click())).bytes.toString();
  for (const shade of shades) assert.ok(svg.includes(`fill="${shade}"`), `${shade} in ${svg.slice(0, 400)}`);
  await page.done();
});

test('signals of different units in one graph have a scale each', async () => {
  const page = await withGraphs('Speed', 'Temperature');
  await page.getByRole('button', { name: /^Join Engine.Temperature/ }).click();
  await until(page, 'one graph', () => document.querySelectorAll('.panel').length === 1);
  const svg = (await saved(page, () => page.getByRole('button', { name: 'SVG' }).click())).bytes.toString();
  const spread = [...svg.matchAll(/<path d="(M[^"]{1000,})"/g)].map((m) => {
    const ys = [...m[1].matchAll(/[ML][\d.]+ ([\d.]+)/g)].map((p) => Number(p[1]));
    return Math.max(...ys) - Math.min(...ys);
  });
  assert.equal(spread.length, 2);
  assert.ok(Math.abs(spread[0] - spread[1]) < 1, `both fill the height: ${spread}`);
  await page.done();
});

test('numbers that protocols name are looked for when asked, drawn as lines or lanes, and kept in the profile', async () => {
  const page = await opened('graphs');
  const row = (name) => page.locator('.tree [role=treeitem]', { hasText: name }).first();
  assert.equal(await page.locator('.fields-state').isVisible(), false);
  await row('Numbers that protocols name').click();
  await untilText(page, '.fields-state', '2 numbers of protocols');
  await row('engine_speed').click();
  await row('nmt_state').click();
  await until(page, 'two graphs are there', () => document.querySelectorAll('.panel').length === 2);
  await untilText(page, '.panel:first-child .legend-name', '0 > all EEC1 engine: engine_speed');
  await until(page, 'a state is a lane', () => document.querySelectorAll('.panel')[1].classList.contains('digital'));
  await page.locator('#view-graphs .graph-stack').focus();
  await page.keyboard.press('a');
  await untilText(page, '.panel:nth-child(2) .legend', 'A pre-operational');
  const kept = await page.evaluate(() => JSON.parse(localStorage.getItem('cantap.profile')).panels.map((panel) => panel.items[0]));
  assert.deepEqual(kept[0], { kind: 'field', channel: 1, name: 'j1939.engine_speed', between: '0 > all', message: 'EEC1 engine', which: '' });
  // Whoever comes back sees them again, without asking.
  await page.reload();
  await openTrace(page);
  await show(page, 'graphs');
  await untilText(page, '.fields-state', '2 numbers of protocols');
  await until(page, 'they are drawn', () => document.querySelectorAll('.panel').length === 2 && !document.querySelector('.panels').textContent.includes('no message has it'));
  await page.done();
});

test('a message of the tree is closed and opened again', async () => {
  const page = await opened('graphs');
  const engine = page.locator('.tree-message', { hasText: 'Engine' });
  await engine.click();
  await until(page, 'closed', () => document.querySelectorAll('.tree-message[aria-expanded=false]').length === 1);
  assert.equal(await signal(page, 'Speed').count(), 0);
  await page.keyboard.press('ArrowRight');
  await until(page, 'open', () => document.querySelectorAll('.tree-message[aria-expanded=false]').length === 0);
  await page.done();
});

test('bus load is a graph, and the search leaves what matches', async () => {
  const page = await withGraphs('Bus load');
  await page.keyboard.press('/');
  await page.keyboard.type('gear');
  await until(page, 'only the gear is left', () => document.querySelectorAll('.tree-signal').length === 1);
  assert.match(await page.locator('.legend').textContent(), /Bus load, channel 1%/);
  await page.done();
});
