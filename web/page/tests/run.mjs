// Builds the page over the tests' engine and runs all tests in Chromium.
//   node tests/run.mjs            the views, over the tests' engine
//   node tests/run.mjs --page X   and the page X as it is delivered, over its own engine
//   … --page X --program cantap   and that page served live by the command
// CHROMIUM names another browser than /usr/bin/chromium.

import { spawnSync } from 'node:child_process';
import { dirname, join } from 'node:path';
import { fileURLToPath } from 'node:url';
import { buildPage } from '../build.mjs';

const here = dirname(fileURLToPath(import.meta.url));
const value = (name) => {
  const at = process.argv.indexOf(name);
  return at < 0 ? undefined : process.argv[at + 1];
};
const page = value('--page');
const program = value('--program');

await buildPage({ entry: join(here, 'fake-main.ts'), out: join(here, '../dist/fake.html') });
const files = ['numbers', 'trace', 'graphs', 'bits', 'views', 'errors', 'report', 'access', 'touch', ...(page ? ['engine', 'delivered'] : []), ...(page && program ? ['truth', 'board', 'live', 'sleep', 'live-attack', 'serve-web', 'serve-tls', 'firefox'] : [])].map((name) => join(here, `${name}.test.mjs`));
const { status } = spawnSync(process.execPath, ['--test', '--test-concurrency=1', ...files], { stdio: 'inherit', env: { ...process.env, ...(page ? { CANTAP_TEST_PAGE: page } : {}), ...(program ? { CANTAP_TEST_PROGRAM: program } : {}) } });
process.exit(status ?? 1);
