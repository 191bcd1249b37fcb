// Measures the page live over two saturated virtual channels: redraws, lag, memory, loss. Not a test: the figures are read by a person.
//   node tests/measure-live.mjs page.html cantap [SECONDS] [DEVICE] [BITRATE] [ui|serve]

import { readFileSync } from 'node:fs';

const [, , page, program, seconds = '180', device = 'virtual:load=100', bitrate = '1M', way = 'ui'] = process.argv;
process.env.CANTAP_TEST_PAGE = page;
process.env.CANTAP_TEST_PROGRAM = program;
const { serve, serveShared } = await import('./served.mjs');
const { launch, newPage, quit, show } = await import('./browser.mjs');

const server = await (way === 'serve' ? serveShared : serve)(['-d', device, '-b', bitrate]);
/** The engine's memory is its worker's own: the worker is made to show it. */
const before = () => {
  const show = 'const begin = WebAssembly.instantiate; WebAssembly.instantiate = async (...all) => { const made = await begin(...all); self.engineMemory = made.exports.memory; return made; };';
  const Own = Blob;
  window.Blob = class extends Own {
    constructor(parts, options) {
      super(options?.type === 'text/javascript' ? [show, ...parts] : parts, options);
    }
  };
};
const tab = await newPage({ url: server.url, before });
await tab.locator('.shell').waitFor();
const heap = await tab.context().newCDPSession(tab);
await heap.send('Performance.enable');
await heap.send('HeapProfiler.enable');
const inspector = await (await launch()).newBrowserCDPSession();

/** Megabytes in memory of a process. */
const memory = (pid) => Number(/VmRSS:\s+(\d+)/.exec(readFileSync(`/proc/${pid}/status`, 'utf8'))[1]) / 1024;

async function renderer() {
  const { processInfo } = await inspector.send('SystemInfo.getProcessInfo');
  return Math.max(...processInfo.filter((p) => p.type === 'renderer').map((p) => memory(p.id)));
}

/** Megabytes of the page's objects that are in use, and of the engine's memory. */
async function inPage() {
  await heap.send('HeapProfiler.collectGarbage');
  const { metrics } = await heap.send('Performance.getMetrics');
  const engine = await Promise.all(tab.workers().map((worker) => worker.evaluate(() => self.engineMemory?.buffer.byteLength ?? 0)));
  return [metrics.find((m) => m.name === 'JSHeapUsedSize').value, Math.max(...engine)].map((bytes) => bytes / 1024 ** 2);
}

/** What happens in the page within some seconds: redraws of the browser, of the rows, the longest pause, and how far the newest record is behind the clock. */
const look = (ms) =>
  tab.evaluate(
    (duration) =>
      new Promise((done) => {
        const shell = document.querySelector('.shell');
        const list = document.querySelector('#view-trace .list');
        const drawn = Number(list.dataset.drawn ?? 0);
        const received = Number(shell.dataset.received);
        const begin = performance.now();
        let frames = 0;
        let longest = 0;
        let last = begin;
        const lags = [];
        const step = () => {
          const now = performance.now();
          longest = Math.max(longest, now - last);
          last = now;
          frames++;
          if (shell.dataset.newest) lags.push(Date.now() - Number(shell.dataset.newest));
          if (now - begin < duration) requestAnimationFrame(step);
          else {
            const took = (now - begin) / 1000;
            lags.sort((a, b) => a - b);
            done({ redraws: frames / took, rows: (Number(list.dataset.drawn ?? 0) - drawn) / took, longest, records: (Number(shell.dataset.received) - received) / took, behind: Number(shell.dataset.behind), lag: lags[Math.floor(lags.length / 2)], worst: lags.at(-1), lost: document.querySelector('footer').textContent.match(/no known loss|(an unknown number of|[\d ]+) frames lost/)?.[0] });
          }
        };
        requestAnimationFrame(step);
      }),
    ms,
  );

/** Milliseconds from a key to the picture that answers it: a view that is changed, or a row above that is selected. */
const key = (name, answered) =>
  tab.evaluate(
    ([name, answered]) =>
      new Promise((done) => {
        const state = new Function(`return ${answered}`);
        const before = state();
        const start = performance.now();
        document.activeElement.dispatchEvent(new KeyboardEvent('keydown', { key: name, bubbles: true }));
        const step = () => (state() === before ? requestAnimationFrame(step) : requestAnimationFrame(() => done(performance.now() - start)));
        step();
      }),
    [name, answered],
  );

async function keys() {
  const took = [];
  for (let i = 0; i < 5; i++) {
    for (const [name, view] of [['4', 'fixed'], ['3', 'graphs'], ['2', 'trace']]) took.push(await key(name, `!document.querySelector('#view-${view}').hidden`));
    await tab.locator('#view-trace .list').focus();
    for (let n = 0; n < 5; n++) took.push(await key('ArrowUp', `document.querySelector('#view-trace .list-row.selected:not([hidden])')?.dataset.index`));
  }
  return took.sort((a, b) => a - b);
}

const n = (value, digits = 0) => (value === undefined ? '–' : value.toFixed(digits));
console.log('second  view      redraws/s  rows/s  longest ms  records/s  lag ms (worst)  behind  MB page  MB objects  MB engine  MB cantap  losses');
const views = ['trace', 'fixed', 'graphs'];
const begin = Date.now();
for (let round = 0; Date.now() - begin < Number(seconds) * 1000; round++) {
  const view = views[round % views.length];
  await show(tab, view);
  if (view === 'trace' && round === 0) await tab.keyboard.press('F');
  if (view === 'graphs' && round === 2) for (const signal of (await tab.locator('.tree-signal, .tree-load').all()).slice(0, 2)) await signal.click();
  const found = await look(10_000);
  const [objects, engine] = await inPage();
  console.log([n((Date.now() - begin) / 1000).padStart(6), view.padEnd(8), n(found.redraws, 1).padStart(10), n(found.rows, 1).padStart(7), n(found.longest).padStart(11), n(found.records).padStart(10), `${n(found.lag)} (${n(found.worst)})`.padStart(15), String(found.behind).padStart(7), n(await renderer()).padStart(8), n(objects, 1).padStart(10), n(engine).padStart(9), n(memory(server.child.pid)).padStart(10), found.lost].join('  '));
}
await show(tab, 'trace');
const took = await keys();
console.log(`keys: median ${n(took[Math.floor(took.length / 2)], 1)} ms, worst ${n(took.at(-1), 1)} ms of ${took.length}`);
await tab.context().close();
await server.stop();
await quit();
