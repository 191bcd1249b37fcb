import assert from 'node:assert/strict';
import { after, test } from 'node:test';
import { opened, quit, saved, show, until, untilRow, untilText } from './browser.mjs';

after(quit);

test('summary: a finding leads to its place; the bit rate is set in cantap’s spelling', async () => {
  const page = await opened('summary');
  await untilText(page, '#view-summary', 'At least 7 frames were lost');
  await page.getByRole('button', { name: /^4\.999000 s/ }).click();
  await untilRow(page, 4999);
  await show(page, 'summary');
  await page.getByRole('button', { name: /^Bit rate of channel 1/ }).click();
  await page.getByLabel('Bit rate', { exact: true }).fill('fast');
  await page.keyboard.press('Enter');
  await untilText(page, 'dialog [role=alert]', 'is no bit rate');
  await page.getByLabel('Bit rate', { exact: true }).fill('250k');
  await page.keyboard.press('Enter');
  await untilText(page, '#view-summary', '250 kbit/s');
  await page.done();
});

test('summary: whoever is at a button by the keyboard stays there when it is drawn anew', async () => {
  const page = await opened('summary');
  await page.getByRole('button', { name: /^Bit rate of channel 1/ }).focus();
  await page.locator('.shell > input[type=file]').setInputFiles([{ name: 'car.dbc', mimeType: 'text/plain', buffer: Buffer.from('BU_:') }]);
  await untilText(page, '#view-summary', 'car.dbc');
  assert.match(await page.evaluate(() => document.activeElement.getAttribute('aria-label')), /^Bit rate of channel 1/);
  await page.done();
});

test('fixed view: a row per identifier with its period, opened to its signals, and the bits that changed', async () => {
  const page = await opened('fixed');
  await until(page, 'four identifiers', () => document.querySelectorAll('#view-fixed .list-layer .list-row:not([hidden])').length === 4);
  assert.match(await page.locator('#view-fixed .list-row[data-index="0"]').textContent(), /100Engine5 0004\.000/);
  assert.ok((await page.locator('#view-fixed .byte[data-changed]').count()) >= 4);
  await page.locator('#view-fixed .list').focus();
  await page.keyboard.press('Home');
  await page.keyboard.press('ArrowRight');
  await until(page, 'three signals', () => document.querySelectorAll('#view-fixed .list-row.sub:not([hidden])').length === 3);
  assert.match(await page.locator('#view-fixed .list-row.sub').first().textContent(), /Speed\d+ rpm/);
  await page.keyboard.press('ArrowLeft');
  await until(page, 'closed', () => document.querySelectorAll('#view-fixed .list-row.sub:not([hidden])').length === 0);
  await page.keyboard.press('x');
  await page.locator('#view-bits .bit').first().waitFor();
  await page.done();
});

test('periods: figures and a histogram in which a single late frame is a row of the table', async () => {
  const page = await opened('statistics');
  await untilText(page, '#view-statistics', 'Standard deviation120 µs');
  await untilText(page, '#view-statistics tbody tr:last-child', '6.02 ms6.08 ms1');
  await page.keyboard.press('n');
  await untilText(page, '#view-statistics h3', 'Periods of 123');
  await page.done();
});

test('conversations: ladder and list, searched, lead to the trace', async () => {
  const page = await opened('conversations');
  await untilText(page, '#view-conversations .state', '300 of 300 events');
  assert.ok((await page.locator('#view-conversations svg .arrow').count()) > 10);
  await page.keyboard.press('l');
  await untilText(page, '#view-conversations .list:not([hidden]) .list-layer', 'UDS');
  await page.keyboard.press('/');
  await page.keyboard.type('part 170');
  await untilText(page, '#view-conversations .state', '1 of 300 events');
  assert.equal(await page.locator('#view-conversations .list:not([hidden]) .list-row.failed:not([hidden])').count(), 1);
  await page.locator('#view-conversations .list:not([hidden])').focus();
  await page.keyboard.press('Home');
  await page.keyboard.press('Enter');
  await untilRow(page, 8500);
  await page.done();
});

test('conversations: nodes have their states as states, searched, lead to their last change', async () => {
  const page = await opened('conversations');
  await page.getByLabel('Shape').selectOption('nodes');
  await untilText(page, '#view-conversations .state', '2 of 2 nodes, as they are at the end');
  const texts = (await page.locator('#view-conversations .list:not([hidden]) .list-layer .list-row:not([hidden]) > *').allTextContents());
  assert.deepEqual(texts, ['1', 'canopen', '5', 'operational', '2.500000', 'fault', '4.999000', '2', '1', 'emergency: 0x2310 continuous overcurrent', '1', 'j1939', '0', '', '', '', '', '0', '0', 'engine, manufacturer <b>1</b>']);
  await page.keyboard.press('/');
  await page.keyboard.type('fault');
  await untilText(page, '#view-conversations .state', '1 of 2 nodes');
  await page.locator('#view-conversations .list:not([hidden])').focus();
  await page.keyboard.press('Home');
  await page.keyboard.press('Enter');
  await untilRow(page, 4999);
  await page.done();
});

