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
const SIGNALS = 4;

for (const theme of ['dark', 'light']) {
  const page = await newPage({ file, theme, size: { width: 1200, height: 750 } });
  await page.locator('main.start input[type=file]').setInputFiles(files);
  await page.locator('.shell[data-growing=false]').waitFor();
  for (const view of theme === 'dark' ? ['trace', 'graphs', 'bits'] : ['summary', 'fixed']) {
    await show(page, view);
    if (view === 'trace') {
      await page.locator('#view-trace .list').press('End');
      await page.locator('#view-trace .details dl').waitFor();
    }
    if (view === 'graphs') {
      const signals = page.locator('#view-graphs .tree-signal');
      for (let i = 0; i < Math.min(SIGNALS, await signals.count()); i++) await signals.nth(i).click();
      await page.waitForFunction(() => document.querySelector('#view-graphs').dataset.busy === 'false');
    }
    if (view === 'bits') await page.locator('.bit').first().waitFor();
    await page.screenshot({ path: join(folder, `page-${view}.png`) });
  }
  await page.done();
}
await quit();
