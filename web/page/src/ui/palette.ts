// The command palette: type a part of a command's, a message's or a signal's name, and choose.

import { el, replace } from './dom';
import { type Command, keyLabel } from './commands';

/** How well a text answers what was typed: all its pieces must occur; earlier and at a word's start is better. Null if it does not. */
export function match(query: string, text: string): number | null {
  const lower = text.toLowerCase();
  let score = 0;
  for (const piece of query.toLowerCase().split(/\s+/).filter(Boolean)) {
    const at = lower.indexOf(piece);
    if (at < 0) return null;
    score += at + (at === 0 || /[^a-z0-9]/.test(lower[at - 1] ?? '') ? 0 : 20);
  }
  return score + text.length / 100;
}

export function openPalette(commands: Command[]): void {
  const input = el('input', { attrs: { type: 'text', role: 'combobox', 'aria-label': 'Command', 'aria-expanded': 'true', 'aria-controls': 'palette-list', 'aria-autocomplete': 'list', placeholder: 'Command, message, signal, time …', autocomplete: 'off', spellcheck: 'false' } });
  const list = el('ul', { id: 'palette-list', attrs: { role: 'listbox', 'aria-label': 'Commands' } });
  const dialog = el('dialog', { class: 'palette', attrs: { 'aria-label': 'Command palette' } }, input, list);
  let found: Command[] = [];
  let at = 0;

  const show = (): void => {
    replace(
      list,
      ...found.map((command, i) => {
        const item = el('li', { id: `palette-${i}`, attrs: { role: 'option', 'aria-selected': String(i === at) } }, el('span', {}, command.title), command.keys?.[0] ? el('kbd', {}, keyLabel(command.keys[0])) : null);
        item.addEventListener('click', () => choose(i));
        return item;
      }),
    );
    if (found.length > 0) input.setAttribute('aria-activedescendant', `palette-${at}`);
    else input.removeAttribute('aria-activedescendant');
    list.children[at]?.scrollIntoView({ block: 'nearest' });
  };
  const search = (): void => {
    found = commands
      .map((command) => ({ command, score: match(input.value, command.title) }))
      .filter((x): x is { command: Command; score: number } => x.score !== null)
      .sort((a, b) => (input.value.trim() === '' ? 0 : a.score - b.score))
      .slice(0, 50)
      .map((x) => x.command);
    at = 0;
    show();
  };
  const choose = (i: number): void => {
    const command = found[i];
    dialog.close();
    command?.run();
  };

  input.addEventListener('input', search);
  input.addEventListener('keydown', (event) => {
    if (event.key === 'ArrowDown') at = Math.min(found.length - 1, at + 1);
    else if (event.key === 'ArrowUp') at = Math.max(0, at - 1);
    else if (event.key === 'Enter') {
      event.preventDefault();
      choose(at);
      return;
    } else return;
    event.preventDefault();
    show();
  });
  dialog.addEventListener('close', () => dialog.remove());
  dialog.addEventListener('click', (event) => {
    if (event.target === dialog) dialog.close();
  });
  document.body.append(dialog);
  dialog.showModal();
  search();
}
