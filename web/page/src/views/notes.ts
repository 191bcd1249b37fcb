// Notes and bookmarks: a text at a time, or about the whole trace.

import type { App, Note } from '../model/app';
import { save } from '../model/files';
import { parseTime, seconds } from '../model/format';
import type { Commands } from '../ui/commands';
import { openDialog } from '../ui/dialog';
import { button, el, field, replace } from '../ui/dom';
import type { View } from './view';

export class NotesView implements View {
  readonly id = 'notes';
  readonly title = 'Notes';
  readonly element: HTMLElement;
  readonly #list = el('ol', { class: 'notes' });

  constructor(
    private readonly app: App,
    commands: Commands,
    private readonly lead: (view: string) => void,
  ) {
    this.element = el(
      'section',
      { class: 'view view-notes', attrs: { 'aria-label': 'Notes', tabindex: 0 } },
      el('div', { class: 'bar' }, button('Add a note', () => this.add(), { title: 'Add a note at cursor A (Ctrl+B)' }), button('Save as text', () => this.#save())),
      this.#list,
    );
    app.on('notes', () => this.#draw());
    commands.add({ id: 'notes.add', title: 'Add a note or bookmark at cursor A', keys: ['Ctrl+b'], run: () => this.add() });
  }

  shown(): void {
    this.#draw();
  }

  add(): void {
    const time = el('input', { class: 'mono', attrs: { type: 'text', 'aria-label': 'Time', value: this.app.cursorA === null ? '' : seconds(this.app.cursorA) } });
    const text = el('textarea', { attrs: { rows: 4, 'aria-label': 'Note' } });
    const problem = el('p', { class: 'bad', attrs: { role: 'alert' } });
    openDialog('Note', [field('Time', time, 'seconds since the start; empty: the whole trace'), field('Note', text), problem], [
      {
        label: 'Add',
        primary: true,
        run: () => {
          const at = time.value.trim() === '' ? null : parseTime(time.value);
          if (time.value.trim() !== '' && at === null) {
            problem.textContent = `“${time.value}” is no time: write for example 12.5 or 1m30s.`;
            return false;
          }
          this.app.addNote({ time: at, text: text.value.trim() || 'Bookmark' });
          return true;
        },
      },
      { label: 'Cancel' },
    ]);
    text.focus();
  }

  #draw(): void {
    const { notes } = this.app;
    const ofReport = (this.app.report?.notes ?? []).map((text) => el('li', {}, el('span', { class: 'muted' }, 'of the report'), el('span', { class: 'note-text' }, text)));
    replace(this.#list, ...ofReport, ...notes.map((note) => this.#entry(note)), notes.length === 0 ? el('li', { class: 'muted empty' }, 'No notes yet. Ctrl+B adds one at cursor A.') : null);
  }

  #entry(note: Note): HTMLElement {
    const { time } = note;
    return el(
      'li',
      {},
      time === null
        ? el('span', { class: 'muted' }, 'whole trace')
        : button(`${seconds(time)} s`, () => {
            this.app.goto(time);
            this.lead('trace');
          }, { class: 'link mono' }),
      el('span', { class: 'note-text' }, note.text),
      button('×', () => this.app.deleteNote(note), { class: 'icon', attrs: { 'aria-label': `Delete the note “${note.text}”` } }),
    );
  }

  #save(): void {
    this.app.saved('notes');
    save('notes.txt', this.app.notes.map((n) => `${n.time === null ? '-' : seconds(n.time)}\t${n.text.replaceAll('\n', ' ')}\n`).join(''), 'text/plain');
  }
}
