// Dialogs: one element of the platform's kind, which holds the focus and closes on Escape.

import { button, type Child, el } from './dom';

export function openDialog(title: string, body: Child[], actions: { label: string; primary?: boolean; run?: () => void | boolean }[] = [{ label: 'Close' }], cls = ''): HTMLDialogElement {
  const dialog = el('dialog', { class: cls, attrs: { 'aria-label': title } });
  const form = el('form', { attrs: { method: 'dialog' } }, el('h2', {}, title), el('div', { class: 'dialog-body' }, ...body), el('div', { class: 'dialog-actions' }, ...actions.map((a) => button(a.label, () => run(a), { class: a.primary ? 'primary' : '' }))));
  const run = (action: (typeof actions)[number]): void => {
    if (action.run?.() !== false) dialog.close();
  };
  form.addEventListener('submit', (event) => {
    event.preventDefault();
    const primary = actions.find((a) => a.primary) ?? actions[0];
    if (primary) run(primary);
  });
  dialog.append(form);
  dialog.addEventListener('close', () => dialog.remove());
  dialog.addEventListener('click', (event) => {
    if (event.target === dialog) dialog.close();
  });
  document.body.append(dialog);
  dialog.showModal();
  // The focus goes to the first thing that takes it, which may stand at the end of a long text.
  dialog.scrollTop = 0;
  return dialog;
}
