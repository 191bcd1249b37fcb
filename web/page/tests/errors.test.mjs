import assert from 'node:assert/strict';
import { after, test } from 'node:test';
import { LOG, newPage, openTrace, opened, quit, saved, until, untilText } from './browser.mjs';

after(quit);

const file = (name, text) => ({ name, mimeType: 'text/plain', buffer: Buffer.from(text) });

test('a file of no known format says so, and the start screen stays', async () => {
  const page = await newPage();
  await page.locator('main.start input[type=file]').setInputFiles([file('x.bin', 'garbage')]);
  await untilText(page, '.notice.error', 'x.bin: x.bin is no format that cantap reads');
  assert.equal(await page.locator('main.start').count(), 1);
  await page.locator('main.start input[type=file]').setInputFiles([LOG]);
  await page.locator('.shell').waitFor();
  await page.done();
});

test('an unreadable file leaves the trace that is open', async () => {
  const page = await opened('trace');
  await page.locator('.shell > input[type=file]').setInputFiles([file('x.bin', 'garbage')]);
  await untilText(page, '.notice.error', 'is no format');
  assert.equal(await page.locator('.shell').getAttribute('data-records'), '20000');
  await page.done();
});

test('of a cut file, what was read stays, and the place is told', async () => {
  const page = await newPage({ hash: '#records=20000' });
  const piece = Buffer.alloc(1 << 20, 'a');
  await page.locator('main.start input[type=file]').setInputFiles([{ name: 'cut.log', mimeType: 'text/plain', buffer: Buffer.concat([piece, Buffer.from('cut')]) }]);
  await untilText(page, '.notice.error', 'cut.log was read to byte 1 048 576 of 1 048 579, and no further: the file ends in the middle of a record. What was read stays.');
  assert.equal(await page.locator('.shell').getAttribute('data-records'), '10000');
  await page.done();
});

test('a browser without WebAssembly is told so', async () => {
  const page = await newPage({ hash: '#no-wasm' });
  await untilText(page, '[role=alert]', 'has no WebAssembly');
  await page.done();
});

test('when the engine dies, what is shown stays, and it is started again with the trace', async () => {
  const page = await opened('trace');
  await page.evaluate(() => globalThis.fakeEngines.at(-1).close());
  await page.locator('#trace-filter').fill('123');
  await untilText(page, '.notice.error', 'The engine has stopped: it met a fault. What is shown stays.');
  assert.ok((await page.locator('#view-trace .list-row:not([hidden])').count()) > 10);
  await page.getByRole('button', { name: 'Start it again' }).click();
  await until(page, 'the filter is answered', () => /records/.test(document.querySelector('#view-trace .state').textContent) && !document.querySelector('.engine-dead'));
  await page.done();
});

test('an engine that is started again is given the databases and the bit rates anew', async () => {
  const page = await opened('summary');
  await page.locator('.shell > input[type=file]').setInputFiles([file('car.dbc', 'BU_:')]);
  await untilText(page, '#view-summary', 'car.dbc');
  await page.getByRole('button', { name: /^Bit rate of channel 1/ }).click();
  await page.getByLabel('Bit rate', { exact: true }).fill('250k');
  await page.keyboard.press('Enter');
  await untilText(page, '#view-summary', '250 kbit/s');
  await page.evaluate(() => globalThis.fakeEngines.at(-1).close());
  await page.locator('#tab-trace').click();
  await page.locator('#trace-filter').fill('123');
  await page.getByRole('button', { name: 'Start it again' }).click();
  await until(page, 'the engine is there', () => !document.querySelector('.engine-dead') && globalThis.fakeEngines.length === 2);
  await page.locator('#tab-summary').click();
  await untilText(page, '#view-summary', '250 kbit/s');
  await until(page, 'the database is there', () => globalThis.fakeEngines.at(-1).asked.get('database') === 1);
  await page.done();
});

test('a file that cannot be read takes no note and no cursor with it; one that is opened leaves the notes as texts', async () => {
  const page = await opened('trace');
  await page.locator('#view-trace .list').press('ArrowDown');
  await page.keyboard.press('Control+b');
  await page.getByLabel('Time', { exact: true }).fill('0.1');
  await page.getByRole('textbox', { name: 'Note' }).fill('here');
  await page.getByRole('button', { name: 'Add', exact: true }).click();
  await page.locator('.shell > input[type=file]').setInputFiles([file('x.bin', 'garbage')]);
  await untilText(page, '.notice.error', 'is no format');
  await page.locator('#tab-notes').click();
  await untilText(page, '#view-notes .notes', '0.100000 shere');
  await page.locator('.shell > input[type=file]').setInputFiles([LOG]);
  await untilText(page, '#view-notes .notes', 'drive.log, 0.100000 s: here');
  await page.done();
});

test('a browser that closes the page asks while a note is in no file', async () => {
  const page = await opened('trace');
  const asks = () => page.evaluate(() => !dispatchEvent(new Event('beforeunload', { cancelable: true })));
  assert.equal(await asks(), false);
  await page.keyboard.press('Control+b');
  await page.getByRole('textbox', { name: 'Note' }).fill('here');
  await page.getByRole('button', { name: 'Add', exact: true }).click();
  assert.equal(await asks(), true);
  await page.locator('#tab-notes').click();
  await saved(page, () => page.getByRole('button', { name: 'Save as text' }).click());
  assert.equal(await asks(), false);
  await page.done();
});

test('a browser that keeps nothing is told so, and all works', async () => {
  const page = await newPage({
    before: () =>
      Object.defineProperty(globalThis, 'localStorage', {
        get() {
          throw new DOMException('refused', 'SecurityError');
        },
      }),
  });
  await untilText(page, '.notices', 'keeps nothing for this page');
  await openTrace(page);
  await page.done();
});

test('names from a trace or a database stay text', async () => {
  const page = await opened('graphs');
  await untilText(page, '.tree', '</script><img src=x onerror=alert(1)>');
  assert.equal(await page.locator('#view-graphs img').count(), 0);
  await page.locator('#tab-summary').click();
  await untilText(page, '#view-summary', 'Message <b>X</b> never occurs.');
  assert.equal(await page.locator('#view-summary .findings b:not(.severity)').count(), 0);
  await page.done();
});

test('the policy lets no script in that the page did not bring', async () => {
  const page = await newPage();
  const ran = await page.evaluate(() => {
    const script = document.createElement('script');
    script.textContent = 'globalThis.intruder = true';
    document.body.append(script);
    return globalThis.intruder === true;
  });
  assert.equal(ran, false);
  assert.equal(page.faults.length, 1);
  assert.match(page.faults[0], /Content Security Policy/);
  page.faults.length = 0;
  await page.done();
});
