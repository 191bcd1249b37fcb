// What repeats by itself while a trace grows takes a tenth of the time at most: a view must not keep the engine from taking records in.

/** How many times as long as it took is waited before the next time. */
const REST = 10;

export class Spacing {
  #next = 0;
  #timer = 0;
  #busy = false;
  #wanted: (() => void) | null = null;

  /** `least`: milliseconds between the end of one time and the next, however short it was. */
  constructor(private readonly least = 0) {}

  /** Does it now, or when it is due; of several only the last one. */
  ask(act: () => void): void {
    this.#wanted = act;
    this.#plan();
  }

  #plan(): void {
    if (this.#busy || this.#timer !== 0 || !this.#wanted) return;
    const wait = this.#next - performance.now();
    if (wait > 0) {
      this.#timer = window.setTimeout(() => {
        this.#timer = 0;
        this.#plan();
      }, wait);
      return;
    }
    const act = this.#wanted;
    this.#wanted = null;
    act();
  }

  /** The work itself, whoever asks for it. */
  async run(work: () => Promise<void>): Promise<void> {
    const begin = performance.now();
    this.#busy = true;
    try {
      await work();
    } finally {
      this.#busy = false;
      const end = performance.now();
      this.#next = end + Math.max(this.least, REST * (end - begin));
      this.#plan();
    }
  }
}
