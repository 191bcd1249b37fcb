import assert from 'node:assert/strict';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, test } from 'node:test';
import { gzipSync } from 'node:zlib';
import { FAKE, newPage, quit, saved, show, until, untilText } from './browser.mjs';

const folder = mkdtempSync(join(tmpdir(), 'cantap-page-'));
after(async () => {
  await quit();
  rmSync(folder, { recursive: true });
});

const trace = Buffer.from('(1.0) can0 123#11\n'.repeat(1000));

function report(changes = {}) {
  const packed = (name, bytes) => ({ name, encoding: 'gzip', size: bytes.length, data: gzipSync(bytes).toString('base64') });
  return {
    version: 1,
    title: 'Drive </script><b>1</b>',
    created: '2026-11-28T05:00:00Z',
    command: 'cantap report drive.log',
    notes: ['Brake <i>pedal</i> at 12 s'],
    trace: packed('drive.log', trace),
    databases: [{ ...packed('car.dbc', Buffer.from('BU_:')), channel: null }],
    bitrates: [{ channel: 1, bitrate: 125000, dataBitrate: null }],
    findings: [{ severity: 'error', text: 'From the report', time: 2, channel: 1, id: null, extended: false }],
    thinned: ['Every second frame of 1FF was left out.'],
    ...changes,
  };
}

function write(name, text) {
  const file = join(folder, name);
  writeFileSync(file, readFileSync(FAKE, 'utf8').replace('<!--cantap-report-->', () => `<script type="application/json" id="cantap-report">${text}</script>`));
  return file;
}

const json = (value) => JSON.stringify(value).replaceAll('<', '\\u003c');

test('a report opens by itself: notes, findings, databases, and the trace comes out of it as it was', async () => {
  const page = await newPage({ file: write('report.html', json(report())) });
  await untilText(page, '#view-summary', 'Drive </script><b>1</b>');
  await untilText(page, '#view-summary', 'Brake <i>pedal</i> at 12 s');
  await untilText(page, '#view-summary .findings li', 'From the report');
  await untilText(page, '#view-summary', 'Every second frame of 1FF was left out.');
  await untilText(page, '#view-summary', 'car.dbc');
  await untilText(page, '#view-summary', '125 kbit/s');
  const file = await saved(page, () => page.getByRole('button', { name: 'Save the trace' }).click());
  assert.equal(file.name, 'drive.log');
  assert.ok(file.bytes.equals(trace));
  await page.done();
});

test('the worst finding comes first, whoever found it, and the report’s notes are among the notes', async () => {
  const finding = (severity, text) => ({ severity, text, time: null, channel: 1, id: null, extended: false });
  const page = await newPage({ file: write('order.html', json(report({ findings: [finding('info', 'Against old.log'), finding('warning', '200 is new')] }))) });
  await untilText(page, '#view-summary', 'At least 7 frames were lost');
  const severities = await page.locator('#view-summary .findings .severity').allTextContents();
  assert.deepEqual(severities, ['error', 'warning', 'warning', 'info', 'info']);
  await show(page, 'notes');
  await untilText(page, '#view-notes', 'Brake <i>pedal</i> at 12 s');
  await page.done();
});

test('the first page is printed whole, dark on white, without its controls', async () => {
  const findings = Array.from({ length: 80 }, (_, n) => ({ severity: 'warning', text: `Finding ${n}`, time: n, channel: 1, id: null, extended: false }));
  const page = await newPage({ file: write('print.html', json(report({ findings }))), theme: 'dark', size: { width: 800, height: 600 } });
  await untilText(page, '#view-summary', 'Finding 79');
  await page.emulateMedia({ media: 'print' });
  const seen = await page.evaluate(() => {
    const luminance = getComputedStyle(document.body).color.match(/\d+/g).slice(0, 3).map(Number).reduce((a, b) => a + b);
    const last = document.querySelector('#view-summary .findings li:last-child').getBoundingClientRect();
    return { luminance, height: document.documentElement.scrollHeight, last: last.bottom, header: document.querySelector('.shell > header').getBoundingClientRect().height };
  });
  assert.ok(seen.luminance < 300, JSON.stringify(seen));
  assert.equal(seen.header, 0);
  assert.ok(seen.height > 1200 && seen.last <= seen.height, JSON.stringify(seen));
  await page.done();
});

test('a report’s title and findings are not shown above another trace', async () => {
  const page = await newPage({ file: write('other.html', json(report())) });
  await untilText(page, '#view-summary', 'From the report');
  await page.locator('.shell > input[type=file]').setInputFiles([{ name: 'other.log', mimeType: 'text/plain', buffer: Buffer.from('(1.0) can0 123#22\n') }]);
  await until(page, 'the report is gone', () => !/From the report|Drive|pedal/.test(document.querySelector('#view-summary').textContent));
  assert.equal(await page.getByRole('button', { name: 'Save the trace' }).count(), 0);
  await page.done();
});

test('a damaged report says so and leaves the page usable', async () => {
  const page = await newPage({ file: write('damaged.html', json(report()).slice(0, 200)) });
  await untilText(page, '.notice.error', 'is damaged');
  assert.equal(await page.locator('main.start').count(), 1);
  await page.done();
});

test('a report whose trace was cut says how much is there', async () => {
  const packed = { name: 'drive.log', encoding: 'none', size: 100, data: Buffer.from('short').toString('base64') };
  const page = await newPage({ file: write('cut.html', json(report({ trace: packed }))) });
  await untilText(page, '.notice.error', 'drive.log: 5 of 100 bytes came out of the report');
  await page.done();
});

test('a report of a later version is refused with what to do', async () => {
  const page = await newPage({ file: write('later.html', json(report({ version: 2 }))) });
  await untilText(page, '.notice.error', 'another version');
  await page.done();
});
