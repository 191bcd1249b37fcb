// What changes in a periodic frame, as `cantap send` writes it: `counter 7.0:4`, `random 2`, `checksum 1:crc8`, several separated by commas.

import type { Change } from './protocol';

const COUNTER = /^counter (\d+)(?:\.(\d):(\d))?$/;
const RANDOM = /^random (\d+)$/;
const CHECKSUM = /^checksum (\d+):(xor|sum|crc8)$/;

/** Throws with what to write if a part is none of them. */
export function parseChanges(text: string): Change[] {
  return text
    .split(',')
    .map((part) => part.trim().replace(/\s+/g, ' '))
    .filter((part) => part !== '')
    .map((part): Change => {
      const counter = COUNTER.exec(part);
      if (counter) return { counter: { byte: Number(counter[1]), lowBit: Number(counter[2] ?? 0), bits: Number(counter[3] ?? 8) } };
      const random = RANDOM.exec(part);
      if (random) return { random: { byte: Number(random[1]) } };
      const checksum = CHECKSUM.exec(part);
      if (checksum) return { checksum: { byte: Number(checksum[1]), algorithm: checksum[2] as 'xor' | 'sum' | 'crc8' } };
      throw new Error(`“${part}” is no change: write counter 7, counter 7.0:4, random 2 or checksum 1:crc8 (xor, sum), separated by commas.`);
    });
}
