// Makes the pictures of docs/page.md from a built page, a trace and databases:
//   node tests/screens.mjs PAGE.html FOLDER TRACE [DATABASE …]
// The pictures are of 1200 × 750 pixels; nothing in them depends on the machine but its fonts.

import { join } from 'node:path';
import { HERE, newPage, quit, show } from './browser.mjs';

const [file, folder, ...files] = process.argv.slice(2);
if (!file || !folder || files.length === 0) {
  console.error('usage: node tests/screens.mjs PAGE.html FOLDER TRACE [DATABASE …]');
  process.exit(2);
}
/** Of `host/virtual/src/car/car.dbc`, the database of `docs/screens/drive.log.xz`. */
const SIGNALS = ['EngineSpeed', 'VehicleSpeed', 'CurrentGear', 'AcceleratorPedal'];
const IDENTIFIER = '0C0';

/** A machine whose CANopen drive stops: its nodes are shown. */
const MACHINE = join(HERE, '../../../host/protocols/tests/buses/machine.log');
const NOTES = [
  ['', 'Drive after the new injectors, engine warm.'],
  ['12.5', 'The driver felt a jerk here.'],
  ['30', 'From here on without air conditioning.'],
];

const open = async (theme, files) => {
  const page = await newPage({ file, theme, size: { width: 1200, height: 750 } });
  await page.locator('main.start input[type=file]').setInputFiles(files);
  await page.locator('.shell[data-growing=false]').waitFor();
  return page;
};
/** Chooses the identifier of the pictures in a view of one. */
const choose = async (page, view) => {
  const option = page.locator(`#view-${view} select option`, { hasText: ` ${IDENTIFIER} ` });
  await page.locator(`#view-${view} select`).first().selectOption(await option.getAttribute('value'));
  await page.waitForFunction((id) => document.querySelector('footer').textContent.includes(id), IDENTIFIER);
};

for (const theme of ['dark', 'light']) {
  const page = await open(theme, files);
  for (const view of theme === 'dark' ? ['trace', 'graphs', 'bits', 'notes'] : ['summary', 'fixed', 'statistics']) {
    await show(page, view);
    if (view === 'trace') {
      await page.locator('#view-trace .list').press('End');
      await page.locator('#trace-find').fill(IDENTIFIER);
      await page.locator('#trace-find').press('Shift+Enter');
      await page.locator('#view-trace .details .signals').waitFor();
    }
    if (view === 'graphs') {
      const search = page.getByRole('searchbox', { name: 'Search messages and signals' });
      for (const name of SIGNALS) {
        await search.fill(name);
        // Not another one that has the name within its own.
        await page.locator('#view-graphs .tree-signal', { has: page.getByText(name, { exact: true }) }).first().click();
      }
      await search.fill('ECM');
      await page.waitForFunction(() => document.querySelector('#view-graphs').dataset.busy === 'false');
    }
    if (view === 'bits') {
      await page.locator('#view-bits .bit').first().waitFor();
      await choose(page, view);
      await page.locator('.bit-legend .signal-entry').first().waitFor();
    }
    if (view === 'statistics') {
      await choose(page, view);
      await page.locator('#view-statistics h3', { hasText: IDENTIFIER }).waitFor();
    }
    if (view === 'notes') {
      for (const [time, text] of NOTES) {
        await page.getByRole('button', { name: 'Add a note' }).click();
        await page.getByRole('textbox', { name: 'Time' }).fill(time);
        await page.getByRole('textbox', { name: 'Note' }).fill(text);
        await page.getByRole('button', { name: 'Add', exact: true }).click();
      }
    }
    await page.screenshot({ path: join(folder, `page-${view === 'statistics' ? 'periods' : view}.png`) });
  }
  await page.done();
}
const page = await open('light', [MACHINE]);
await show(page, 'conversations');
await page.locator('#view-conversations .list:not([hidden]) .list-row:not([hidden])').first().waitFor();
await page.screenshot({ path: join(folder, 'page-conversations.png') });
await page.getByLabel('Shape').selectOption('nodes');
await page.locator('#view-conversations .list:not([hidden]) .list-row:not([hidden])', { hasText: 'canopen' }).first().waitFor();
await page.screenshot({ path: join(folder, 'page-nodes.png') });
await page.done();
await quit();
