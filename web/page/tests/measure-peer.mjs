// Measures this page beside CANviz (https://pypi.org/project/canviz), a page over python-can, with the same simulated bus at several loads: frames that get
// into the page, redraws, processor time. Not a test: the figures are read by a person.
//   python3 -m venv peer && peer/bin/pip install canviz
//   node tests/measure-peer.mjs page.html cantap peer/bin/canviz [LOADS] [SECONDS]

import { spawn } from 'node:child_process';
import { readFileSync } from 'node:fs';
import { createInterface } from 'node:readline';
import { setTimeout as sleep } from 'node:timers/promises';

const [, , page, program, canviz, loads = '10,30,60,100', seconds = '10'] = process.argv;
process.env.CANTAP_TEST_PAGE = page;
process.env.CANTAP_TEST_PROGRAM = program;
const { serve } = await import('./served.mjs');
const { newPage, quit } = await import('./browser.mjs');
const PORT = 18_732;
/** One bus at 1 Mbit/s: CANviz opens one channel. */
const bus = (load) => `load=${load},frames=std8,channels=1`;

/** Seconds of a process's threads. */
const processor = (pid) => {
  const fields = readFileSync(`/proc/${pid}/stat`, 'utf8').split(') ')[1].split(' ');
  return (Number(fields[11]) + Number(fields[12])) / 100;
};

/** A virtual device behind a pseudo-terminal, which also speaks slcan. */
async function port(load) {
  const child = spawn(program, ['virtual', bus(load)], { stdio: ['ignore', 'pipe', 'inherit'] });
  const [line] = await new Promise((found) => createInterface({ input: child.stdout }).once('line', (text) => found([text])));
  const name = /\/dev\/\S+/.exec(line)?.[0];
  if (!name) throw new Error(`no port in “${line}”`);
  return { name, stop: () => child.kill() };
}

/** Redraws of the browser within the time, and what `count` says at its begin and end. */
async function watch(tab, pid, count) {
  const [begin, before] = [await tab.evaluate(count), processor(pid)];
  const redraws = await tab.evaluate(
    (ms) =>
      new Promise((done) => {
        const start = performance.now();
        let frames = 0;
        const step = (now) => (frames++, now - start < ms ? requestAnimationFrame(step) : done((frames * 1000) / (now - start)));
        requestAnimationFrame(step);
      }),
    Number(seconds) * 1000,
  );
  const end = await tab.evaluate(count);
  return { redraws, frames: (end.frames - begin.frames) / (end.at - begin.at), used: (processor(pid) - before) / (end.at - begin.at) };
}

async function ours(load) {
  const server = await serve(['-d', `virtual:${bus(load)}`, '-b', '1M', '-c', '1']);
  const tab = await newPage({ url: server.url });
  try {
    await tab.locator('.shell').waitFor();
    await sleep(2000);
    return await watch(tab, server.child.pid, () => ({ frames: Number(document.querySelector('.shell').dataset.received), at: performance.now() / 1000 }));
  } finally {
    await tab.context().close();
    await server.stop();
  }
}

async function theirs(load) {
  const device = await port(load);
  const child = spawn(canviz, ['--interface', 'slcan', '--channel', device.name, '--bitrate', '1000000', '--port', String(PORT), '--no-browser', '--log-level', 'error'], { stdio: ['ignore', 'ignore', 'ignore'] });
  const url = `http://127.0.0.1:${PORT}`;
  try {
    for (let tries = 0; ; tries++) {
      if (tries > 100) throw new Error('CANviz does not answer');
      await sleep(200);
      if (await fetch(`${url}/status`).then((answer) => answer.ok, () => false)) break;
    }
    // What its page is sent, counted where it arrives.
    const before = () => {
      window.framesSeen = 0;
      const Own = WebSocket;
      window.WebSocket = class extends Own {
        constructor(...all) {
          super(...all);
          this.addEventListener('message', ({ data }) => (window.framesSeen += String(data).startsWith('{"type": "frame"') ? 1 : 0));
        }
      };
    };
    const tab = await newPage({ url, before });
    const answer = await fetch(`${url}/connect`, { method: 'POST', headers: { 'content-type': 'application/json' }, body: JSON.stringify({ interface: 'slcan', channel: device.name, bitrate: 1_000_000, index: 0 }) });
    if (!answer.ok) throw new Error(await answer.text());
    await sleep(2000);
    const found = await watch(tab, child.pid, () => ({ frames: window.framesSeen, at: performance.now() / 1000 }));
    await tab.context().close();
    return found;
  } finally {
    child.kill('SIGKILL');
    device.stop();
  }
}

console.log('load  page    frames/s in the page  redraws/s  processor of the server');
for (const load of loads.split(',')) {
  for (const [name, measure] of [['cantap', ours], ['CANviz', theirs]]) {
    const { frames, redraws, used } = await measure(load).catch((error) => ({ error }));
    const cell = (value, digits, width) => (value ?? NaN).toFixed(digits).padStart(width);
    console.log(`${load.padStart(3)} %  ${name}  ${cell(frames, 0, 20)}  ${cell(redraws, 1, 9)}  ${cell((used ?? NaN) * 100, 0, 21)} %`);
  }
}
await quit();
