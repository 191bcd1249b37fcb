import assert from 'node:assert/strict';
import { after, test } from 'node:test';
import { opened, quit, rowsInSight, untilRow, untilText, until } from './browser.mjs';

after(quit);

const focus = (page) => page.locator('#view-trace .list').focus();

test('rows are walked by keys, and the selected one shows its bytes and signals', async () => {
  const page = await opened('trace');
  await focus(page);
  for (let i = 0; i < 5; i++) await page.keyboard.press('ArrowDown');
  await untilRow(page, 4);
  await untilText(page, '#view-trace .details', 'Record5 of 20 000');
  await untilText(page, '#view-trace .details', 'Speed');
  await page.keyboard.press('End');
  await untilRow(page, 19_999);
  await untilText(page, '#view-trace .details', 'at least 7 frames lost');
  await page.keyboard.press('PageUp');
  await page.keyboard.press('Home');
  await untilRow(page, 0);
  await page.done();
});

test('a loss stands out as a row of its own, and a late stamp is marked', async () => {
  const page = await opened('trace');
  await focus(page);
  await page.keyboard.press('End');
  await untilRow(page, 19_999);
  const lost = page.locator('#view-trace .list-row[data-index="19999"]');
  assert.equal(await lost.getAttribute('data-kind'), 'lost');
  assert.match(await lost.textContent(), /LOST.*at least 7 frames/);
  await page.keyboard.press('Home');
  await untilRow(page, 0);
  assert.match(await page.locator('#view-trace .list-row[data-index="5"] .late').textContent(), /≤0\.005000/);
  await page.done();
});

test('a filter is applied as it is typed; a bad one says why, and the rows of the last good one stay', async () => {
  const page = await opened('trace');
  await page.keyboard.press('/');
  await page.keyboard.type('123');
  await untilText(page, '#view-trace .state', '5 000 of 20 000 records');
  await page.keyboard.type('~');
  await untilText(page, '#view-trace .state', 'is no filter');
  assert.equal(await page.locator('#trace-filter').getAttribute('aria-invalid'), 'true');
  assert.ok((await rowsInSight(page)).every((row) => row.text.includes('Gearbox')));
  await page.keyboard.press('Backspace');
  await untilText(page, '#view-trace .state', '5 000 of 20 000 records');
  await page.keyboard.press('Enter');
  await page.keyboard.press('Escape');
  await untilText(page, '#view-trace .state', '20 000 records');
  await page.done();
});

test('find goes forwards and backwards, and says when there is none', async () => {
  const page = await opened('trace');
  await page.locator('#trace-find').fill('lost');
  await untilRow(page, 4999);
  await page.locator('#trace-find').press('Enter');
  await untilRow(page, 9999);
  await page.locator('#view-trace .list').focus();
  await page.keyboard.press('n');
  await untilRow(page, 14_999);
  await page.keyboard.press('N');
  await untilRow(page, 9999);
  await page.locator('#trace-find').fill('nothing');
  await untilText(page, '#view-trace .state', 'none below');
  await page.done();
});

test('times are shown since the start, in UTC or since the row above', async () => {
  const page = await opened('trace');
  await until(page, 'seconds', () => document.querySelector('#view-trace .list-row[data-index="2"] .c-time')?.textContent === '0.002000');
  await focus(page);
  await page.keyboard.press('t');
  await until(page, 'UTC', () => document.querySelector('#view-trace .list-row[data-index="2"] .c-time').textContent === '05:12:35.125456');
  await page.keyboard.press('t');
  await until(page, 'a difference', () => document.querySelector('#view-trace .list-row[data-index="2"] .c-time').textContent === '+0.001000');
  await page.done();
});

