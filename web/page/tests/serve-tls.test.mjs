// The page of `cantap serve --web` over TLS: to browsers that show a certificate, each under its own permissions; and to nobody else.

import assert from 'node:assert/strict';
import { request } from 'node:https';
import { connect as plain } from 'node:net';
import { after, test } from 'node:test';
import { connect } from 'node:tls';
import { newPage, quit, show, until, untilText } from './browser.mjs';
import { serveEncrypted } from './served.mjs';

after(quit);

const PERMISSIONS = `
[clients.alice]
channels = [1]
send = ["7F0"]
[clients.bob]
role = "listen"
[clients.dave]
`;
const CLIENTS = ['alice:send', 'bob:send', 'carol:send', 'dave:send'];
const start = (args = []) => serveEncrypted(CLIENTS, PERMISSIONS, ['-d', 'virtual:car', '--allow', 'send', ...args]);

const received = (page) => page.locator('.shell').getAttribute('data-received').then(Number);
const untilReceived = (page, most) => until(page, `${most} records`, (m) => Number(document.querySelector('.shell').dataset.received) > m, most);

/** A browser with a certificate; the authority's own is not in its store, so it does not ask whose the server's is. */
const pageOf = (server, name) => newPage({ url: server.url, more: { ignoreHTTPSErrors: true, clientCertificates: [{ origin: new URL(server.url).origin, certPath: server.file(name), keyPath: server.file(`${name}-key`) }] } });

/** What a request gets, with the authority checked: its status and headers, or why it failed. */
const ask = (server, path, { key = {}, headers = {}, ...more } = {}) =>
  new Promise((done) => {
    const { hostname, port } = new URL(server.url);
    const asked = request({ hostname, port, path, headers, ca: server.ca, servername: 'localhost', agent: false, ...key, ...more }, (answer) => {
      answer.resume().on('error', () => {});
      answer.on('close', () => done({ status: answer.statusCode, headers: answer.headers }));
    });
    asked.on('upgrade', (answer, socket) => {
      socket.destroy();
      done({ status: answer.statusCode });
    });
    asked.on('error', (error) => done({ error: `${error.code} ${error.message}` }));
    asked.end();
  });

const UPGRADE = { connection: 'Upgrade', upgrade: 'websocket', 'sec-websocket-version': '13', 'sec-websocket-key': 'dGhlIHNhbXBsZSBub25jZQ==' };

test('each certificate sees and sends what it may, and no more', async () => {
  const server = await start();
  const [alice, bob] = [await pageOf(server, 'alice'), await pageOf(server, 'bob')];
  try {
    for (const page of [alice, bob]) {
      await page.locator('.shell').waitFor();
      await untilReceived(page, 100);
      await show(page, 'device');
    }
    // Sessions of their own: neither is among the other's pages.
    assert.equal(await bob.locator('#view-device').textContent().then((text) => text.includes('pages are open')), false);
    const channels = (page) => page.locator('#view-device tbody').first().locator('tr').count();
    assert.deepEqual([await channels(alice), await channels(bob)], [1, 2]);
    await untilText(bob, '#view-device', 'The channels only listen');
    assert.equal(await bob.getByRole('button', { name: 'Take part …' }).count(), 0);
    await alice.getByRole('button', { name: 'Take part …' }).click();
    await alice.getByRole('button', { name: 'Take part', exact: true }).click();
    await untilText(alice, '#live-mode', 'take part');
    await alice.locator('#send-frame').fill('7F0#C0FFEE');
    await alice.getByRole('button', { name: 'Send once' }).click();
    await show(bob, 'fixed');
    await until(bob, 'the frame is there', () => document.querySelector('#view-fixed').textContent.includes('7F0'));
    await alice.locator('#send-frame').fill('7FF#C0FFEE');
    await alice.getByRole('button', { name: 'Send once' }).click();
    await until(alice, 'it is refused', () => /not permitted|refuse/i.test(document.body.textContent));
    const log = server.audit();
    const of = (event, name) => log.find((line) => line.event === event && line.certificate === name);
    for (const [event, name] of [['came', 'alice'], ['came', 'bob'], ['opened', 'alice'], ['asked', 'alice'], ['not_permitted', 'alice']]) assert.ok(of(event, name), `${event} of ${name}: ${JSON.stringify(log)}`);
    await alice.done();
    // Revoked: let go, with what it has left to look at; nobody else is.
    server.keygen('--revoke', 'bob');
    server.child.kill('SIGHUP');
    await untilText(bob, '.live-state', 'lost');
    await bob.context().close();
    assert.match((await ask(server, '/', { key: server.keyOf('bob') })).error, /REVOKED|ECONNRESET|ERR_SSL/);
    assert.equal((await ask(server, '/', { key: server.keyOf('alice') })).status, 200);
  } finally {
    await server.stop();
  }
});

