// The page as `cantap ui` serves it, live from a virtual device: what arrives is shown, recorded and sent.

import assert from 'node:assert/strict';
import { spawnSync } from 'node:child_process';
import { existsSync, readFileSync, writeFileSync, mkdtempSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import { after, test } from 'node:test';
import { newPage, quit, rowsInSight, saved, show, until, untilText } from './browser.mjs';
import { boardAt, serve } from './served.mjs';

after(quit);

const received = (page) => page.locator('.shell').getAttribute('data-received').then(Number);

/** Waits until more has arrived. */
async function untilMore(page, more = 100) {
  const from = await received(page);
  await until(page, `${more} more records than ${from}`, ([f, m]) => Number(document.querySelector('.shell').dataset.received) > f + m, [from, more]);
}

async function live(args, view, run) {
  const server = await serve(args);
  const page = await newPage({ url: server.url });
  try {
    await page.locator('.shell').waitFor();
    await until(page, 'records arrive', () => Number(document.querySelector('.shell').dataset.received) > 50);
    await show(page, view);
    await run(page, server);
    await page.done();
  } finally {
    await server.stop();
  }
}

test('the trace grows and is followed; paused, it stands still while records still arrive', () =>
  live(['-d', 'virtual:car'], 'trace', async (page) => {
    await untilText(page, '.live-state', 'live');
    const last = async () => (await rowsInSight(page)).at(-1).index;
    const before = await last();
    await until(page, 'the last row is a later one', (b) => Math.max(...[...document.querySelectorAll('#view-trace .list-layer .list-row:not([hidden])')].map((r) => Number(r.dataset.index))) > b + 50, before);
    await page.locator('#live-pause').click();
    await untilText(page, '.live-state', 'paused');
    const state = () => page.locator('#view-trace .bar .state').textContent();
    let rows = await state();
    await untilMore(page);
    // What was being drawn when it was paused may still come, once.
    if ((await state()) !== rows) {
      rows = await state();
      await untilMore(page);
    }
    assert.equal(await state(), rows);
    await page.keyboard.press('P');
    await untilText(page, '.live-state', 'live');
    await until(page, 'the rows go on', (r) => document.querySelector('#view-trace .bar .state').textContent !== r, rows);
    // The vehicle's own database names its messages.
    await until(page, 'a message has its name', () => [...document.querySelectorAll('#view-trace .c-message')].some((cell) => cell.textContent.length > 2));
    await untilText(page, 'footer', 'no known loss');
  }));

test('the trace is filtered and searched while frames arrive, letter by letter', () =>
  live(['-d', 'virtual:car'], 'trace', async (page) => {
    await untilText(page, '.live-state', 'live');
    await untilMore(page);
    await page.locator('#trace-find').pressSequentially('dlc == 8');
    await until(page, 'a row was found', () => document.querySelector('#view-trace .list-row.selected:not([hidden]):not(.pending)') !== null);
    assert.match(await page.locator('#view-trace .list-row.selected').textContent(), /( [0-9A-F]{2}){7}/);
    await untilMore(page);
    await page.locator('#trace-filter').pressSequentially('ch == 1');
    await until(page, 'filtered', () => / of .* records/.test(document.querySelector('#view-trace .state').textContent));
    const state = await page.locator('#view-trace .state').textContent();
    await until(page, 'and more of them', (s) => document.querySelector('#view-trace .state').textContent !== s, state);
    await untilText(page, 'footer', 'no known loss');
  }));

test('all views show what arrives', () =>
  live(['-d', 'virtual:car'], 'fixed', async (page) => {
    await until(page, 'identifiers have periods', () => [...document.querySelectorAll('#view-fixed .list-layer .list-row:not([hidden]) .c-period')].some((cell) => /\d\.\d{3}$/.test(cell.textContent)));
    const frames = () => page.locator('#view-fixed .list-layer .list-row:not([hidden]) .c-count').first().textContent();
    const before = await frames();
    await until(page, 'a count grows', (b) => document.querySelector('#view-fixed .list-layer .list-row:not([hidden]) .c-count').textContent !== b, before);
    await show(page, 'graphs');
    await page.locator('.tree-signal').first().click();
    await until(page, 'the graph reaches on', () => {
      const draws = document.querySelectorAll('#view-graphs canvas');
      return draws.length > 0;
    });
    await show(page, 'bits');
    await until(page, 'bits have been counted', () => /\d/.test(document.querySelector('#view-bits').textContent));
    await show(page, 'summary');
    await untilText(page, '#view-summary', 'Readlive');
    await untilText(page, '#view-summary', 'Of a live trace they are looked for when you ask.');
    assert.doesNotMatch(await page.locator('#view-summary').textContent(), /Nothing stood out/);
    await page.locator('#find-findings').focus();
    await page.keyboard.press('Enter');
    await untilText(page, '#view-summary', 'Of the time up to');
    await untilText(page, '#view-summary', '500 kbit/s');
    await untilMore(page);
  }));

test('very many identifiers keep no view from taking records in', async () => {
  const server = await serve(['-d', 'virtual:load=100', '-b', '1M']);
  const page = await newPage({
    url: server.url,
    before: () => {
      window.asked = { ids: 0, append: 0 };
      const post = Worker.prototype.postMessage;
      Worker.prototype.postMessage = function (message, ...rest) {
        if (message.request in window.asked) window.asked[message.request]++;
        return post.call(this, message, ...rest);
      };
    },
  });
  try {
    await page.locator('.shell').waitFor();
    await until(page, 'there are thousands', () => Number(document.querySelector('.shell').dataset.received) > 50_000);
    for (const view of ['fixed', 'statistics']) {
      const from = await page.evaluate(() => ({ ...window.asked }));
      await show(page, view);
      await until(page, `${view} has asked, and records were taken in many times`, (f) => window.asked.ids > f.ids && window.asked.append >= f.append + 40, from);
      const ids = (await page.evaluate(() => window.asked.ids)) - from.ids;
      assert.ok(ids <= 10, `${view}: for 40 times records, ${ids} times identifiers`);
    }
    await page.done();
  } finally {
    await server.stop();
  }
});

test('a recording has its size and time, keeps an older file, and can be read', () =>
  live(['-d', 'virtual:car'], 'device', async (page, server) => {
    writeFileSync(join(server.folder, 'older.log'), 'somebody’s');
    const name = page.getByLabel('Name of the recording');
    await name.fill('older.log');
    await page.locator('#view-device').getByRole('button', { name: 'Record', exact: true }).click();
    await untilText(page, '.notices', 'older.log exists, and is not overwritten');
    await name.fill('../out.log');
    await page.keyboard.press('Tab');
    await page.locator('#view-device').getByRole('button', { name: 'Record', exact: true }).click();
    await untilText(page, '.notices', 'no folder');
    await name.fill('new.log');
    await page.locator('#view-device').getByRole('button', { name: 'Record', exact: true }).click();
    await until(page, 'the recording grows', () => /new\.log: .*, \d.* records/.test(document.querySelector('#view-device').textContent));
    await untilMore(page, 300);
    await page.locator('#live-record').click();
    await untilText(page, '.notices', 'records are in');
    const said = Number(/(\d+) records are in/.exec(await page.locator('.notices').textContent())[1]);
    const lines = readFileSync(join(server.folder, 'new.log'), 'utf8').trim().split('\n');
    assert.equal(lines.length, said);
    assert.ok(said > 100, String(said));
    assert.equal(readFileSync(join(server.folder, 'older.log'), 'utf8'), 'somebody’s');
    assert.ok(!existsSync(join(server.folder, '../out.log')));
  }));

test('frames are sent once and periodically, after the user has agreed', () =>
  live(['-d', 'virtual', '-b', '500k', '--allow', 'send'], 'device', async (page) => {
    assert.ok(await page.getByRole('button', { name: 'Send once' }).isDisabled());
    await page.getByRole('button', { name: 'Take part …' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Only listen' }).click();
    await untilText(page, '#live-mode', 'only listen');
    await page.getByRole('button', { name: 'Take part …' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Take part' }).click();
    await untilText(page, '#live-mode', 'take part');
    await page.locator('#send-frame').fill('7F0#C0FFEE');
    await page.getByRole('button', { name: 'Send once' }).click();
    await page.locator('#send-frame').fill('7F1#0000');
    await page.locator('#send-period').fill('20');
    await page.locator('#send-changes').fill('counter 0.0:4, checksum 1:crc9');
    await page.getByRole('button', { name: 'Send periodically' }).click();
    await untilText(page, '.notices', 'is no change');
    await page.locator('#send-changes').fill('counter 0.0:4, checksum 1:xor');
    await page.getByRole('button', { name: 'Send periodically' }).click();
    await page.getByRole('button', { name: 'Stop 7F1#0000' }).waitFor();
    await show(page, 'trace');
    await page.locator('#trace-filter').fill('7F0');
    await untilText(page, '#view-trace .state', '1 of ');
    await until(page, 'it was sent', () => /TX.*7F0.*C0 FF EE/.test(document.querySelector('#view-trace .list-layer').textContent));
    await page.locator('#trace-filter').fill('7F1');
    await until(page, 'counter and checksum change', () => /7F1 *2?03 03/.test(document.querySelector('#view-trace .list-layer').textContent) && /04 04/.test(document.querySelector('#view-trace .list-layer').textContent));
    await show(page, 'device');
    await page.getByRole('button', { name: 'Stop 7F1#0000' }).click();
    await until(page, 'it has stopped', () => !document.querySelector('#view-device').textContent.includes('7F1#0000'));
  }));

test('a bit rate is found by listening, and found again only when it is asked for', () =>
  live(['-d', 'virtual:car', '-b', '250k', '--allow', 'send'], 'device', async (page) => {
    await page.getByRole('button', { name: 'Bit rate of channel 1: 250 kbit/s, change' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Find it by listening' }).click();
    await page.getByRole('button', { name: 'Bit rate of channel 1: 500 kbit/s, change' }).waitFor();
    await untilText(page, '.notices', 'channel 1 is at 500000 bit/s');
    // Channels opened in another way keep it.
    await page.getByRole('button', { name: 'Take part …' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Take part' }).click();
    await untilText(page, '#live-mode', 'take part');
    await page.getByRole('button', { name: 'Bit rate of channel 1: 500 kbit/s, change' }).waitFor();
  }));

test('a vehicle is asked for its values and trouble codes, by who may send and only while channels take part', () =>
  live(['-d', 'virtual:car', '-b', '500k', '--allow', 'send'], 'device', async (page) => {
    const ask = page.locator('#vehicle-ask');
    assert.ok(await ask.isDisabled());
    await page.getByRole('button', { name: 'Take part …' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Take part' }).click();
    await untilText(page, '#live-mode', 'take part');
    await ask.click();
    await untilText(page, '#vehicle', 'engine_speed');
    await untilText(page, '#vehicle', 'rpm');
    await untilText(page, '#vehicle', 'vin');
    await untilText(page, '#vehicle', 'P0');
    await until(page, 'values come again, with the least and the most', () => [...document.querySelectorAll('#vehicle tr')].some((row) => row.cells[4].textContent !== row.cells[5].textContent));
    await page.getByRole('button', { name: 'Only listen' }).click();
    await untilText(page, '#live-mode', 'only listen');
    await untilText(page, '#view-device', 'Nothing is asked any more');
    assert.ok(await ask.isDisabled());
    // What was asked is there to be looked at.
    await show(page, 'conversations');
    await page.getByLabel('Search conversations').fill('engine_speed');
    await untilText(page, '#view-conversations .list-layer', 'engine_speed');
  }));

test('a send list is kept, saved as the live view reads it, and added from its files', () =>
  live(['-d', 'virtual', '-b', '500k', '--allow', 'send'], 'device', async (page, server) => {
    const lines = () => page.locator('#send-list tr td:first-child').allTextContents();
    const choose = async (text) => {
      const [picker] = await Promise.all([page.waitForEvent('filechooser'), page.locator('#send-load').click()]);
      await picker.setFiles([{ name: 'list.txt', mimeType: 'text/plain', buffer: Buffer.from(text) }]);
    };
    await page.getByRole('button', { name: 'Add once' }).click();
    await untilText(page, '.notices', 'neither a frame');
    await page.locator('#send-frame').fill('7F0#C0FFEE');
    await page.getByRole('button', { name: 'Add once' }).click();
    await page.locator('#send-frame').fill('7F1#0000');
    await page.locator('#send-period').fill('20');
    await page.locator('#send-changes').fill('checksum 1:xor, counter 0.0:4');
    await page.getByRole('button', { name: 'Add periodic' }).click();
    const own = ['1:7F0#C0FFEE', '1:7F1#0000 20ms checksum=1:xor counter=0.0:4'];
    assert.deepEqual(await lines(), own);
    assert.equal((await saved(page, () => page.locator('#send-save').click())).bytes.toString(), `${own.join('\n')}\n`);
    // What the live view writes; a wrong line anywhere, and nothing of the file is taken.
    const file = ['can1:7F2#0000 100ms counter=0 group=demo', '2:Engine:Speed=sine(0,120, 10s),Mode="on and off" 20ms', '7F3#R 1m30s'];
    await choose(`# a comment\n\n${file.join('\r\n')}`);
    await until(page, 'they are there', (count) => document.querySelectorAll('#send-list tr').length === count, own.length + file.length);
    assert.deepEqual(await lines(), [...own, ...file]);
    for (const [wrong, why] of [['7F0#00\n7F0#00 counter=0', 'line 2: counter='], ['7F0#00 20ms 30ms', 'one period too many'], ['7F0#00 5ms3s', 'is no period'], ['7F0#00 1ms sum=1', 'is unknown'], ['0:7F0#00', 'no channel 0'], ['hello', 'neither a frame']]) {
      await choose(wrong);
      await untilText(page, '.notices', why);
    }
    assert.equal((await lines()).length, own.length + file.length);
    await page.getByRole('button', { name: 'Remove 7F3#R 1m30s' }).click();
    assert.ok(await page.getByRole('button', { name: `Send ${own[0]}` }).isDisabled());
    await page.getByRole('button', { name: 'Take part …' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Take part' }).click();
    await untilText(page, '#live-mode', 'take part');
    await page.getByRole('button', { name: `Send ${own[0]}` }).click();
    await page.getByRole('button', { name: `Start ${own[1]}` }).click();
    await page.getByRole('button', { name: 'Stop 7F1#0000' }).waitFor();
    // Kept for the next visit.
    await page.goto(server.url);
    await show(page, 'device');
    await until(page, 'the list is there', () => document.querySelectorAll('#send-list tr').length === 4);
    await page.locator('#trace-filter').waitFor({ state: 'attached' });
  }));

test('without --allow send the page offers nothing to send', () =>
  live(['-d', 'virtual:car'], 'device', async (page) => {
    await untilText(page, '#view-device', 'start cantap ui with --allow send');
    assert.ok(await page.getByRole('button', { name: 'Send once' }).isDisabled());
    assert.equal(await page.getByRole('button', { name: 'Take part …' }).count(), 0);
  }));

test('a lost connection comes back without a gap or a record twice; a second page has the same', async () => {
  const server = await serve(['-d', 'virtual:car']);
  try {
    const before = await newPage({
      url: server.url,
      before: () => {
        window.sockets = [];
        window.WebSocket = class extends WebSocket {
          constructor(...where) {
            super(...where);
            window.sockets.push(this);
          }
        };
      },
    });
    await before.locator('.shell').waitFor();
    await untilMore(before);
    // A notice that stays comes once, although the server has it for whoever comes anew.
    await before.keyboard.press('R');
    await untilText(before, '#live-record', '■');
    await before.keyboard.press('R');
    await untilText(before, '.notices', 'records are in');
    await before.evaluate(() => {
      window.noticesAgain = [];
      new MutationObserver((changes) => window.noticesAgain.push(...changes.flatMap((c) => [...c.addedNodes].map((n) => n.textContent)))).observe(document.querySelector('.notices'), { childList: true, subtree: true });
    });
    for (let i = 0; i < 3; i++) {
      const lost = until(before, 'the connection is lost', () => document.querySelector('.live-state').textContent === 'connection lost');
      await before.evaluate(() => window.sockets.at(-1).close());
      await lost;
      await untilText(before, '.live-state', 'live');
      await untilMore(before);
    }
    assert.deepEqual((await before.evaluate(() => window.noticesAgain)).filter((text) => /record|×/.test(text)), []);
    const second = await newPage({ url: server.url });
    await second.locator('.shell').waitFor();
    await show(second, 'device');
    await untilText(second, '#view-device', '2 pages are open');
    for (const page of [before, second]) {
      await untilText(page, 'footer', 'no known loss');
      await until(page, 'every record once', () => {
        const { received, records } = document.querySelector('.shell').dataset;
        return received === records && Number(received) > 100;
      });
    }
    await second.done();
    await before.close();
  } finally {
    await server.stop();
  }
});

test('the page says that the server has ended, and what it has stays', async () => {
  for (const [signal, text] of [['SIGINT', 'ended'], ['SIGKILL', 'connection lost']]) {
    const server = await serve(['-d', 'virtual:car']);
    const page = await newPage({ url: server.url });
    await page.locator('.shell').waitFor();
    await untilMore(page);
    await server.stop(signal);
    await untilText(page, '.live-state', text);
    await show(page, 'trace');
    await until(page, 'rows are there', () => document.querySelector('#view-trace .list-layer .list-row:not([hidden]) .c-id').textContent !== '');
    await page.context().close();
  }
});

test('a device that goes away and comes back leaves a gap and a whole recording, and Ctrl-C ends that', async () => {
  const folder = mkdtempSync(join(tmpdir(), 'cantap-ui-'));
  const socket = join(folder, 'door');
  let board = await boardAt(socket);
  const server = await serve(['-d', `unix:${socket}`], { folder });
  const page = await newPage({ url: server.url });
  try {
    await page.locator('.shell').waitFor();
    await until(page, 'records arrive', () => Number(document.querySelector('.shell').dataset.received) > 50);
    await show(page, 'device');
    await page.getByLabel('Name of the recording').fill('all.blf');
    await page.locator('#live-record').click();
    await until(page, 'the recording grows', () => /all\.blf: .*, \d.* records/.test(document.querySelector('#view-device').textContent));
    await board.stop();
    await untilText(page, '#view-device', 'gone');
    await untilText(page, '.notices', 'it continues when the device is back');
    board = await boardAt(socket);
    await untilText(page, '#view-device', ': connected');
    await untilMore(page);
    await show(page, 'trace');
    await page.locator('#trace-filter').fill('lost');
    await until(page, 'the gap is in the trace', () => !/^0 of/.test(document.querySelector('#view-trace .bar .state').textContent) && / of /.test(document.querySelector('#view-trace .bar .state').textContent));
    // How many frames are missing is not known, which is not none.
    await untilText(page, 'footer', 'an unknown number of frames lost');
    server.child.kill('SIGINT');
    await untilText(page, '.live-state', 'ended');
    assert.equal(await server.ended, 0);
    const { status, stdout, stderr } = spawnSync(resolve(process.env.CANTAP_TEST_PROGRAM), ['stats', '--json', 'all.blf'], { cwd: folder, encoding: 'utf8' });
    assert.equal(status, 0, stderr);
    assert.match(stdout, /"frames": *[1-9]\d\d/);
  } finally {
    await page.context().close();
    await board.stop();
    await server.stop();
  }
});

test('what is damaged on its way ends the trace where it was, and is not taken for records', async () => {
  const server = await serve(['-d', 'virtual:car']);
  const lies = {
    'bytes that are no records': (bytes) => bytes.fill(0xff, 28),
    'a chunk longer than the message': (bytes) => (bytes.writeUInt32LE(0x7fff_ffff, 24), bytes),
    'a message without numbers': (bytes) => bytes.subarray(0, 3),
  };
  try {
    for (const [about, lie] of Object.entries(lies)) {
      const page = await newPage({ url: 'about:blank' });
      page.faults.length = 0;
      let messages = 0;
      await page.routeWebSocket(/\/live/, (route) => {
        const real = route.connectToServer();
        real.onMessage((message) => route.send(typeof message !== 'string' && ++messages === 20 ? lie(Buffer.from(message)) : message));
      });
      await page.goto(server.url);
      await page.locator('.shell').waitFor();
      await untilText(page, '.live-state', 'ended');
      await untilText(page, '.notices', 'load the page anew');
      const { received, records } = await page.locator('.shell').evaluate((shell) => ({ ...shell.dataset }));
      assert.ok(Number(received) > 0 && Number(records) >= Number(received), `${about}: ${received} ${records}`);
      assert.deepEqual(page.faults.filter((fault) => !fault.startsWith('request:')), [], about);
      await page.context().close();
    }
  } finally {
    await server.stop();
  }
});

test('a trace instead of a device, with a name and a database that would be script', async () => {
  const folder = mkdtempSync(join(tmpdir(), 'cantap-ui-'));
  const name = '<img src=x onerror=alert(1)>.log';
  writeFileSync(join(folder, name), Array.from({ length: 500 }, (_, i) => `(${(1700000000 + i / 100).toFixed(6)}) can0 123#${i.toString(16).padStart(4, '0')}\n`).join(''));
  writeFileSync(join(folder, '<b>x.dbc'), 'BO_ 291 Engine: 8 X\n SG_ Speed : 0|16@1+ (0.1,0) [0|250] "</script><script>alert(2)</script>" X\n');
  const server = await serve(['--db', '<b>x.dbc', '-b', '500k', name], { folder });
  const page = await newPage({ url: server.url });
  page.on('dialog', () => assert.fail('a script ran'));
  await page.locator('.shell[data-growing=false]').waitFor();
  await untilText(page, '.trace-name', name);
  await show(page, 'summary');
  await untilText(page, '#view-summary', 'Frames500');
  await untilText(page, '#view-summary', '<b>x.dbc');
  await show(page, 'trace');
  await page.locator('#view-trace .list').focus();
  await page.keyboard.press('Home');
  await untilText(page, '#view-trace .details', '</script>');
  assert.equal(await page.locator('#tab-device').count(), 0);
  await page.done();
  assert.equal(await server.stop(), 0);
});