test('notes are made at a cursor, lead there, and are saved', async () => {
  const page = await opened('trace');
  await page.locator('#view-trace .list').focus();
  for (let i = 0; i < 101; i++) await page.keyboard.press('ArrowDown');
  await untilRow(page, 100);
  await page.keyboard.press('a');
  await until(page, 'cursor A is there', () => true);
  await page.keyboard.press('Control+b');
  await untilText(page, 'dialog', 'Note');
  await page.getByLabel('Time', { exact: true }).fill('0.1');
  await page.getByRole('textbox', { name: 'Note' }).fill('<b>here</b>');
  await page.getByRole('button', { name: 'Add', exact: true }).click();
  await show(page, 'notes');
  await untilText(page, '#view-notes', '<b>here</b>');
  const text = await saved(page, () => page.getByRole('button', { name: 'Save as text' }).click());
  assert.equal(text.bytes.toString(), '0.100000\t<b>here</b>\n');
  await page.getByRole('button', { name: '0.100000 s' }).click();
  await untilRow(page, 100);
  await page.done();
});

test('a stretch of a filter is exported in a chosen format', async () => {
  const page = await opened('trace');
  await page.getByRole('button', { name: 'Export …' }).click();
  await page.getByLabel('From', { exact: true }).fill('1');
  await page.getByLabel('To', { exact: true }).fill('0.5');
  await page.getByLabel('Format', { exact: true }).selectOption('asc');
  await page.getByRole('button', { name: 'Export', exact: true }).click();
  await untilText(page, 'dialog [role=alert]', 'the earlier first');
  await page.getByLabel('To', { exact: true }).fill('2s');
  const file = await saved(page, () => page.getByRole('button', { name: 'Export', exact: true }).click());
  assert.deepEqual([file.name, file.bytes.toString()], ['drive.asc', 'asc 1 2\n']);
  await page.done();
});

test('the palette finds commands, signals and messages; ? lists the keys; numbers switch views', async () => {
  const page = await opened('trace');
  await page.keyboard.press('Control+k');
  await page.keyboard.type('gear gr');
  await untilText(page, '.palette li[aria-selected=true]', 'Graph: Gearbox.Gear');
  await page.keyboard.press('Enter');
  await untilText(page, '.panel', 'Gearbox.Gear');
  await page.keyboard.press('?');
  await untilText(page, 'dialog.keys', 'Undo zoom');
  await page.keyboard.press('Escape');
  await page.keyboard.press('4');
  await until(page, 'the fixed view', () => document.querySelector('.shell').dataset.view === 'fixed');
  await page.done();
});

test('theme, view and graphs are kept for the next visit, and in a profile', async () => {
  const page = await opened('graphs');
  await page.locator('#view-graphs .tree-signal', { hasText: 'Speed' }).click();
  await page.keyboard.press('D');
  await page.keyboard.press('D');
  assert.equal(await page.evaluate(() => document.documentElement.dataset.theme), 'light');
  const profile = await saved(page, async () => {
    await page.keyboard.press('Control+k');
    await page.keyboard.type('save the layout');
    await page.keyboard.press('Enter');
  });
  const read = JSON.parse(profile.bytes.toString());
  assert.deepEqual([read.cantapProfile, read.theme, read.view, read.panels[0].items[0].signal], [1, 'light', 'graphs', 'Speed']);
  await page.reload();
  await page.locator('main.start input[type=file]').setInputFiles([{ name: 'drive.log', mimeType: 'text/plain', buffer: Buffer.from('x') }]);
  await untilText(page, '.panel', 'Engine.Speed');
  assert.equal(await page.evaluate(() => document.documentElement.dataset.theme), 'light');
  await page.done();
});

test('files that are dropped are opened', async () => {
  const page = await opened('summary');
  const transfer = await page.evaluateHandle(() => {
    const t = new DataTransfer();
    t.items.add(new File(['BU_:'], 'car.dbc'));
    return t;
  });
  await page.locator('main').dispatchEvent('drop', { dataTransfer: transfer });
  await untilText(page, '#view-summary', 'car.dbc');
  await page.done();
});
