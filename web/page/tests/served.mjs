// `cantap ui` for tests, in a folder of its own.

import { spawn } from 'node:child_process';
import { mkdtempSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import { createInterface } from 'node:readline';

const PAGE = process.env.CANTAP_TEST_PAGE;
const PROGRAM = process.env.CANTAP_TEST_PROGRAM;

/** Starts it, and waits for the page's address. */
export async function serve(args, { folder = mkdtempSync(join(tmpdir(), 'cantap-ui-')) } = {}) {
  const child = spawn(resolve(PROGRAM), ['ui', '--no-open', ...args], { cwd: folder, env: { ...process.env, CANTAP_PAGE: resolve(PAGE) }, stdio: ['ignore', 'pipe', 'pipe'] });
  let errors = '';
  child.stderr.on('data', (text) => (errors += text));
  const ended = new Promise((done) => child.on('close', done));
  const lines = createInterface({ input: child.stdout });
  const url = await Promise.race([new Promise((found) => lines.once('line', found)), ended]);
  if (typeof url !== 'string') throw new Error(`cantap ui ended: ${errors}`);
  return {
    url,
    folder,
    child,
    errors: () => errors,
    /** Its exit code, when it has ended. */
    ended,
    /** Ends it as Ctrl-C does, and waits for it. */
    async stop(signal = 'SIGINT') {
      child.kill(signal);
      const code = await ended;
      rmSync(folder, { recursive: true, force: true });
      return code;
    },
  };
}

/** A virtual device that others reach at a socket, such as one on another machine: `cantap serve`. */
export async function boardAt(socket) {
  const child = spawn(resolve(PROGRAM), ['serve', '-d', 'virtual:car', '--unix', socket], { stdio: ['ignore', 'pipe', 'pipe'] });
  let errors = '';
  const ended = new Promise((done) => child.on('close', done));
  const listens = new Promise((found) => child.stderr.on('data', (text) => (errors += text).includes(socket) && found(true)));
  if ((await Promise.race([listens, ended])) !== true) throw new Error(`cantap serve ended: ${errors}`);
  return {
    async stop() {
      child.kill('SIGINT');
      await ended;
    },
  };
}
