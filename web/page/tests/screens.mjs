// Makes the pictures of docs/page.md from a built page, a trace and databases:
//   node tests/screens.mjs PAGE.html FOLDER TRACE [DATABASE …]
// The pictures are of 1200 × 750 pixels; nothing in them depends on the machine but its fonts.

import { join } from 'node:path';
import { newPage, quit, show } from './browser.mjs';

const [file, folder, ...files] = process.argv.slice(2);
if (!file || !folder || files.length === 0) {
  console.error('usage: node tests/screens.mjs PAGE.html FOLDER TRACE [DATABASE …]');
  process.exit(2);
}
/** Of `host/virtual/src/car/car.dbc`, the database of `docs/screens/drive.log.xz`. */
const SIGNALS = ['EngineSpeed', 'VehicleSpeed', 'CurrentGear', 'AcceleratorPedal'];
const IDENTIFIER = '0C0';

for (const theme of ['dark', 'light']) {
  const page = await newPage({ file, theme, size: { width: 1200, height: 750 } });
  await page.locator('main.start input[type=file]').setInputFiles(files);
  await page.locator('.shell[data-growing=false]').waitFor();
  for (const view of theme === 'dark' ? ['trace', 'graphs', 'bits'] : ['summary', 'fixed']) {
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
      const option = page.locator('#view-bits select option', { hasText: ` ${IDENTIFIER} ` });
      await page.locator('#view-bits select').first().selectOption(await option.getAttribute('value'));
      await page.waitForFunction((id) => document.querySelector('footer').textContent.includes(id), IDENTIFIER);
      await page.locator('.bit-legend .signal-entry').first().waitFor();
    }
    await page.screenshot({ path: join(folder, `page-${view}.png`) });
  }
  await page.done();
}
await quit();
