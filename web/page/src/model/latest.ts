// One request at a time, and of those that pile up meanwhile only the newest: what a scrolled or dragged view asks of the engine.

export class Latest<In> {
  #running = false;
  #next: { value: In } | null = null;

  constructor(
    private readonly run: (value: In) => Promise<void>,
    private readonly failed: (error: unknown) => void,
  ) {}

  /** True while an answer is awaited. */
  get busy(): boolean {
    return this.#running;
  }

  ask(value: In): void {
    this.#next = { value };
    if (!this.#running) void this.#loop();
  }

  async #loop(): Promise<void> {
    this.#running = true;
    while (this.#next) {
      const { value } = this.#next;
      this.#next = null;
      try {
        await this.run(value);
      } catch (error) {
        this.failed(error);
      }
    }
    this.#running = false;
  }
}
