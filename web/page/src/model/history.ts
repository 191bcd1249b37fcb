// Undo and redo of one value: the zoom of the graphs, the text of the user's own database.

export class History<T> {
  readonly #past: T[] = [];
  readonly #future: T[] = [];
  #current: T;

  constructor(
    first: T,
    private readonly limit = 200,
  ) {
    this.#current = first;
  }

  get current(): T {
    return this.#current;
  }

  get canUndo(): boolean {
    return this.#past.length > 0;
  }

  get canRedo(): boolean {
    return this.#future.length > 0;
  }

  push(value: T): void {
    this.#past.push(this.#current);
    if (this.#past.length > this.limit) this.#past.shift();
    this.#future.length = 0;
    this.#current = value;
  }

  /** Changes the value without a step of its own: what a drag passes through. */
  amend(value: T): void {
    this.#current = value;
  }

  undo(): T | null {
    const previous = this.#past.pop();
    if (previous === undefined) return null;
    this.#future.push(this.#current);
    this.#current = previous;
    return previous;
  }

  redo(): T | null {
    const next = this.#future.pop();
    if (next === undefined) return null;
    this.#past.push(this.#current);
    this.#current = next;
    return next;
  }
}
