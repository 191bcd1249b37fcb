import assert from 'node:assert/strict';
import { after, test } from 'node:test';
import { opened, quit, saved, until, untilText } from './browser.mjs';

after(quit);

async function bits() {
  const page = await opened('bits');
  await page.locator('#bit-0').waitFor();
  return page;
}

test('a bit that is always 1 is not shown as one that changed once', async () => {
  const page = await opened('bits');
  await page.locator('.bit').first().waitFor();
  assert.equal(await page.locator('#bit-3').textContent(), '=1');
  assert.match(await page.locator('#bit-7').textContent(), /^\d/);
  await page.done();
});

test('the grid shows each bit’s changes, and signals have their outline, overlapping ones one within the other', async () => {
  const page = await bits();
  assert.equal(await page.locator('.bit').count(), 64);
  // Speed: bytes 0 and 1; Low lies within it: byte 0.
  assert.equal(await page.locator('#bit-3 .outline').count(), 2);
  assert.equal(await page.locator('#bit-3 .outline.depth1').count(), 1);
  assert.equal(await page.locator('#bit-11 .outline').count(), 1);
  assert.equal(await page.locator('#bit-30 .outline').count(), 0);
  assert.match(await page.locator('#bit-0').getAttribute('aria-label'), /, byte 0 bit 7: \d+ changes/);
  await page.done();
});

test('bits are marked by keys, made a signal, seen in the graphs, undone, redone and saved', async () => {
  const page = await bits();
  await page.locator('.bit-grid').focus();
  for (let i = 0; i < 4; i++) await page.keyboard.press('ArrowDown');
  await page.keyboard.down('Shift');
  await page.keyboard.press('ArrowDown');
  for (let i = 0; i < 7; i++) await page.keyboard.press('ArrowRight');
  await page.keyboard.up('Shift');
  // From byte 4 bit 7 to byte 5 bit 0: by the DBC's numbers those are neighbours across both bytes.
  await untilText(page, '.bit-about', 'marked: start 39, 2 bit, little-endian');
  await page.getByLabel('Little-endian (Intel)').uncheck();
  await untilText(page, '.bit-about', 'marked: start 39, 16 bit, big-endian');
  await page.locator('.bit-grid').press('Enter');
  await page.keyboard.type('Torque');
  await page.getByLabel('Unit').fill('Nm');
  await page.getByLabel('Factor').fill('0.5');
  await page.getByRole('button', { name: 'Make the signal' }).click();
  await until(page, 'the signal is in the grid', () => [...document.querySelectorAll('.bit-legend button')].some((b) => b.textContent.startsWith('Torque ')));
  await page.locator('#tab-graphs').click();
  await untilText(page, '.panel', 'Engine.Torque');
  await page.locator('#tab-bits').click();
  // In a field, Ctrl+Z is the field's own.
  await page.getByLabel('Unit').fill('Nm2');
  await page.getByLabel('Unit').press('Control+z');
  assert.equal(await page.locator('.bit-legend button', { hasText: 'Torque' }).count(), 1);
  await page.locator('.bit-grid').focus();
  await page.keyboard.press('Control+z');
  await until(page, 'undone', () => ![...document.querySelectorAll('.bit-legend button')].some((b) => b.textContent.startsWith('Torque ')));
  await page.keyboard.press('Control+y');
  await until(page, 'redone', () => [...document.querySelectorAll('.bit-legend button')].some((b) => b.textContent.startsWith('Torque ')));
  const dbc = await saved(page, () => page.getByRole('button', { name: 'Save DBC' }).click());
  assert.match(dbc.bytes.toString(), /"name":"Torque","startBit":39,"bitLength":16,"littleEndian":false/);
  await page.done();
});

test('bits are marked by the mouse, and a field that does not fit says so', async () => {
  const page = await bits();
  const from = await page.locator('#bit-32').boundingBox();
  const to = await page.locator('#bit-39').boundingBox();
  await page.mouse.move(from.x + 5, from.y + 5);
  await page.mouse.down();
  await page.mouse.move(to.x + 5, to.y + 5);
  await page.mouse.up();
  await untilText(page, '.bit-about', 'marked: start 32, 8 bit');
  await page.getByRole('textbox', { name: 'Bits' }).fill('40');
  await untilText(page, '.editor-form [role=alert]', 'reaches beyond the frame’s 64 bits');
  await page.getByRole('textbox', { name: 'Bits' }).fill('8');
  await page.getByLabel('Signal name').fill('no name');
  await untilText(page, '.editor-form [role=alert]', 'letters, digits and underscores');
  await page.done();
});

test('without cursors, the stretch between them says what to do', async () => {
  const page = await bits();
  await page.getByLabel('Stretch of time').selectOption('marked');
  await untilText(page, '#view-bits .state', 'Put the cursors A and B first');
  await page.done();
});
