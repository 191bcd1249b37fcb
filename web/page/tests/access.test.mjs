import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { after, test } from 'node:test';
import { newPage, opened, quit, show, until } from './browser.mjs';

after(quit);

const axe = readFileSync(createRequire(import.meta.url).resolve('axe-core/axe.min.js'), 'utf8');
const VIEWS = ['summary', 'trace', 'graphs', 'fixed', 'bits', 'statistics', 'conversations', 'notes'];

/** What axe finds wrong, one line each. */
async function violations(page) {
  await page.evaluate(axe);
  return page.evaluate(async () => {
    const { violations } = await globalThis.axe.run(document, { resultTypes: ['violations'] });
    return violations.flatMap((v) => v.nodes.map((n) => `${v.id}: ${n.target.join(' ')} ${n.failureSummary?.split('\n')[1] ?? ''}`));
  });
}

for (const theme of ['dark', 'light']) {
  for (const size of [{ width: 1440, height: 900 }, { width: 390, height: 844 }]) {
    test(`axe finds nothing in any view, ${theme}, ${size.width} pixels wide`, async () => {
      const page = await opened('summary', { theme, size });
      const found = [];
      for (const view of VIEWS) {
        await show(page, view);
        if (view === 'graphs') {
          await page.locator('#view-graphs .tree-signal').nth(1).click();
          await page.locator('.panel').first().waitFor();
          await page.locator('.tree-look').click();
          await until(page, 'what protocols name is listed', () => document.querySelector('.tree').textContent.includes('engine_speed'));
        }
        if (view === 'conversations') {
          found.push(...(await violations(page)).map((v) => `ladder: ${v}`));
          await page.getByLabel('Shape').selectOption('nodes');
        }
        if (view === 'bits') await page.locator('.bit').first().waitFor();
        if (view === 'trace') {
          await page.locator('#view-trace .list').press('ArrowDown');
          await until(page, 'details are shown', () => document.querySelector('#view-trace .details dl') !== null);
        }
        found.push(...(await violations(page)).map((v) => `${view}: ${v}`));
        const overflow = await page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
        if (overflow > 0) found.push(`${view}: ${overflow} pixels wider than the window`);
      }
      assert.deepEqual(found, []);
      await page.done();
    });
  }
}

test('axe finds nothing on the start screen, in the list of keys and in the palette', async () => {
  const start = await newPage();
  await start.locator('main.start').waitFor();
  assert.deepEqual(await violations(start), []);
  await start.done();
  const page = await opened('trace');
  await page.keyboard.press('?');
  await page.locator('dialog.keys').waitFor();
  assert.deepEqual(await violations(page), []);
  await page.keyboard.press('Escape');
  await page.keyboard.press('Control+k');
  await page.locator('dialog.palette li').first().waitFor();
  assert.deepEqual(await violations(page), []);
  await page.done();
});

test('eight data bytes and what a loss says are in sight on a tablet, the bytes on a phone', async () => {
  for (const size of [{ width: 1024, height: 768 }, { width: 390, height: 844 }]) {
    const page = await opened('trace', { size });
    await page.locator('#view-trace .list').press('End');
    await until(page, 'the last row is the loss', () => document.querySelector('#view-trace .list-row.selected[data-kind=lost]') !== null);
    const cut = await page.evaluate(() => {
      const list = document.querySelector('#view-trace .list').getBoundingClientRect();
      const right = (cell) => {
        const range = document.createRange();
        range.selectNodeContents(cell);
        return Math.round(range.getBoundingClientRect().right - list.right);
      };
      const row = (kind) => [...document.querySelectorAll(`#view-trace .list-row[data-kind=${kind}]`)].find((r) => !r.hidden && (kind === 'lost' || r.querySelector('.c-data').textContent.length === 23));
      return { data: right(row('data').querySelector('.c-data')), lost: right(row('lost').querySelector('.c-data')) };
    });
    assert.ok(cut.data <= 0, `${cut.data} pixels of the data are out of sight at ${size.width}`);
    if (size.width > 700) assert.ok(cut.lost <= 0, `${cut.lost} pixels of the loss are out of sight`);
    await page.done();
  }
});
