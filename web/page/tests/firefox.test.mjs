// The page in Firefox: opened from a disk with a file dropped onto it, as a report, and live. What each view does is tested in Chromium.

import assert from 'node:assert/strict';
import { spawnSync } from 'node:child_process';
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import { after, test } from 'node:test';
import { newPage, rowsInSight, show, until, untilText } from './browser.mjs';
import { launchFirefox, missing, quitFirefox } from './firefox.mjs';
import { serve } from './served.mjs';

after(quitFirefox);

const PAGE = resolve(process.env.CANTAP_TEST_PAGE);
const VIEWS = ['summary', 'trace', 'graphs', 'fixed', 'bits', 'statistics', 'conversations', 'notes'];
const LINES = Array.from({ length: 2000 }, (_, i) => `(${1_700_000_000 + Math.floor(i / 100)}.${String((i % 100) * 10_000).padStart(6, '0')}) can0 123#${(i & 0xff).toString(16).padStart(2, '0')}00`).join('\n');
const DBC = 'VERSION ""\nBO_ 291 Engine: 2 X\n SG_ Speed : 0|8@1+ (0.5,0) [0|100] "km/h" X\n';

const opened = (options) => newPage({ ...options, browser: launchFirefox });
const skip = missing;

async function allViews(page, views) {
  for (const view of views) await show(page, view);
}

test('from a disk: files are dropped onto it, and all views show them', { skip }, async () => {
  const page = await opened({ file: PAGE });
  await page.locator('main.start').waitFor();
  await page.evaluate(([log, dbc]) => {
    const dropped = new DataTransfer();
    dropped.items.add(new File([log], 'drive.log'));
    dropped.items.add(new File([dbc], 'car.dbc'));
    for (const type of ['dragover', 'drop']) document.querySelector('main.start').dispatchEvent(new DragEvent(type, { dataTransfer: dropped, bubbles: true, cancelable: true }));
  }, [`${LINES}\n`, DBC]);
  await page.locator('.shell[data-growing=false]').waitFor();
  await untilText(page, '#view-summary', 'car.dbc');
  await allViews(page, VIEWS);
  await show(page, 'trace');
  await page.locator('#trace-filter').fill('Speed > 100');
  await untilText(page, '#view-trace .state', ' of 2');
  assert.ok((await rowsInSight(page)).length > 5);
  await show(page, 'graphs');
  await page.getByText('Speed', { exact: true }).first().click();
  await until(page, 'the graph is drawn', () => {
    const canvas = document.querySelector('#view-graphs canvas');
    return canvas && canvas.width > 100 && canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data.some((value) => value > 0);
  });
  await page.done();
});

test('a board cannot be opened, and the page says with what it can', { skip }, async () => {
  const page = await opened({ file: PAGE });
  await page.getByRole('button', { name: 'Open board …' }).click();
  await until(page, 'it says so', () => document.body.textContent.includes('open the page in Chrome, Edge or Opera'));
  await page.done();
});

test('a report opens from a disk', { skip }, async () => {
  const folder = mkdtempSync(join(tmpdir(), 'cantap-firefox-'));
  try {
    writeFileSync(join(folder, 'drive.log'), `${LINES}\n`);
    writeFileSync(join(folder, 'car.dbc'), DBC);
    const { status, stderr } = spawnSync(resolve(process.env.CANTAP_TEST_PROGRAM), ['report', 'drive.log', '--db', 'car.dbc', '-b', '500k'], { cwd: folder, env: { ...process.env, CANTAP_PAGE: PAGE } });
    assert.equal(status, 0, stderr.toString());
    const page = await opened({ file: join(folder, 'drive.html') });
    await page.locator('.shell[data-growing=false]').waitFor();
    await untilText(page, '#view-summary', '500 kbit/s');
    await allViews(page, VIEWS);
    await page.done();
  } finally {
    rmSync(folder, { recursive: true });
  }
});

test('live from a device', { skip }, async () => {
  const server = await serve(['-d', 'virtual:car']);
  try {
    const page = await opened({ url: server.url });
    await page.locator('.shell').waitFor();
    await until(page, 'records arrive', () => Number(document.querySelector('.shell').dataset.received) > 200);
    await allViews(page, [...VIEWS, 'device']);
    await untilText(page, '#view-device', 'The channels only listen');
    await page.done();
  } finally {
    await server.stop();
  }
});
