// The page over the tests' engine. What follows `#` in its address sets the trace's length.

import { start } from '../src/start';
import { FakeEngine } from './fake-engine';

const records = Number(/records=(\d+)/.exec(location.hash)?.[1] ?? 20_000);
const engines: FakeEngine[] = [];
Object.assign(globalThis, { fakeEngines: engines });

void start(async () => {
  if (location.hash.includes('no-wasm')) throw new Error('This browser has no WebAssembly: the page cannot read traces in it.');
  const engine = new FakeEngine(records);
  engines.push(engine);
  return engine;
});
