// Measures how often the page redraws: scrolling the trace, panning and zooming graphs.
//   node tests/measure.mjs PAGE.html TRACE [DATABASE …]     a page as it is delivered
//   node tests/measure.mjs --rows N                         the page over the tests' engine
// A redraw counts once per animation frame in which the view was drawn anew. Figures belong with the machine they were measured on.

import { LOG, newPage, quit, show } from './browser.mjs';

const argv = process.argv.slice(2);
const fake = argv[0] === '--rows';
const page = await newPage(fake ? { hash: `#records=${argv[1]}` } : { file: argv[0] });
const started = Date.now();
await page.locator('main.start input[type=file]').setInputFiles(fake ? [LOG] : argv.slice(1));
await page.locator('.shell').waitFor({ timeout: 600_000 });
const firstScreen = Date.now() - started;
await page.locator('.shell[data-growing=false]').waitFor({ timeout: 600_000 });
console.log(`first screen after ${firstScreen} ms, all after ${Date.now() - started} ms, ${await page.locator('.shell').getAttribute('data-records')} records`);

/** Does something in each animation frame for two seconds; answers redraws a second, and the longest time between two. */
async function run(name, selector, act) {
  const result = await page.evaluate(
    async ([selector, body]) => {
      const step = new Function('i', body);
      const element = document.querySelector(selector);
      const before = Number(element.dataset.drawn);
      const start = performance.now();
      let longest = 0;
      let last = start;
      let frames = 0;
      await new Promise((done) => {
        const tick = (now) => {
          longest = Math.max(longest, now - last);
          last = now;
          frames++;
          // Input comes between frames, as a hand's does.
          setTimeout(() => step(frames));
          if (now - start < 2000) requestAnimationFrame(tick);
          else done();
        };
        requestAnimationFrame(tick);
      });
      const seconds = (performance.now() - start) / 1000;
      return { drawn: (Number(element.dataset.drawn) - before) / seconds, frames: frames / seconds, longest };
    },
    [selector, act],
  );
  console.log(`${name}: ${result.drawn.toFixed(1)} redraws/s (${result.frames.toFixed(1)} animation frames/s), at most ${result.longest.toFixed(0)} ms between two`);
}

await show(page, 'trace');
await page.locator('#view-trace .list-layer .list-row:not(.pending)').first().waitFor();
await run('scrolling by the wheel', '#view-trace .list', `document.querySelector('#view-trace .list').dispatchEvent(new WheelEvent('wheel', { deltaY: 240, bubbles: true, cancelable: true }))`);
await run('dragging the scroll bar', '#view-trace .list', `const l = document.querySelector('#view-trace .list'); l.scrollTop = (i % 100) / 100 * l.scrollHeight`);
await show(page, 'graphs');
const closed = page.locator('#view-graphs .tree-message[aria-expanded=false]');
for (let i = 0; i < 20 && (await closed.count()) > 0; i++) await closed.first().click();
const signals = page.locator('#view-graphs .tree-signal:has(.sparkline)');
for (let i = 0; i < Math.min(20, await signals.count()); i++) await signals.nth(i).click();
await page.waitForFunction(() => document.querySelector('#view-graphs').dataset.busy === 'false', undefined, { timeout: 600_000 });
const wheel = (x, options) => `const c = document.querySelector('.time-axis'); const b = c.getBoundingClientRect(); c.dispatchEvent(new WheelEvent('wheel', { clientX: b.left + b.width * ${x}, bubbles: true, cancelable: true, ${options} }))`;
console.log(`${await page.locator('.panel').count()} graphs`);
await run('zooming in', '#view-graphs', wheel(0.5, 'deltaY: -40'));
await run('panning', '#view-graphs', wheel(0.5, 'deltaX: i % 120 < 60 ? 12 : -12'));
await run('zooming out', '#view-graphs', wheel(0.5, 'deltaY: 40'));

// From everything to a millisecond and back by one key each: undo and redo of a zoom.
const state = () => page.evaluate(() => ({ ...document.querySelector('#view-graphs').dataset }));
await page.keyboard.press('0');
for (let i = 0; i < 100 && Number((await state()).to) - Number((await state()).from) > 0.001; i++) {
  await page.evaluate(([s]) => new Function(s)(), [wheel(0.5, 'deltaY: -800')]);
  await page.waitForTimeout(20);
}
const near = await state();
await page.keyboard.press('0');
await page.waitForFunction(() => document.querySelector('#view-graphs').dataset.busy === 'false');
/** Presses a key, and counts the browser's frames and the milliseconds until the graphs show all of another stretch. */
const leap = (key) =>
  page.evaluate(
    (key) =>
      new Promise((done) => {
        const view = document.querySelector('#view-graphs');
        const before = view.dataset.to;
        const start = performance.now();
        let frames = 0;
        document.activeElement.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true}));
        // Looked at when the frame's picture has been drawn.
        const drawn = () => (view.dataset.to !== before && view.dataset.busy === 'false' ? done({ frames, ms: performance.now() - start }) : requestAnimationFrame(step));
        const step = () => {
          frames++;
          setTimeout(drawn);
        };
        requestAnimationFrame(step);
      }),
    key,
  );
console.log(`a millisecond: ${(near.to - near.from) * 1000} ms of ${near.from} s`);
for (let i = 0; i < 5; i++) {
  const [to, back] = [await leap('Backspace'), await leap('0')];
  console.log(`to a millisecond: ${to.frames} frames, ${to.ms.toFixed(0)} ms; to everything: ${back.frames} frames, ${back.ms.toFixed(0)} ms`);
}
await page.context().close();
await quit();
