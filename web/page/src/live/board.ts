// A board on a serial port of this browser. The page only carries bytes: what they mean, and what is asked of the board, is the engine's
// business (`web/engine/src/board.rs`), which opens channels to listen and in no other way.

import type { BoardState, Summary } from '../api';
import { Emitter } from '../model/emitter';
import type { App } from '../model/app';
import type { SerialPort } from './serial';
import type { Source, Status } from './source';

/** CDC-ACM has no line speed; the number only has to be valid. */
const NOMINAL_BAUD = 115_200;
/** Bytes that the browser keeps while the page is busy: seconds of two saturated buses. */
const BUFFER = 4 << 20;
/** Milliseconds between two looks at how long the board has not answered. */
const TICK = 50;
/** Milliseconds after which a write or a close that does not end is given up: a port may hang. */
const PATIENCE = 2000;

export type Bitrates = [number | null, number | null];

interface Piece {
  bytes: Uint8Array;
  at: number;
}

export class Board extends Emitter<'status' | 'state' | 'progress'> implements Source {
  status: Status = 'ended';
  reason = '';
  readonly state = null;
  next = 0;
  latest = 0;
  board: BoardState | null = null;
  /** Records have come that were not saved. */
  isUnsaved = false;
  bitrates: Bitrates = [null, null];
  /** The port that was opened last. */
  port: SerialPort | null = null;
  #port: SerialPort | null = null;
  #reader: ReadableStreamDefaultReader<Uint8Array> | null = null;
  #writer: WritableStreamDefaultWriter<Uint8Array> | null = null;
  #queue: Piece[] = [];
  /** What the port said when it went. */
  #gone: string | null = null;
  #stops = false;
  #pumping = false;
  #timer = 0;
  #since = 0;
  #closed: Promise<void> = Promise.resolve();

  constructor(private readonly app: App) {
    super();
    addEventListener('beforeunload', (event) => {
      if (this.isOpen || this.isUnsaved) event.preventDefault();
    });
  }

  /** A session is under way. */
  get isOpen(): boolean {
    return this.status === 'connecting' || this.status === 'open';
  }

  /** The engine was started anew, and has no session. */
  again(): void {
    void this.#close('The engine was started again: open the board again.', 'lost');
    this.isUnsaved = false;
    void this.app.begin(traceName()).catch((error: unknown) => this.app.failed(error));
  }

