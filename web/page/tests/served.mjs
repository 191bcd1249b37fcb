// `cantap ui`, or `cantap serve --web`, for tests, in a folder of its own.

import { spawn, spawnSync } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import { createInterface } from 'node:readline';

const PAGE = process.env.CANTAP_TEST_PAGE;
const PROGRAM = process.env.CANTAP_TEST_PROGRAM;

/** Starts it, and waits for the page's address. */
export async function serve(args, { folder = mkdtempSync(join(tmpdir(), 'cantap-ui-')), command = ['ui', '--no-open'] } = {}) {
  const child = spawn(resolve(PROGRAM), [...command, ...args], { cwd: folder, env: { ...process.env, CANTAP_PAGE: resolve(PAGE) }, stdio: ['ignore', 'pipe', 'pipe'] });
  let errors = '';
  child.stderr.on('data', (text) => (errors += text));
  const ended = new Promise((done) => child.on('close', done));
  const lines = createInterface({ input: child.stdout });
  const urls = [];
  lines.on('line', (line) => /^https?:/.test(line) && urls.push(line));
  const url = await Promise.race([new Promise((found) => lines.on('line', () => urls.length > 0 && found(urls[0]))), ended]);
  if (typeof url !== 'string') throw new Error(`cantap ${command[0]} ended: ${errors}`);
  return {
    url,
    /** All of them, as they are printed. */
    urls,
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

/** The page beside the other listeners of `cantap serve`. */
export const serveShared = (args) => serve(['--unix', 'cantap.sock', '--web', '0', ...args], { command: ['serve'] });

/** The same over TLS, with keys for these clients (`NAME:ROLE`), and a file of permissions. */
export async function serveEncrypted(clients, permissions, args) {
  const folder = mkdtempSync(join(tmpdir(), 'cantap-tls-'));
  const keygen = (...more) => {
    const { status, stderr } = spawnSync(resolve(PROGRAM), ['serve', 'keygen', join(folder, 'keys'), ...more]);
    if (status !== 0) throw new Error(stderr.toString());
  };
  keygen('--host', 'localhost', '--host', '127.0.0.1', ...clients.flatMap((client) => ['--client', client]));
  writeFileSync(join(folder, 'permissions.toml'), permissions);
  const files = ['--tls', 'keys/server.pem,keys/server-key.pem', '--clients', 'keys/ca.pem', '--permissions', 'permissions.toml', '--revoked', 'keys/revoked.pem', '--audit', 'audit.jsonl'];
  // A list there has to be, so somebody is on it.
  keygen('--client', 'nobody:listen');
  keygen('--revoke', 'nobody');
  const server = await serve(['--unix', 'cantap.sock', '--web', 'https://127.0.0.1:0', ...files, ...args], { folder, command: ['serve'] });
  const file = (name) => join(folder, 'keys', `${name}.pem`);
  const keyOf = (name) => ({ cert: readFileSync(file(name)), key: readFileSync(file(`${name}-key`)) });
  return { ...server, keygen, keyOf, file, ca: readFileSync(file('ca')), audit: () => readFileSync(join(folder, 'audit.jsonl'), 'utf8').split('\n').filter(Boolean).map((line) => JSON.parse(line)) };
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
