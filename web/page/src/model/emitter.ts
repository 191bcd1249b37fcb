// Who wants to know of a change subscribes; several changes in one task reach them once, before the next redraw.

export class Emitter<Topic extends string> {
  readonly #listeners = new Map<Topic, Set<() => void>>();
  readonly #pending = new Set<Topic>();

  /** Returns how to stop listening. */
  on(topic: Topic, listener: () => void): () => void {
    let set = this.#listeners.get(topic);
    if (!set) this.#listeners.set(topic, (set = new Set()));
    set.add(listener);
    return () => set.delete(listener);
  }

  emit(topic: Topic): void {
    if (this.#pending.size === 0) queueMicrotask(() => this.#deliver());
    this.#pending.add(topic);
  }

  #deliver(): void {
    const topics = [...this.#pending];
    this.#pending.clear();
    for (const topic of topics) for (const listener of [...(this.#listeners.get(topic) ?? [])]) listener();
  }
}