  /** Opens a port and begins a session: in a new trace, or `again` in the one that is shown. */
  async open(port: SerialPort, bitrates: Bitrates, again: boolean): Promise<void> {
    if (this.isOpen) throw new Error('A board is open; close it first.');
    await this.#closed;
    this.#set('connecting', '');
    this.bitrates = bitrates;
    this.board = null;
    try {
      await port.open({ baudRate: NOMINAL_BAUD, bufferSize: BUFFER });
      // The board has a session only while the port is open, which it sees by this line. A port without the line is open already.
      await port.setSignals?.({ dataTerminalReady: true }).catch(() => undefined);
    } catch (error) {
      this.#set('ended', 'The board is not open.');
      await port.close().catch(() => undefined);
      throw new Error(`The port cannot be opened: ${text(error)} Close other programs and pages that have it; on Linux, you must be in the group that owns it (usually dialout).`);
    }
    this.#port = this.port = port;
    this.#gone = null;
    this.#stops = false;
    this.#queue = [];
    this.#since = Date.now() - performance.now();
    try {
      const { readable, writable } = port;
      if (!readable || !writable) throw new Error('The port carries no bytes; unplug the board and plug it in again.');
      this.#reader = readable.getReader();
      this.#writer = writable.getWriter();
      if (!again) {
        this.app.beginLive();
        this.next = this.latest = 0;
      }
      this.app.live = this;
      const answer = await this.app.ask('boardOpen', { name: traceName(), bitrates, now: this.#now(), again });
      if (!again) this.isUnsaved = false;
      await this.#take(answer, !again);
    } catch (error) {
      await this.#close('', 'ended');
      throw error;
    }
    void this.#read(this.#reader);
    this.#timer = window.setInterval(() => void this.#pump(), TICK);
  }

  /** Closes the channels, takes what they still captured, and closes the port. */
  async stop(): Promise<void> {
    if (!this.isOpen) return this.#closed;
    this.#stops = true;
    void this.#pump();
    await new Promise<void>((done) => {
      const off = this.on('status', () => {
        if (this.isOpen) return;
        off();
        done();
      });
    });
    await this.#closed;
  }

  /** All of it was saved. */
  saved(): void {
    if (!this.isOpen) this.isUnsaved = false;
  }

  #now(): number {
    return this.#since + performance.now();
  }

  async #read(reader: ReadableStreamDefaultReader<Uint8Array>): Promise<void> {
    let gone = 'the port was closed';
    try {
      for (;;) {
        const { value, done } = await reader.read();
        if (done) break;
        this.#queue.push({ bytes: value, at: this.#now() });
        void this.#pump();
      }
    } catch (error) {
      gone = text(error).replace(/\.$/, '');
    }
    // It may have been closed here, and another one opened since.
    if (this.#reader !== reader) return;
    this.#gone = gone;
    void this.#pump();
  }

  /** Hands the engine what has arrived, and writes what it answers; then again, what has arrived meanwhile. */
  async #pump(): Promise<void> {
    if (this.#pumping || !this.isOpen || !this.#writer) return;
    this.#pumping = true;
    try {
      do {
        const pieces = this.#queue;
        this.#queue = [];
        await this.#take(await this.app.ask('boardTake', { pieces, now: this.#now() }), false);
        if (this.#stops && this.board?.stage !== 'over') {
          this.#stops = false;
          await this.#take(await this.app.ask('boardStop', {}), false);
        }
        // Only what came before it went counts.
        if (this.#gone !== null && this.#queue.length === 0 && this.isOpen) {
          await this.#take(await this.app.ask('boardVanished', { reason: this.#gone }), false);
        }
      } while (this.#queue.length > 0 && this.isOpen);
    } catch (error) {
      // The engine has stopped, or refuses: nothing more can be taken in.
      await this.#close(text(error), 'lost');
      this.app.failed(error);
    } finally {
      this.#pumping = false;
    }
  }

  async #take({ board, summary }: { board: BoardState; summary: Summary }, anew: boolean): Promise<void> {
    const came = summary.records + summary.forgotten - this.next;
    this.next = this.latest = summary.records + summary.forgotten;
    if (came > 0) this.isUnsaved = true;
    const before = this.board?.stage;
    this.board = board;
    await this.#write(board.write);
    this.app.taken(summary, anew);
    if (board.stage === 'over') await this.#over(board);
    else if (board.stage === 'listening' && before !== 'listening') this.#set('open', '');
    this.emit('state');
    this.emit('progress');
  }

  async #over(board: BoardState): Promise<void> {
    if (board.error === null) return this.#close('The board is closed. What was received stays here.', 'ended');
    const reason = `${board.error.charAt(0).toUpperCase()}${board.error.slice(1)}.`;
    await this.#close(`${reason} What was received stays here.`, 'lost');
    this.app.notify('error', this.next > 0 ? this.reason : reason);
  }

  /** A port whose board has gone may neither take nor refuse: what is not taken in time is left. */
  async #write(bytes: Uint8Array): Promise<void> {
    if (bytes.length === 0 || !this.#writer || this.#gone !== null) return;
    // The reading side says why, if it fails.
    await inTime(this.#writer.write(bytes).catch(() => undefined));
  }

  #close(reason: string, status: Status): Promise<void> {
    clearInterval(this.#timer);
    const [port, reader, writer] = [this.#port, this.#reader, this.#writer];
    this.#port = this.#reader = this.#writer = null;
    const close = async (): Promise<void> => {
      await inTime((reader?.cancel() ?? Promise.resolve()).catch(() => undefined));
      reader?.releaseLock();
      await inTime((writer?.close() ?? Promise.resolve()).catch(() => undefined));
      try {
        writer?.releaseLock();
      } catch {
        // A writer that hangs keeps its lock; the port goes with the page.
      }
      await inTime((port?.close() ?? Promise.resolve()).catch(() => undefined));
    };
    this.#closed = close();
    this.#set(status, reason);
    return Promise.resolve();
  }

  #set(status: Status, reason: string): void {
    this.status = status;
    this.reason = reason;
    this.emit('status');
  }
}

function inTime(promise: Promise<void>): Promise<void> {
  return Promise.race([promise, new Promise<void>((done) => setTimeout(done, PATIENCE))]);
}

function text(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}

/** By the time, as recordings of `cantap ui` are named. */
function traceName(): string {
  const now = new Date();
  const two = (n: number): string => String(n).padStart(2, '0');
  return `cantap-${now.getFullYear()}${two(now.getMonth() + 1)}${two(now.getDate())}-${two(now.getHours())}${two(now.getMinutes())}${two(now.getSeconds())}`;
}
