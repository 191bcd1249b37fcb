// The page without any server: a board on the browser's own serial port, which a stand-in carries to a virtual board, or to one that lies.

import assert from 'node:assert/strict';
import { spawnSync } from 'node:child_process';
import { mkdtempSync, readFileSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import { after, test } from 'node:test';
import { newPage, quit, saved, show, until, untilText } from './browser.mjs';
import { Line, emulatedBoard, emulator, scriptedBoard, sealed, virtualBoard } from './fake-serial.mjs';

after(quit);

const PAGE = process.env.CANTAP_TEST_PAGE;

const received = (page) => page.locator('.shell').getAttribute('data-received').then(Number);

/** A page with a board open, or with what was said instead. */
async function opened(line, rates = ['500k', '500k'], { before, waits = true } = {}) {
  const page = await line.page(PAGE, before);
  await page.getByRole('button', { name: 'Open board …' }).click();
  await choose(page, rates);
  if (waits) {
    await page.locator('.shell').waitFor();
    await untilText(page, '.live-state', 'live');
    await untilMore(page);
  }
  return page;
}

async function choose(page, rates) {
  for (const [i, rate] of rates.entries()) await page.getByLabel(`Bit rate of channel ${i + 1}`).fill(rate);
  await page.getByRole('button', { name: 'Choose the board …' }).click();
}

async function untilMore(page, more = 100) {
  const from = await received(page).catch(() => 0);
  await until(page, `${more} more records than ${from}`, ([f, m]) => Number(document.querySelector('.shell').dataset.received) > f + m, [from, more]);
}

/** What the board's view says of each channel. */
const figures = (page) =>
  page.locator('#view-board tbody tr').evaluateAll((rows) =>
    rows.map((row) => {
      const number = (name) => Number(row.querySelector(name).textContent.replace(/\D/g, ''));
      return { received: number('.received'), lost: number('.lost'), counted: number('.counted'), text: row.textContent };
    }),
  );

async function closed(page) {
  await show(page, 'board');
  await page.locator('#board-close').click();
  await untilText(page, '#view-board', 'The board is closed. What was received stays here.');
  await untilText(page, '#view-board', 'Received and lost together are what the board has counted.');
  return figures(page);
}

/** The whole trace as candump has it: lines of frames. */
async function lines(page) {
  await page.locator('#board-save').click();
  await page.getByLabel('Format').selectOption('candump');
  const { bytes } = await saved(page, () => page.getByRole('button', { name: 'Export', exact: true }).click());
  return bytes.toString().trim().split('\n').filter((line) => /#/.test(line));
}

const frames = async (page) => Number((await page.locator('footer').textContent()).match(/([\d\u202f\u00a0 ]+) frames in/)[1].replace(/\D/g, ''));

test('a board is opened to listen, shown live, closed and saved: every frame that it has counted', async () => {
  const board = await virtualBoard('car');
  const line = new Line(board);
  const page = await opened(line, ['500k', '125k']);
  try {
    const log = await page.evaluate(() => window.serialLog);
    assert.deepEqual(log.asked, [{ filters: [{ usbVendorId: 0x1209, usbProductId: 1 }] }]);
    assert.deepEqual(log.signals, [{ dataTerminalReady: true }]);
    await untilText(page, '#view-board', 'Open, and only listening');
    await untilText(page, '#view-board', 'VIRTUAL');
    for (const [view, text] of [['fixed', 'ms'], ['trace', '100'], ['summary', '500 kbit/s']]) {
      await show(page, view);
      await untilText(page, `#view-${view}`, text);
      await untilMore(page);
    }
    await untilText(page, 'footer', 'no known loss');
    await show(page, 'board');
    await until(page, 'the board has told its counts', () => [...document.querySelectorAll('#view-board .counted')].every((cell) => cell.textContent !== '0'));
    assert.ok((await figures(page)).every(({ text }) => text.includes('listen-only')));
    const counts = await closed(page);
    assert.equal(counts.length, 2);
    for (const { received, lost, counted } of counts) assert.deepEqual([received, lost], [counted, 0]);
    const sum = counts[0].received + counts[1].received;
    assert.equal(await frames(page), sum);
    assert.equal((await lines(page)).length, sum);
    assert.equal(await page.evaluate(() => window.serialLog.closed), 1);
    await page.done();
  } finally {
    await board.stop();
  }
});

test('the emulated board, with the firmware as it is flashed: every frame that it has counted', { skip: emulator() ? false : 'there is no emulator with firmware: cargo xtask firmware' }, async () => {
  const board = await emulatedBoard(emulator(), 20);
  const page = await opened(new Line(board), ['500k', '500k']);
  try {
    await untilText(page, '#view-board', 'Open, and only listening');
    await untilMore(page, 300);
    const counts = await closed(page);
    for (const { received, lost, counted } of counts) assert.deepEqual([received > 100, received, lost], [true, counted, 0]);
    assert.equal((await lines(page)).length, counts[0].received + counts[1].received);
    await page.done();
  } finally {
    await board.stop();
  }
});

test('what a log replays on the bus is what the page saves, frame by frame', async () => {
  const folder = mkdtempSync(join(tmpdir(), 'cantap-board-'));
  const sent = Array.from({ length: 3000 }, (_, i) => `${(0x100 + (i % 50)).toString(16).toUpperCase()}#${i.toString(16).toUpperCase().padStart(8, '0')}`);
  writeFileSync(join(folder, 'drive.log'), sent.map((frame, i) => `(${(1700000000 + i / 1000).toFixed(6)}) can0 ${frame}\n`).join(''));
  const board = await virtualBoard(`log=${join(folder, 'drive.log')}`);
  const page = await opened(new Line(board), ['500k', '']);
  try {
    await until(page, 'enough has come', () => Number(document.querySelector('.shell').dataset.received) > 2000);
    await closed(page);
    const got = (await lines(page)).map((text) => text.split(' ')[2]);
    const first = sent.indexOf(got[0]);
    assert.ok(first >= 0 && got.length > 2000, `${got[0]} ${got.length}`);
    for (const [i, frame] of got.entries()) assert.equal(frame, sent[(first + i) % sent.length], `frame ${i}`);
    await page.done();
  } finally {
    await board.stop();
  }
});

test('two saturated buses: nothing is lost', async () => {
  const board = await virtualBoard('load=100,frames=std8');
  const page = await opened(new Line(board), ['1M', '1M']);
  try {
    await until(page, 'many have come', () => Number(document.querySelector('.shell').dataset.received) > 60_000);
    const counts = await closed(page);
    for (const { received, lost, counted } of counts) assert.deepEqual([received, lost], [counted, 0]);
    assert.equal(await frames(page), counts[0].received + counts[1].received);
    await page.done();
  } finally {
    await board.stop();
  }
});

test('damaged, cut and foreign bytes are counted, and what they held is lost where it was', async () => {
  const lies = {
    'a bit that is flipped': (bytes) => ((bytes[bytes.length >> 1] ^= 4), bytes),
    'a piece that is missing': () => Buffer.alloc(0),
    // A piece may begin within a record: 0 ends one.
    'garbage between': (bytes) => {
      const end = bytes.indexOf(0) + 1;
      return Buffer.concat([bytes.subarray(0, end), Buffer.from('\0AT+CGMI\r\n\0\xff\xff\xff\0', 'latin1'), bytes.subarray(end)]);
    },
    'half a piece': (bytes) => bytes.subarray(0, bytes.length >> 1),
  };
  for (const [about, lie] of Object.entries(lies)) {
    const board = await virtualBoard('load=80');
    const line = new Line(board);
    const page = await opened(line);
    try {
      // Long ones are batches; an answer may be among them.
      let told = 0;
      line.mangle = (bytes) => (bytes.length > 300 && bytes.includes(0) && told < 3 ? (told++, lie(Buffer.from(bytes))) : bytes);
      await untilMore(page, 2000);
      assert.equal(told, 3, about);
      const counts = await closed(page);
      for (const { received, lost, counted } of counts) assert.equal(received + lost, counted, about);
      const lost = counts[0].lost + counts[1].lost;
      assert.equal(await frames(page), counts[0].received + counts[1].received, about);
      if (about === 'garbage between') assert.equal(lost, 0);
      else {
        assert.ok(lost > 0, about);
        await untilText(page, 'footer', 'frames lost');
      }
      if (about !== 'a piece that is missing') await untilText(page, '#view-board', 'Damaged on their way');
      await page.done();
    } finally {
      await board.stop();
    }
  }
});

test('a board that is unplugged is named, nothing is lost of what came, and it goes on in the same trace with a gap', async () => {
  const board = await virtualBoard('car');
  const line = new Line(board);
  const page = await opened(line);
  try {
    line.unplug();
    await untilText(page, '.live-state', 'board gone');
    await untilText(page, '.notice.error', 'vanished (The device has been lost). What was received stays here.');
    await show(page, 'board');
    const before = await figures(page);
    assert.equal(await frames(page), before[0].received + before[1].received);
    await show(page, 'trace');
    await page.locator('#trace-filter').fill('lost');
    await until(page, 'a gap on each channel is in the trace', () => /^2 of/.test(document.querySelector('#view-trace .bar .state').textContent));
    await page.locator('#trace-filter').fill('');
    const had = await received(page);
    await show(page, 'board');
    await page.locator('#board-again').click();
    await choose(page, ['500k', '500k']);
    await untilText(page, '.live-state', 'live');
    await untilMore(page);
    assert.ok((await received(page)) > had);
    // Another rate: the same port, and a gap for each channel.
    await page.locator('#board-rates').click();
    await page.getByLabel('Bit rate of channel 2').fill('125k');
    await page.getByRole('button', { name: 'Set', exact: true }).click();
    await untilText(page, '#view-board', '125 kbit/s');
    await untilMore(page);
    await show(page, 'trace');
    await page.locator('#trace-filter').fill('lost');
    await until(page, 'two gaps on each channel', () => /^4 of/.test(document.querySelector('#view-trace .bar .state').textContent));
    const times = (await lines(await (await show(page, 'board'), page))).map((text) => Number(text.slice(1).split(')')[0]));
    assert.ok(times.every((time, i) => i === 0 || time >= times[i - 1]), 'the times go back');
    await page.done();
  } finally {
    await board.stop();
  }
});

test('a port that is no board, another version, a port in use, and none chosen: each has its words', async () => {
  // A response to Hello (wire/src/message.rs): kind 1, any number, Ok, Hello, protocol 99.
  const other = scriptedBoard(sealed([1, 1, 0, 0, 99]));
  const silent = scriptedBoard();
  for (const [board, text] of [
    [silent, 'does not answer as a cantap device'],
    [scriptedBoard(Buffer.from('ERROR\r\n')), 'does not answer as a cantap device'],
    [other, 'The device speaks protocol version 99'],
  ]) {
    const page = await opened(new Line(board), ['500k', ''], { waits: false });
    await untilText(page, '.notice.error', text);
    await untilText(page, '.live-state', 'board gone');
    await until(page, 'the port is closed', () => window.serialLog.closed === 1);
    await page.done();
  }
  assert.ok(silent.written.length >= 3);
  const line = new Line(scriptedBoard());
  line.refuses = 'Failed to open serial port.';
  let page = await opened(line, ['500k', ''], { waits: false });
  await untilText(page, '.notice.error', 'The port cannot be opened: Failed to open serial port. Close other programs');
  assert.equal(await page.locator('main.start').count(), 1);
  await page.evaluate(() => (window.serialCancelled = true));
  await page.getByRole('button', { name: 'Open board …' }).click();
  await page.getByLabel('Bit rate of channel 1').fill('fast');
  await page.getByRole('button', { name: 'Choose the board …' }).click();
  await untilText(page, 'dialog', '“fast” is no bit rate');
  await choose(page, ['', '']);
  await untilText(page, 'dialog', 'Give at least one channel a bit rate.');
  await choose(page, ['500k', '']);
  await until(page, 'the dialog has gone', () => !document.querySelector('dialog') && window.serialLog.asked.length === 2);
  assert.equal(await page.locator('.notice').count(), 1);
  await page.done();
  page = await newPage({ file: PAGE, before: () => Object.defineProperty(navigator, 'serial', { value: undefined }) });
  await page.getByRole('button', { name: 'Open board …' }).click();
  await untilText(page, '.notice.error', 'This browser gives pages no serial ports');
  await page.done();
});

test('a trace takes the place of what a board has sent only when the user says so', async () => {
  const board = await virtualBoard('car');
  const page = await opened(new Line(board));
  const file = { name: 'drive.log', mimeType: 'text/plain', buffer: Buffer.from('(1.0) can0 123#11\n') };
  try {
    await page.locator('.shell > input[type=file]').setInputFiles([file]);
    await untilText(page, '.notices', 'A board is open');
    await untilMore(page);
    await closed(page);
    const had = await frames(page);
    await page.locator('.shell > input[type=file]').setInputFiles([file]);
    await page.getByRole('button', { name: 'Keep it' }).click();
    assert.equal(await frames(page), had);
    await page.locator('.shell > input[type=file]').setInputFiles([file]);
    await page.getByRole('button', { name: 'Discard it' }).click();
    await untilText(page, 'footer', '1 frame in');
    assert.ok(await page.locator('.tools.live').isHidden());
    await page.done();
  } finally {
    await board.stop();
  }
});

test('cantap page writes this page', () => {
  const folder = mkdtempSync(join(tmpdir(), 'cantap-board-'));
  const { status, stderr } = spawnSync(resolve(process.env.CANTAP_TEST_PROGRAM), ['page', '-o', 'cantap.html'], { cwd: folder, encoding: 'utf8', env: { ...process.env, CANTAP_PAGE: resolve(PAGE) } });
  assert.equal(status, 0, stderr);
  assert.deepEqual(readFileSync(join(folder, 'cantap.html')), readFileSync(resolve(PAGE)));
});