test('without a certificate, with a foreign one, another name or another page, there is nothing', async () => {
  const [server, other] = [await start(), await serveEncrypted(['eve:send'], '', ['-d', 'virtual:car'])];
  try {
    const { port, host } = new URL(server.url);
    const key = server.keyOf('alice');
    const good = await ask(server, '/', { key });
    assert.equal(good.status, 200);
    // Nothing is pinned to the computer's name for its other ports, and nothing is kept in cookies.
    assert.deepEqual([good.headers['strict-transport-security'], good.headers['set-cookie'], good.headers['cache-control']], [undefined, undefined, 'no-store']);
    assert.match(good.headers['content-security-policy'], new RegExp(`connect-src https://${host} wss://${host}; frame-ancestors 'none'`));
    for (const [who, refused] of [['nobody', {}], ['another authority', { key: other.keyOf('eve') }], ['the server itself', { key: server.keyOf('server') }], ['no permission', { key: server.keyOf('carol') }]]) {
      const { status, error } = await ask(server, '/', refused);
      assert.ok(status === undefined && error, `${who}: ${status}`);
    }
    for (const name of ['evil.example', `evil.example:${port}`, '127.0.0.1', `127.0.0.1:${Number(port) + 1}`, `127.0.0.1.evil.example:${port}`, `[::1]:${port}`]) {
      assert.equal((await ask(server, '/', { key, headers: { host: name } })).status, 421, name);
    }
    assert.equal((await ask(server, '/', { key, headers: { host: `localhost:${port}` } })).status, 200);
    const socket = (origin) => ask(server, '/live', { key, headers: { ...UPGRADE, ...(origin ? { origin } : {}) } });
    for (const origin of [undefined, 'https://evil.example', `http://${host}`, `https://localhost:${port}`, 'https://127.0.0.1', 'null']) assert.equal((await socket(origin)).status, 403, origin);
    assert.equal((await socket(`https://${host}`)).status, 101);
    assert.equal((await ask(server, '/trace', { key })).status, 404);
    assert.equal((await ask(server, '/', { key, method: 'POST' })).status, 405);
    // Another protocol inside than ours.
    assert.match((await ask(server, '/', { key, ALPNProtocols: ['h2'] })).error, /no application protocol/i);
    // No older version.
    assert.ok((await ask(server, '/', { key, maxVersion: 'TLSv1.2' })).error);
    // HTTP without encryption: not a word.
    const said = await new Promise((done) => {
      const bytes = [];
      const socket = plain(port, '127.0.0.1', () => socket.write(`GET / HTTP/1.1\r\nHost: ${host}\r\n\r\n`));
      socket.on('data', (data) => bytes.push(data)).on('close', () => done(Buffer.concat(bytes).length)).on('error', () => {});
    });
    assert.equal(said, 0);
    assert.match(server.errors(), /speaks HTTP/);
    const refused = server.audit().filter((line) => line.event === 'refused');
    assert.ok(refused.length >= 10 && refused.some((line) => line.certificate === 'carol'), JSON.stringify(refused));
  } finally {
    await server.stop();
    await other.stop();
  }
});

test('silent peers keep nobody out, before and after they have shown a certificate', async () => {
  const server = await start();
  const { port } = new URL(server.url);
  const key = server.keyOf('alice');
  const silent = [];
  const page = await pageOf(server, 'bob');
  try {
    await page.locator('.shell').waitFor();
    for (let count = 0; count < 100; count++) {
      await new Promise((done) => silent.push(plain(port, '127.0.0.1', done).on('error', () => {})));
    }
    assert.equal((await ask(server, '/', { key })).status, 200);
    for (let count = 0; count < 50; count++) {
      await new Promise((done) => silent.push(connect({ port, host: '127.0.0.1', ca: server.ca, ...server.keyOf('dave') }, done).on('error', () => {})));
    }
    assert.equal((await ask(server, '/', { key })).status, 200);
    // Whoever is served stays.
    await untilReceived(page, (await received(page)) + 100);
    await page.done();
  } finally {
    for (const socket of silent) socket.destroy();
    await server.stop();
  }
});

test('beyond this computer there is no page without encryption', async () => {
  for (const args of [['--web', '192.0.2.7'], ['--web', 'https://127.0.0.1']]) {
    const { serve } = await import('./served.mjs');
    await assert.rejects(serve(['-d', 'virtual:car', '--unix', 'cantap.sock', ...args], { command: ['serve'] }), /unencrypted; give --tls and --clients/);
  }
});
