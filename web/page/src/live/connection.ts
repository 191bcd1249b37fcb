// The connection to the page's server: it comes back by itself, goes on after the record that was taken in last, and tells the server how far that is,
// so that a page that is slow is not drowned.

import { Emitter } from '../model/emitter';
import { type FromServer, HEADER, type Requests, type State } from './protocol';
import type { Source, Status } from './source';

/** Milliseconds until the next try: the first, and the longest. */
const RETRY = 500;
const LONGEST_RETRY = 5000;

/** Takes records in: chunks as the server sends them. */
export type Take = (chunks: Uint8Array, anew: boolean) => Promise<void>;

export class Connection extends Emitter<'status' | 'state' | 'progress'> implements Source {
  status: Status = 'connecting';
  /** Why there is no connection, for the user. */
  reason = '';
  state: State | null = null;
  /** Records taken in, and those that the server has. */
  next = 0;
  latest = 0;
  #run = '';
  /** The run whose records were taken in. */
  #takenRun = '';
  #socket: WebSocket | null = null;
  #queue: Uint8Array[] = [];
  #pumping = false;
  #retry = RETRY;
  #timer = 0;
  #numbers = 0;
  /** The number of the latest notice that was shown. */
  #notices = 0;
  readonly #waiting = new Map<number, { resolve: (answer: never) => void; reject: (error: Error) => void }>();

  constructor(
    private readonly take: Take,
    private readonly notify: (level: 'info' | 'warning' | 'error', text: string) => void,
    /** The command that serves the page. */
    readonly command: string,
  ) {
    super();
    // After a sleep, or back in sight, there is no reason to wait for the next try.
    for (const event of ['online', 'pageshow', 'focus'] as const) addEventListener(event, () => this.#hurry());
    document.addEventListener('visibilitychange', () => !document.hidden && this.#hurry());
  }

  connect(): void {
    clearTimeout(this.#timer);
    if (this.#socket) return;
    // What is being taken in counts.
    if (this.#pumping) {
      this.#timer = window.setTimeout(() => this.connect(), 50);
      return;
    }
    this.#set('connecting', this.reason);
    const token = new URLSearchParams(location.search).get('token') ?? '';
    const from = this.#takenRun === '' ? '' : `&run=${this.#takenRun}&after=${this.next}`;
    const socket = new WebSocket(`${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/live?token=${token}${from}`);
    socket.binaryType = 'arraybuffer';
    this.#socket = socket;
    socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
      if (this.#socket !== socket) return;
      if (typeof data === 'string') this.#text(JSON.parse(data) as FromServer);
      else {
        this.#queue.push(new Uint8Array(data));
        void this.#pump();
      }
    };
    socket.onclose = ({ code, reason }) => {
      if (this.#socket === socket) this.#closed(code, reason);
    };
  }

  #text(message: FromServer): void {
    switch (message.type) {
      case 'hello':
        if (message.run !== this.#run) this.#notices = 0;
        this.#run = message.run;
        this.#retry = RETRY;
        this.#set('open', '');
        break;
      case 'state':
        this.state = message;
        this.emit('state');
        break;
      case 'notice':
        // Whoever comes back is sent the latest ones again.
        if (message.number !== null) {
          if (message.number <= this.#notices) break;
          this.#notices = message.number;
        }
        this.notify(message.level, message.text);
        break;
      case 'answer': {
        const waiting = this.#waiting.get(message.number);
        this.#waiting.delete(message.number);
        if (message.error !== undefined) waiting?.reject(new Error(message.error));
        else waiting?.resolve(message.ok as never);
      }
    }
  }

  /** Nothing more can be taken in: what is shown stays as it is, instead of going on with records missing. */
  #stop(reason: string): void {
    const socket = this.#socket;
    this.#forgetSocket();
    socket?.close();
    this.#set('ended', reason);
    this.notify('error', reason);
  }

  #forgetSocket(): void {
    this.#socket = null;
    // What the server has sent and was not taken in comes again.
    this.#queue = [];
    for (const { reject } of this.#waiting.values()) reject(new Error('The connection was lost before the answer; look whether it was done.'));
    this.#waiting.clear();
  }

  #closed(code: number, reason: string): void {
    this.#forgetSocket();
    if (code === 1001) {
      this.#set('ended', `${this.command} has ended. What was received stays here; start it again for more.`);
      return;
    }
    this.#set('lost', reason === '' ? `The connection to ${this.command} is lost; it is tried again.` : `${this.command} refuses: ${reason}. It is tried again.`);
    this.#timer = window.setTimeout(() => this.connect(), this.#retry);
    this.#retry = Math.min(this.#retry * 2, LONGEST_RETRY);
  }

  /** Begins anew with what the server still has: the engine has lost what it had. */
  again(): void {
    this.#takenRun = '';
    this.next = 0;
    this.#retry = RETRY;
    if (this.#socket) this.#socket.close();
    else this.connect();
  }

  #hurry(): void {
    if (this.status === 'lost') this.connect();
  }

  #set(status: Status, reason: string): void {
    this.status = status;
    this.reason = reason;
    this.emit('status');
  }

  /** Takes in what has arrived, all of it at once, and then what has arrived meanwhile. */
  async #pump(): Promise<void> {
    if (this.#pumping) return;
    this.#pumping = true;
    while (this.#queue.length > 0) {
      const messages = this.#queue;
      const socket = this.#socket;
      const run = this.#run;
      this.#queue = [];
      const anew = run !== this.#takenRun;
      try {
        const { next, latest } = numbers(messages);
        await this.take(joined(messages), anew);
        this.next = next;
        this.latest = latest;
      } catch (error) {
        this.#pumping = false;
        this.#stop(error instanceof Error ? error.message : String(error));
        return;
      }
      this.#takenRun = run;
      if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ received: this.next }));
      this.emit('progress');
    }
    this.#pumping = false;
  }

  /** Asks the server. Its refusals can be shown as they are. */
  ask<K extends keyof Requests>(request: K, parameters: Requests[K]['in']): Promise<Requests[K]['out']> {
    const socket = this.#socket;
    if (!socket || socket.readyState !== WebSocket.OPEN) return Promise.reject(new Error(`There is no connection to ${this.command}; wait until it is back.`));
    const number = ++this.#numbers;
    return new Promise((resolve, reject) => {
      this.#waiting.set(number, { resolve, reject });
      socket.send(JSON.stringify({ number, request, parameters }));
    });
  }
}

/** Those of the last message; all have some. */
function numbers(messages: readonly Uint8Array[]): { next: number; latest: number } {
  if (messages.some((m) => m.length < HEADER)) throw new Error('What came from the server is damaged; load the page anew');
  const message = messages[messages.length - 1] as Uint8Array;
  const view = new DataView(message.buffer, message.byteOffset, HEADER);
  return { next: Number(view.getBigUint64(8, true)), latest: Number(view.getBigUint64(16, true)) };
}

/** The records of messages, without their headers. */
function joined(messages: readonly Uint8Array[]): Uint8Array {
  const all = new Uint8Array(messages.reduce((sum, m) => sum + m.length - HEADER, 0));
  let at = 0;
  for (const message of messages) {
    all.set(message.subarray(HEADER), at);
    at += message.length - HEADER;
  }
  return all;
}
