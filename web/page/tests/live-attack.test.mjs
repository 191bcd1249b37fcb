// Other pages in the same browser, which know the port and even the token: they get nothing from `cantap ui`, and make it do nothing.

import assert from 'node:assert/strict';
import { createServer } from 'node:http';
import { after, test } from 'node:test';
import { launch, newPage, quit } from './browser.mjs';
import { serve } from './served.mjs';

after(quit);

/** A site of somebody else. */
async function foreign(run) {
  const site = createServer((_, answer) => answer.setHeader('content-type', 'text/html').end('<!doctype html><title>evil</title>'));
  await new Promise((ready) => site.listen(0, '127.0.0.1', ready));
  try {
    await run(`http://127.0.0.1:${site.address().port}/`);
  } finally {
    site.close();
  }
}

test('a foreign page opens no WebSocket, reads nothing and frames nothing, even with the token', async () => {
  const server = await serve(['-d', 'virtual:car', '--allow', 'send']);
  await foreign(async (evil) => {
    const context = await (await launch()).newContext();
    const page = await context.newPage();
    await page.goto(evil);
    const found = await page.evaluate(async (address) => {
      const url = new URL(address);
      const tried = {};
      const socket = (place) =>
        new Promise((done) => {
          const ws = new WebSocket(place);
          ws.onopen = () => done('open');
          ws.onerror = () => done('refused');
        });
      tried.socket = await socket(`ws://${url.host}/live${url.search}`);
      tried.local = await socket(`ws://localhost:${url.port}/live${url.search}`);
      tried.read = await fetch(address).then((answer) => answer.text(), () => 'refused');
      tried.blind = await fetch(address, { mode: 'no-cors' }).then((answer) => answer.type, () => 'refused');
      tried.post = await fetch(address, { method: 'POST', mode: 'no-cors', body: '{"request":"mode"}' }).then((answer) => answer.type, () => 'refused');
      tried.frame = await new Promise((done) => {
        const frame = document.createElement('iframe');
        frame.src = address;
        frame.onload = () => {
          try {
            done(frame.contentDocument?.body?.textContent ?? 'empty');
          } catch {
            done('refused');
          }
        };
        document.body.append(frame);
      });
      tried.script = await new Promise((done) => {
        const script = document.createElement('script');
        script.src = address;
        script.onload = () => done('loaded');
        script.onerror = () => done('refused');
        document.body.append(script);
      });
      const opened = window.open(address);
      await new Promise((later) => setTimeout(later, 500));
      try {
        tried.opened = opened?.document ? 'readable' : 'refused';
      } catch {
        tried.opened = 'refused';
      }
      return tried;
    }, server.url);
    assert.deepEqual({ ...found, frame: /refused|empty/.test(found.frame) || found.frame === '' }, { socket: 'refused', local: 'refused', read: 'refused', blind: 'refused', post: 'refused', frame: true, script: 'refused', opened: 'refused' });
    await context.close();
  });
  await server.stop();
});

test('the page itself reaches nothing but its server, and hands on no token', async () => {
  const server = await serve(['-d', 'virtual:car']);
  const page = await newPage({ url: server.url });
  await page.locator('.shell').waitFor();
  assert.equal(await page.evaluate(() => document.referrer), '');
  await foreign(async (evil) => {
    const blocked = await page.evaluate(async (place) => fetch(place).then(() => 'reached', () => 'refused'), evil);
    assert.equal(blocked, 'refused');
    const socket = await page.evaluate(
      (place) =>
        new Promise((done) => {
          try {
            const ws = new WebSocket(place.replace('http', 'ws'));
            ws.onopen = () => done('open');
            ws.onerror = () => done('refused');
          } catch {
            done('refused');
          }
        }),
      evil,
    );
    assert.equal(socket, 'refused');
    // A link away would not have the address in it.
    const head = await page.evaluate(async () => (await fetch(location.href)).headers.get('referrer-policy'));
    assert.equal(head, 'no-referrer');
  });
  // The browser reports what the policy refused.
  assert.ok(page.faults.every((fault) => /Content Security Policy|ERR_|request: /.test(fault)), page.faults.join('\n'));
  await page.context().close();
  await server.stop();
});
