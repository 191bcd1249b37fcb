// Builds the page: one HTML file with style, script and engine inside.
//   node build.mjs [--engine FILE.wasm] [--licences FILE.txt] [--entry FILE.ts] --out FILE.html
// The policy allows exactly this script and this style, by their hashes, and no connection at all.

import { createHash } from 'node:crypto';
import { mkdirSync, readFileSync, writeFileSync } from 'node:fs';
import { dirname, join, resolve } from 'node:path';
import { fileURLToPath } from 'node:url';
import { gzipSync } from 'node:zlib';
import { build } from 'esbuild';

const here = dirname(fileURLToPath(import.meta.url));

export async function buildPage({ engine, licences, entry = join(here, 'src/main.ts'), out }) {
  const options = { bundle: true, minify: true, write: false, legalComments: 'inline', logLevel: 'warning' };
  const script = (await build({ ...options, entryPoints: [entry], format: 'iife', target: ['chrome110', 'firefox115', 'safari16.4'] })).outputFiles[0].text;
  const style = (await build({ ...options, entryPoints: [join(here, 'src/style.css')] })).outputFiles[0].text;
  // Within an element of the page, neither may end it.
  const safeScript = script.replaceAll('</script', '<\\/script').replaceAll('<!--', '<\\!--').trim();
  const safeStyle = style.trim();
  if (/<\/style/i.test(safeStyle)) throw new Error('the style sheet would end its own element');
  const hash = (text) => `'sha256-${createHash('sha256').update(text).digest('base64')}'`;
  const policy = [
    "default-src 'none'",
    // 'wasm-unsafe-eval' allows to compile WebAssembly, and no JavaScript from text.
    `script-src ${hash(safeScript)} 'wasm-unsafe-eval'`,
    `style-src ${hash(safeStyle)}`,
    'worker-src blob:',
    'img-src data: blob:',
    "base-uri 'none'",
    "form-action 'none'",
  ].join('; ');
  // The page's own script has no code of others; the licences are those of the engine's crates.
  const packed = [
    ['cantap-engine', engine],
    ['cantap-licences', licences],
  ].map(([id, file]) => (file ? `<script type="application/octet-stream" id="${id}" data-encoding="gzip">${gzipSync(readFileSync(file), { level: 9 }).toString('base64')}</script>` : '')).join('');
  const parts = { '<!--csp-->': policy, '<!--style-->': safeStyle, '<!--cantap-engine-->': packed, '<!--script-->': safeScript };
  let page = readFileSync(join(here, 'src/index.html'), 'utf8');
  for (const [mark, text] of Object.entries(parts)) {
    if (page.split(mark).length !== 2) throw new Error(`index.html must have ${mark} once`);
    page = page.replace(mark, () => text);
  }
  mkdirSync(dirname(resolve(out)), { recursive: true });
  writeFileSync(out, page);
  return page.length;
}

if (process.argv[1] && resolve(process.argv[1]) === fileURLToPath(import.meta.url)) {
  const value = (name) => {
    const at = process.argv.indexOf(name);
    return at < 0 ? undefined : process.argv[at + 1];
  };
  const out = value('--out');
  if (!out) {
    console.error('usage: node build.mjs [--engine FILE.wasm] [--licences FILE.txt] [--entry FILE.ts] --out FILE.html');
    process.exit(2);
  }
  const size = await buildPage({ engine: value('--engine'), licences: value('--licences'), out, ...(value('--entry') ? { entry: value('--entry') } : {}) });
  console.log(`${out}: ${size} bytes`);
}
