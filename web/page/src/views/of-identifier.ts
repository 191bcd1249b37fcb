// What the views about one identifier share: the choice of it, and asking again, while they are in sight, when the choice or the trace changes.

import type { App } from '../model/app';
import { Latest } from '../model/latest';
import type { Command } from '../ui/commands';
import { button } from '../ui/dom';
import { IdentifierPicker } from '../ui/identifier-picker';

export class OfIdentifier {
  readonly picker: IdentifierPicker;
  /** For a view's bar. */
  readonly controls: HTMLElement[];
  readonly #asking: Latest<null>;
  #visible = false;

  constructor(
    private readonly app: App,
    fetch: () => Promise<void>,
  ) {
    this.picker = new IdentifierPicker(app);
    this.controls = [
      button('↑', () => this.picker.step(-1), { attrs: { 'aria-label': 'Previous identifier' } }),
      button('↓', () => this.picker.step(1), { attrs: { 'aria-label': 'Next identifier' } }),
      this.picker.element,
    ];
    this.#asking = new Latest(fetch, (error) => app.failed(error));
    app.on('identifier', () => this.ask());
    app.on('steady', () => {
      if (this.#visible) this.picker.keepUp();
      this.ask();
    });
  }

  /** The commands that go from one identifier to another, for a view of this name. */
  commands(view: string, title: string): Command[] {
    return [
      { id: `${view}.next`, title: `${title}: next identifier`, keys: ['n'], view, run: () => this.picker.step(1) },
      { id: `${view}.previous`, title: `${title}: previous identifier`, keys: ['p'], view, run: () => this.picker.step(-1) },
    ];
  }

  shown(): void {
    this.#visible = true;
    this.picker.refresh();
    this.ask();
  }

  hidden(): void {
    this.#visible = false;
  }

  ask(): void {
    if (this.#visible && this.app.identifier) this.#asking.ask(null);
  }
}
