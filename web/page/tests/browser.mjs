// What all tests of the page share: a browser, a page with a trace open, and waiting for states instead of times.

import { dirname, join } from 'node:path';
import { fileURLToPath, pathToFileURL } from 'node:url';
import { chromium } from 'playwright-core';

export const HERE = dirname(fileURLToPath(import.meta.url));
export const FAKE = join(HERE, '../dist/fake.html');

let browser;

export async function launch() {
  browser ??= await chromium.launch({ executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium', args: ['--no-sandbox'] });
  return browser;
}

export async function quit() {
  await browser?.close();
  browser = undefined;
}

/** A page; whatever it writes as an error, and each request that leaves it (or its server), fails the test in `done`. */
export async function newPage({ file = FAKE, url = null, hash = '', theme = 'dark', size = { width: 1440, height: 900 }, before, more = {}, browser = launch } = {}) {
  const context = await (await browser()).newContext({ viewport: size, colorScheme: theme, acceptDownloads: true, ...more });
  // A limit that only a fault reaches, on a busy machine, too.
  context.setDefaultTimeout(60_000);
  const page = await context.newPage();
  const faults = [];
  page.on('pageerror', (error) => faults.push(`error: ${error.message}`));
  page.on('console', (message) => {
    if (message.type() === 'error') faults.push(`console: ${message.text()}`);
  });
  page.on('request', (request) => {
    if (!/^(file|blob|data):/.test(request.url()) && !(url && request.url().startsWith(`${new URL(url).origin}/`))) faults.push(`request: ${request.url()}`);
  });
  page.faults = faults;
  page.done = async () => {
    await context.close();
    if (faults.length > 0) throw new Error(faults.join('\n'));
  };
  if (before) await page.addInitScript(before);
  await page.goto(url ?? `${pathToFileURL(file)}${hash}`);
  return page;
}

export const LOG = { name: 'drive.log', mimeType: 'text/plain', buffer: Buffer.from('(1.0) can0 123#11\n') };

export async function openTrace(page, files = [LOG]) {
  await page.locator('main.start input[type=file]').setInputFiles(files);
  await page.locator('.shell[data-growing=false]').waitFor();
}

/** A page with the tests' trace open, in a view. */
export async function opened(view, options = {}) {
  const page = await newPage({ ...options, hash: `#records=${options.records ?? 20_000}` });
  await openTrace(page);
  await show(page, view);
  return page;
}

export async function show(page, view) {
  await page.locator(`#tab-${view}`).click();
  await page.locator(`#view-${view}`).waitFor();
}

/** Waits until a function in the page answers true; what it saw last is in the error. */
export async function until(page, about, fn, argument) {
  const end = Date.now() + 60_000;
  for (;;) {
    try {
      await page.waitForFunction(fn, argument, { timeout: Math.max(1, end - Date.now()) });
      return;
    } catch (error) {
      // What it looks at may not be there yet.
      if (Date.now() >= end || !/of (null|undefined)/.test(error.message)) {
        throw new Error(`waited in vain until ${about}`, { cause: error });
      }
      await new Promise((again) => setTimeout(again, 20));
    }
  }
}

export async function untilText(page, selector, text) {
  await until(page, `${selector} has “${text}” (it has “${await page.locator(selector).first().textContent().catch(() => 'nothing')}”)`, ([s, t]) => document.querySelector(s)?.textContent?.includes(t), [selector, text]);
}

/** Numbers of records of the rows in sight, from the top. */
export function rowsInSight(page, view = 'trace') {
  return page.locator(`#view-${view} .list-layer .list-row:not([hidden])`).evaluateAll((rows) => rows.map((row) => ({ index: Number(row.dataset.index), y: row.getBoundingClientRect().top, text: row.textContent, pending: row.classList.contains('pending') })).sort((a, b) => a.index - b.index));
}

export async function untilRow(page, index, view = 'trace') {
  await until(page, `row ${index} is selected and there`, ([v, i]) => document.querySelector(`#view-${v} .list-row.selected:not([hidden]):not(.pending)`)?.dataset.index === String(i), [view, index]);
}

/** What a click saves, as text. */
export async function saved(page, act) {
  const [download] = await Promise.all([page.waitForEvent('download'), act()]);
  const stream = await download.createReadStream();
  const parts = [];
  for await (const part of stream) parts.push(part);
  return { name: download.suggestedFilename(), bytes: Buffer.concat(parts) };
}
