// The page as `cantap serve --web` serves it, beside the other listeners of a shared board.

import assert from 'node:assert/strict';
import { spawnSync } from 'node:child_process';
import { join, resolve } from 'node:path';
import { after, test } from 'node:test';
import { newPage, quit, show, until, untilText } from './browser.mjs';
import { serveShared } from './served.mjs';

after(quit);

const received = (page) => page.locator('.shell').getAttribute('data-received').then(Number);
const untilReceived = (page, most) => until(page, `${most} records`, (m) => Number(document.querySelector('.shell').dataset.received) > m, most);

test('pages of a shared board show what arrives, and can do no more than the server allows', async () => {
  const server = await serveShared(['-d', 'virtual:car', '--allow', 'send']);
  const [page, second] = [await newPage({ url: server.url }), await newPage({ url: server.url })];
  try {
    for (const each of [page, second]) {
      await each.locator('.shell').waitFor();
      await untilReceived(each, 100);
    }
    assert.equal(await page.locator('#live-record').isVisible(), false);
    await show(page, 'device');
    const device = page.locator('#view-device');
    await untilText(page, '#view-device', '2 pages are open');
    for (const text of ['This server records nothing for pages', 'start cantap serve with --allow web:send', 'The channels only listen', '500 kbit/s']) await untilText(page, '#view-device', text);
    assert.equal(await device.getByRole('button', { name: /change/ }).count(), 0);
    assert.equal(await device.getByLabel('Filters of the device').isVisible(), false);
    assert.equal(await device.getByLabel('Name of the recording').isVisible(), false);
    await page.keyboard.press('R');
    await page.locator('#live-save').click();
    await page.locator('dialog[open]').waitFor();
    await page.keyboard.press('Escape');
    // Another program at the same board.
    const captured = spawnSync(resolve(process.env.CANTAP_TEST_PROGRAM), ['capture', '-d', `unix:${join(server.folder, 'cantap.sock')}`, '-n', '20', '-o', join(server.folder, 'beside.log')]);
    assert.equal(captured.status, 0, captured.stderr.toString());
    const before = await received(second);
    await page.done();
    await untilReceived(second, before + 100);
  } finally {
    await server.stop();
  }
  await untilText(second, '.live-state', 'ended');
  await show(second, 'device');
  await untilText(second, '#view-device', 'cantap serve has ended');
  await second.context().close();
});

test('a page that may send does so after a question', async () => {
  const server = await serveShared(['-d', 'virtual:car', '--allow', 'web:send']);
  const page = await newPage({ url: server.url });
  try {
    await page.locator('.shell').waitFor();
    await untilReceived(page, 50);
    await show(page, 'device');
    await page.getByRole('button', { name: 'Take part …' }).click();
    await page.getByRole('button', { name: 'Take part', exact: true }).click();
    await untilText(page, '#live-mode', 'take part');
    await page.locator('#send-frame').fill('7FF#C0FFEE');
    await page.getByRole('button', { name: 'Send once' }).click();
    await show(page, 'fixed');
    await until(page, 'the frame is there', () => document.querySelector('#view-fixed').textContent.includes('7FF'));
    await page.done();
  } finally {
    await server.stop();
  }
});

test('a server has a page at each address, each with its own token', async () => {
  const server = await serveShared(['-d', 'virtual:car', '--web', '0']);
  try {
    while (server.urls.length < 2) await new Promise((again) => setTimeout(again, 20));
    const [first, second] = server.urls.map((url) => new URL(url));
    assert.notEqual(first.port, second.port);
    assert.notEqual(first.search, second.search);
    const page = await newPage({ url: second.href });
    await page.locator('.shell').waitFor();
    await untilReceived(page, 100);
    await page.done();
    const stranger = await fetch(`${second.origin}/${first.search}`);
    assert.notEqual(stranger.status, 200);
  } finally {
    await server.stop();
  }
});

test('two pages at one address are refused before anything is opened', async () => {
  const { status, stderr } = spawnSync(resolve(process.env.CANTAP_TEST_PROGRAM), ['serve', '-d', 'virtual:car', '--web', '127.0.0.1:29577', '--web', '127.0.0.1:29577'], { env: { ...process.env, CANTAP_PAGE: resolve(process.env.CANTAP_TEST_PAGE) } });
  assert.equal(status, 2);
  assert.match(stderr.toString(), /--web is given twice for 127.0.0.1:29577; give each another address or port/);
});
