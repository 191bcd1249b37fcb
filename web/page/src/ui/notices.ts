// Errors and warnings: they stay until they are closed, since nobody reads a message that vanishes. Equal ones are shown once, with a count.

import { button, el, setText } from './dom';
import type { Notify } from '../model/app';

const SHOWN = 6;

export class Notices {
  readonly element = el('div', { class: 'notices', attrs: { role: 'region', 'aria-label': 'Messages', 'aria-live': 'polite' } });
  readonly #known = new Map<string, { box: HTMLElement; times: HTMLElement; count: number }>();

  readonly notify: Notify = (level, text, action) => {
    const known = this.#known.get(text);
    if (known) {
      known.count++;
      setText(known.times, `×${known.count}`);
      return;
    }
    const times = el('span', { class: 'times' });
    const close = (): void => {
      box.remove();
      this.#known.delete(text);
    };
    const box = el(
      'div',
      { class: `notice ${level}`, attrs: { role: level === 'error' ? 'alert' : 'status' } },
      el('span', { class: 'notice-text' }, text),
      times,
      action
        ? button(action.label, () => {
            close();
            action.run();
          })
        : null,
      button('×', close, { class: 'icon', attrs: { 'aria-label': 'Close this message' } }),
    );
    this.#known.set(text, { box, times, count: 1 });
    this.element.append(box);
    const first = this.#known.entries().next().value;
    if (this.#known.size > SHOWN && first) {
      first[1].box.remove();
      this.#known.delete(first[0]);
    }
    if (level === 'info') setTimeout(close, 8000);
  };
}
