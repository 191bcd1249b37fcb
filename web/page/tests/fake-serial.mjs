// A stand-in for `navigator.serial`: its ports carry bytes to and from the test, which has a virtual board's terminal at the other end, or lies.

import { spawn } from 'node:child_process';
import { closeSync, existsSync, openSync, write } from 'node:fs';
import { dirname, join, resolve } from 'node:path';
import { createInterface } from 'node:readline';
import { ReadStream } from 'node:tty';
import { newPage } from './browser.mjs';

/** In the page. Bytes are carried as base64. */
function install() {
  const bytesOf = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  class Port extends EventTarget {
    readable = null;
    writable = null;
    async open(options) {
      if (this.readable) throw new DOMException('The port is already open.', 'InvalidStateError');
      window.serialLog.opened.push(options);
      const refused = await window.serialOpen();
      if (refused) throw new DOMException(refused, 'NetworkError');
      this.readable = new ReadableStream({
        async pull(controller) {
          const { bytes, gone } = await window.serialRead();
          if (gone) controller.error(new DOMException(gone, 'NetworkError'));
          else if (bytes === null) controller.close();
          else controller.enqueue(bytesOf(bytes));
        },
        cancel: () => window.serialClose(),
      });
      this.writable = new WritableStream({
        write: (chunk) => window.serialWrite(btoa(String.fromCharCode(...chunk))),
      });
    }
    async setSignals(signals) {
      window.serialLog.signals.push(signals);
    }
    async close() {
      if (this.readable?.locked || this.writable?.locked) throw new TypeError('Cannot close a locked port');
      this.readable = this.writable = null;
      await window.serialClose();
      window.serialLog.closed++;
    }
  }
  window.serialLog = { asked: [], opened: [], signals: [], closed: 0 };
  const port = new Port();
  Object.defineProperty(navigator, 'serial', {
    value: {
      async requestPort(options) {
        window.serialLog.asked.push(options);
        if (!navigator.userActivation.isActive) throw new DOMException('Must be handling a user gesture.', 'SecurityError');
        if (window.serialCancelled) throw new DOMException('No port selected by the user.', 'NotFoundError');
        return port;
      },
    },
  });
}

/** The other end of a port. `board` has `open(onBytes)`, `write(bytes)` and `close()`; `mangle` may change what comes, or drop it. */
export class Line {
  mangle = (bytes) => bytes;
  refuses = null;
  #pieces = [];
  #wake = null;
  #gone = null;
  #closed = false;

  constructor(board) {
    this.board = board;
  }

  /** A page with this line behind its port. */
  async page(file, before) {
    const page = await newPage({ file, url: 'about:blank' });
    await page.exposeFunction('serialOpen', () => this.open());
    await page.exposeFunction('serialRead', () => this.read());
    await page.exposeFunction('serialWrite', (text) => this.board.write(Buffer.from(text, 'base64')));
    await page.exposeFunction('serialClose', () => this.close());
    await page.addInitScript(install);
    if (before) await page.addInitScript(before);
    page.faults.length = 0;
    await page.goto(`file://${resolve(file)}`);
    return page;
  }

  open() {
    if (this.refuses) return this.refuses;
    this.#pieces = [];
    this.#gone = null;
    this.#closed = false;
    this.board.open((bytes) => {
      const passed = this.mangle(bytes);
      if (passed?.length > 0) this.#pieces.push(passed);
      this.#wake?.();
    });
    return null;
  }

  async read() {
    while (this.#pieces.length === 0 && !this.#closed && this.#gone === null) await new Promise((wake) => (this.#wake = wake));
    if (this.#pieces.length > 0) {
      const bytes = Buffer.concat(this.#pieces).toString('base64');
      this.#pieces = [];
      return { bytes };
    }
    return this.#gone === null ? { bytes: null } : { gone: this.#gone };
  }

  close() {
    this.#closed = true;
    this.board.close();
    this.#wake?.();
  }

  /** The cable is pulled. */
  unplug() {
    this.#gone = 'The device has been lost.';
    this.board.close();
    this.#wake?.();
  }
}

/** `cantap virtual`: the firmware's library behind a terminal. */
export function virtualBoard(options) {
  return behindTerminal(process.env.CANTAP_TEST_PROGRAM, ['virtual', options]);
}

/** Where the emulator and the firmware are after `cargo xtask firmware`; null without them. */
export function emulator() {
  const folder = dirname(resolve(process.env.CANTAP_TEST_PROGRAM ?? ''));
  const found = { program: join(folder, 'cantap-sim'), firmware: join(folder, '../firmware/cantap-olimex-p405.elf') };
  return existsSync(found.program) && existsSync(found.firmware) ? found : null;
}

/** The emulated board behind a terminal, both buses with this load in per cent. */
export function emulatedBoard({ program, firmware }, load) {
  return behindTerminal(program, ['run', firmware, '--pty', '--load', String(load)]);
}

/** A board that a program serves on a terminal, whose name is its first line. */
async function behindTerminal(program, args) {
  const child = spawn(resolve(program), args, { stdio: ['ignore', 'pipe', 'ignore'] });
  const ended = new Promise((done) => child.on('close', done));
  const path = await Promise.race([new Promise((found) => createInterface({ input: child.stdout }).once('line', found)), ended]);
  if (typeof path !== 'string') throw new Error(`${program} ${args.join(' ')} has ended`);
  let output = null;
  let input = null;
  return {
    open(onBytes) {
      output = openSync(path, 'r+');
      input = new ReadStream(openSync(path, 'r+'));
      input.on('data', onBytes);
      input.on('error', () => undefined);
    },
    write: (bytes) => output !== null && new Promise((done) => write(output, bytes, () => done())),
    close() {
      if (output !== null) closeSync(output);
      input?.destroy();
      output = input = null;
    },
    async stop() {
      this.close();
      child.kill('SIGINT');
      await ended;
    },
  };
}

/** A board that answers whatever it is asked with the same bytes, or with nothing. */
export function scriptedBoard(answer = null) {
  let send = null;
  return {
    written: [],
    open: (onBytes) => (send = onBytes),
    write(bytes) {
      this.written.push(bytes);
      if (answer) send?.(answer);
    },
    close: () => (send = null),
    stop: async () => undefined,
  };
}

/** A message as it goes over the wire: with its CRC-32, in COBS, and a zero (wire/src/framing.rs). */
export function sealed(message) {
  let crc = 0xffff_ffff;
  for (const byte of message) {
    crc ^= byte;
    for (let i = 0; i < 8; i++) crc = crc & 1 ? (crc >>> 1) ^ 0xedb8_8320 : crc >>> 1;
  }
  crc = (crc ^ 0xffff_ffff) >>> 0;
  const all = [...message, crc & 255, (crc >>> 8) & 255, (crc >>> 16) & 255, crc >>> 24];
  const out = [];
  let run = [];
  for (const byte of [...all, 0]) {
    if (byte === 0) {
      out.push(run.length + 1, ...run);
      run = [];
    } else run.push(byte);
  }
  return Buffer.from([...out, 0]);
}
