// The engine in a worker: `web/engine` compiled to WebAssembly, which the page carries. How a request and its answer are laid out as bytes
// stands in `web/engine/src/message.rs`. The worker is made from a text in memory, so that the page works when it is opened from a disk.

import type { Answer, Engine, Requests } from './api';

/** What the page and its worker say to each other. */
type ToWorker = { module: WebAssembly.Module } | { number: number; request: string; parameters: unknown };
type FromWorker = { ready: true } | { number: number; answer: unknown } | { number: number; error: string } | { died: string };

/** The engine's functions; see `web/engine/src/abi.rs`. */
interface Exports {
  memory: WebAssembly.Memory;
  cantap_allocate(length: number): number;
  cantap_ask(address: number, length: number): number;
  cantap_free(address: number, length: number): void;
}

/** The worker's own scope, as far as it is used: the types of workers and those of pages exclude each other. */
interface Scope {
  onmessage: ((event: MessageEvent<ToWorker>) => void) | null;
  postMessage(message: FromWorker, transfer: Transferable[]): void;
}

/** The worker's whole program: it becomes a text, so it may use nothing from outside of itself. */
function work(scope: Scope): void {
  const alignment = 8;
  const arrays = { $u8: Uint8Array, $u32: Uint32Array, $f64: Float64Array };
  let engine: Exports;

  const aligned = (length: number): number => Math.ceil(length / alignment) * alignment;

  /** Writes the request into the engine's memory and returns where it is. */
  const write = (request: string, parameters: unknown): [number, number] => {
    const sections: Uint8Array[] = [];
    let offset = 0;
    const text = JSON.stringify({ request, parameters }, (_key, value: unknown) => {
      if (!(value instanceof Uint8Array)) return value;
      const place = [offset, value.byteLength];
      sections.push(value);
      offset = aligned(offset + value.byteLength);
      return { $u8: place };
    });
    const head = new TextEncoder().encode(text);
    const begin = aligned(4 + head.byteLength);
    const length = sections.length > 0 ? begin + offset : 4 + head.byteLength;
    const address = engine.cantap_allocate(length);
    const memory = new Uint8Array(engine.memory.buffer, address, length);
    new DataView(engine.memory.buffer).setUint32(address, head.byteLength, true);
    memory.set(head, 4);
    let at = begin;
    for (const section of sections) {
      memory.set(section, at);
      at = aligned(at + section.byteLength);
    }
    return [address, length];
  };

  /** Reads an answer: its arrays are copies, to be handed over. */
  const read = (address: number, transfer: Transferable[]): { ok?: unknown; error?: string } => {
    const view = new DataView(engine.memory.buffer);
    const length = view.getUint32(address, true);
    const answer = address + 8;
    const headLength = view.getUint32(answer, true);
    const begin = answer + aligned(4 + headLength);
    const text = new TextDecoder().decode(new Uint8Array(engine.memory.buffer, answer + 4, headLength));
    const head: unknown = JSON.parse(text, (_key, value: unknown) => {
      if (typeof value !== 'object' || value === null) return value;
      for (const [name, type] of Object.entries(arrays)) {
        const place = (value as Record<string, unknown>)[name];
        if (Array.isArray(place)) {
          const [offset, elements] = place as [number, number];
          const copy = engine.memory.buffer.slice(begin + offset, begin + offset + elements * type.BYTES_PER_ELEMENT);
          transfer.push(copy);
          return new type(copy);
        }
      }
      return value;
    });
    engine.cantap_free(address, length);
    return head as { ok?: unknown; error?: string };
  };

  scope.onmessage = ({ data }) => {
    if ('module' in data) {
      WebAssembly.instantiate(data.module, {}).then(
        (instance) => {
          engine = instance.exports as unknown as Exports;
          scope.postMessage({ ready: true }, []);
        },
        (error: unknown) => scope.postMessage({ died: String(error) }, []),
      );
      return;
    }
    const { number } = data;
    try {
      const transfer: Transferable[] = [];
      // An address with its highest bit set comes as a negative number.
      const [address, length] = write(data.request, data.parameters);
      const answer = read(engine.cantap_ask(address, length) >>> 0, transfer);
      if (answer.error !== undefined) scope.postMessage({ number, error: answer.error }, []);
      else scope.postMessage({ number, answer: answer.ok }, transfer);
    } catch (error) {
      // Nothing can be asked of it any more: its memory may be in any state.
      scope.postMessage({ died: String(error) }, []);
    }
  };
}

