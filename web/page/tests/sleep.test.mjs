// A computer that sleeps while the page is live: its browser stands still as a whole, for so long that the server lets the page go.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { join } from 'node:path';
import { after, test } from 'node:test';
import { chromium } from 'playwright-core';
import { newPage, quit, until, untilText } from './browser.mjs';
import { serve } from './served.mjs';

after(quit);

const received = (page) => page.locator('.shell').getAttribute('data-received').then(Number);
const untilReceived = (page, most) => until(page, `${most} records`, (m) => Number(document.querySelector('.shell').dataset.received) > m, most);
const everyRecordOnce = (page) =>
  until(page, 'every record once', () => {
    const { received, records } = document.querySelector('.shell').dataset;
    return received === records;
  });

test('a browser that slept has every record afterwards, and so has the recording', async () => {
  const server = await serve(['-d', 'virtual:car', '-o', 'drive.log']);
  const sleeper = await chromium.launchServer({ executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium', args: ['--no-sandbox'] });
  // The browser leads a group of all its processes.
  const signal = (name) => process.kill(-sleeper.process().pid, name);
  let here;
  try {
    const browser = await chromium.connect(sleeper.wsEndpoint());
    const asleep = await newPage({ url: server.url, browser: async () => browser });
    await asleep.locator('.shell').waitFor();
    await untilReceived(asleep, 100);
    const awake = await newPage({ url: server.url });
    await awake.locator('.shell').waitFor();
    await awake.locator('#tab-device').click();
    await untilText(awake, '#view-device', '2 pages are open');
    signal('SIGSTOP');
    // The server has let it go.
    await until(awake, 'one page is left', () => !document.querySelector('#view-device').textContent.includes('2 pages are open'));
    await untilReceived(awake, (await received(awake)) + 100);
    here = await received(awake);
    signal('SIGCONT');
    await untilReceived(asleep, here);
    await untilText(asleep, '.live-state', 'live');
    await untilText(awake, '#view-device', '2 pages are open');
    for (const page of [asleep, awake]) {
      await everyRecordOnce(page);
      await untilText(page, 'footer', 'no known loss');
    }
    await asleep.done();
    await awake.done();
    await browser.close();
    server.child.kill('SIGINT');
    await server.ended;
    const recorded = readFileSync(join(server.folder, 'drive.log'), 'utf8').split('\n').filter((line) => line.startsWith('('));
    assert.ok(recorded.length >= here, `${recorded.length} of ${here} are recorded`);
  } finally {
    signal('SIGCONT');
    await sleeper.close();
    await server.stop();
  }
});

test('a page that stands still goes on where it was', async () => {
  const server = await serve(['-d', 'virtual:car']);
  try {
    const [page, other] = [await newPage({ url: server.url }), await newPage({ url: server.url })];
    for (const each of [page, other]) await each.locator('.shell').waitFor();
    await untilReceived(page, 100);
    const browser = await page.context().newCDPSession(page);
    await page.evaluate(() => {
      let last = performance.now();
      window.longestPause = 0;
      setInterval(() => {
        window.longestPause = Math.max(window.longestPause, performance.now() - last);
        last = performance.now();
      }, 10);
    });
    await browser.send('Debugger.enable');
    await browser.send('Debugger.pause');
    const stoodAt = performance.now();
    await untilReceived(other, (await received(other)) + 2000);
    const stoodMs = performance.now() - stoodAt;
    await browser.send('Debugger.resume');
    await browser.send('Debugger.disable');
    const pause = await page.evaluate(async () => {
      await new Promise((done) => setTimeout(done, 200));
      return window.longestPause;
    });
    assert.ok(pause > stoodMs / 2, `it stood still for ${pause} of ${stoodMs} ms`);
    await untilReceived(page, await received(other));
    await untilText(page, '.live-state', 'live');
    await everyRecordOnce(page);
    await untilText(page, 'footer', 'no known loss');
    await other.done();
    await page.done();
  } finally {
    await server.stop();
  }
});