// The tests' device is 400 ppm fast.
test('a difference of rows is the device’s, and the details say so', async () => {
  const page = await opened('trace');
  await page.locator('#trace-filter').fill('100');
  await until(page, 'the filtered rows', () => document.querySelector('#view-trace .list-row[data-index="2"] .c-time')?.textContent === '0.008000');
  await page.locator('#view-trace .list-row[data-index="2"]').click();
  await untilText(page, '#view-trace .details', '0.004002 s by the device’s clock');
  await page.keyboard.press('t');
  await page.keyboard.press('t');
  await until(page, 'a difference', () => document.querySelector('#view-trace .list-row[data-index="2"] .c-time').textContent === '+0.004002');
  await page.done();
});

test('ten million rows: the bar leaps, the wheel moves by rows, both ends are reached', async () => {
  const page = await opened('trace', { records: 10_000_000 });
  await focus(page);
  await page.keyboard.press('End');
  await untilRow(page, 9_999_999);
  const rows = await rowsInSight(page);
  assert.equal(rows.at(-1).index, 9_999_999);
  const box = await page.locator('#view-trace .list').boundingBox();
  assert.ok(rows.at(-1).y + 20 <= box.y + box.height + 2, 'the last row is whole in sight');
  await page.locator('#view-trace .list').evaluate((element) => {
    element.scrollTop = element.scrollHeight / 2;
  });
  await until(page, 'the middle is in sight', () => {
    const row = document.querySelector('#view-trace .list-layer .list-row:not([hidden]):not(.pending)');
    return Math.abs(Number(row?.dataset.index) - 5_000_000) < 2000;
  });
  const before = (await rowsInSight(page))[0].index;
  await page.mouse.move(box.x + 200, box.y + 200);
  await page.mouse.wheel(0, 100);
  await until(page, 'five rows further', (top) => [...document.querySelectorAll('#view-trace .list-layer .list-row:not([hidden])')].some((row) => Number(row.dataset.index) === top + 5) && Math.min(...[...document.querySelectorAll('#view-trace .list-layer .list-row:not([hidden])')].map((row) => Number(row.dataset.index))) === top + 5, before);
  await page.keyboard.press('g');
  await untilRow(page, 0);
  await page.done();
});

test('in a long trace, a finger’s small steps move by as many rows, and the bar follows', async () => {
  const page = await opened('trace', { records: 10_000_000 });
  const list = page.locator('#view-trace .list');
  await list.evaluate((element) => {
    element.scrollTop = element.scrollHeight / 2;
  });
  const top = () => page.evaluate(() => Math.min(...[...document.querySelectorAll('#view-trace .list-layer .list-row:not([hidden])')].map((row) => Number(row.dataset.index))));
  await until(page, 'the middle is in sight', () => Number(document.querySelector('#view-trace .list-layer .list-row:not([hidden]):not(.pending)')?.dataset.index) > 4_000_000);
  const before = await top();
  const bar = await list.evaluate((element) => element.scrollTop);
  for (let i = 1; i <= 5; i++) {
    await list.evaluate((element) => {
      element.scrollTop += 200;
    });
    await until(page, `${i * 10} rows further`, (row) => [...document.querySelectorAll('#view-trace .list-layer .list-row:not([hidden])')].some((r) => Number(r.dataset.index) === row) && !document.querySelector(`#view-trace .list-layer .list-row:not([hidden])[data-index="${row - 1}"]`), before + i * 10);
  }
  // 50 rows of ten million, of a bar of eight million pixels: 40 pixels, and not the 1000 that were scrolled.
  await until(page, 'the bar follows', (b) => Math.abs(document.querySelector('#view-trace .list').scrollTop - b - 40) < 5, bar);
  await page.done();
});

test('a time is gone to, and the selected identifier becomes the filter', async () => {
  const page = await opened('trace');
  await focus(page);
  await page.keyboard.press(':');
  await page.keyboard.type('1.5s');
  await page.keyboard.press('Enter');
  await untilRow(page, 1500);
  await until(page, 'identifier 100 is chosen', () => document.querySelector('footer').textContent.includes('chosen: 100'));
  await focus(page);
  await page.keyboard.press('o');
  await untilText(page, '#view-trace .state', '5 000 of 20 000 records');
  await untilRow(page, 375);
  await page.done();
});