/** The engine has met a fault or has no memory left, and answers no more. */
class EngineDied extends Error {
  override name = 'EngineDied';
}

class WorkerEngine implements Engine {
  private readonly waiting = new Map<number, { resolve: (answer: never) => void; reject: (error: Error) => void }>();
  private numbers = 0;
  private dead: Error | null = null;

  constructor(private readonly worker: Worker) {
    worker.onmessage = ({ data }: MessageEvent<FromWorker>) => this.take(data);
    worker.onerror = (event) => this.die(event.message);
  }

  private take(message: FromWorker): void {
    if ('died' in message) {
      this.die(message.died);
      return;
    }
    if ('ready' in message) return;
    const waiting = this.waiting.get(message.number);
    this.waiting.delete(message.number);
    if ('error' in message) waiting?.reject(new Error(message.error));
    else waiting?.resolve(message.answer as never);
  }

  private die(reason: string): void {
    const text = `the engine has stopped: it met a fault or has no memory left (${reason}). What is shown stays; to go on, start it again, with a smaller part of the trace if it was large`;
    this.dead = new EngineDied(text);
    for (const { reject } of this.waiting.values()) reject(this.dead);
    this.waiting.clear();
    this.worker.terminate();
  }

  ask<K extends keyof Requests>(request: K, parameters: Requests[K]['in']): Promise<Answer<K>> {
    if (this.dead) return Promise.reject(this.dead);
    const number = ++this.numbers;
    return new Promise((resolve, reject) => {
      this.waiting.set(number, { resolve, reject });
      // A copy is handed over: the page may still need its own.
      this.worker.postMessage({ number, request, parameters } satisfies ToWorker);
    });
  }

  close(): void {
    this.dead = new EngineDied('the engine was closed');
    for (const { reject } of this.waiting.values()) reject(this.dead);
    this.waiting.clear();
    this.worker.terminate();
  }
}

/** Bytes that an element of the page carries as base64, unpacked. */
export async function carried(text: string, encoding: string | undefined): Promise<Uint8Array<ArrayBuffer>> {
  const characters = atob(text.trim());
  const bytes = new Uint8Array(characters.length);
  for (let at = 0; at < characters.length; at++) bytes[at] = characters.charCodeAt(at);
  if (encoding !== 'gzip') return bytes;
  if (typeof DecompressionStream === 'undefined') throw new Error('this browser cannot unpack the page; use a current one');
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Starts the engine that the page carries. Its errors can be shown as they are. */
export async function loadEngine(): Promise<Engine> {
  if (typeof WebAssembly === 'undefined' || typeof Worker === 'undefined') {
    throw new Error('this browser runs no WebAssembly in workers, which the page needs; use a current one, or allow it in its settings');
  }
  const element = document.getElementById('cantap-engine');
  if (!element?.textContent) throw new Error('this page was built without its engine; build it with cargo xtask web');
  const module = await WebAssembly.compile(await carried(element.textContent, element.dataset['encoding']));
  const place = URL.createObjectURL(new Blob([`(${work.toString()})(self)`], { type: 'text/javascript' }));
  const worker = new Worker(place);
  try {
    await new Promise<void>((resolve, reject) => {
      worker.onmessage = ({ data }: MessageEvent<FromWorker>) => ('died' in data ? reject(new Error(data.died)) : resolve());
      worker.onerror = (event) => reject(new Error(`the engine's worker did not start: ${event.message}`));
      worker.postMessage({ module } satisfies ToWorker);
    });
  } finally {
    URL.revokeObjectURL(place);
  }
  return new WorkerEngine(worker);
}
