// Saves a part of the trace in any format that the engine writes.

import type { App } from '../model/app';
import { save } from '../model/files';
import { count, parseTime, seconds } from '../model/format';
import { openDialog } from '../ui/dialog';
import { el, field, select } from '../ui/dom';

export async function openExport(app: App, view: number, filter: string): Promise<void> {
  if (!app.summary) return;
  let formats;
  try {
    formats = await app.ask('formats', {});
  } catch (error) {
    app.failed(error);
    return;
  }
  const from = el('input', { class: 'mono', attrs: { type: 'text', 'aria-label': 'From' } });
  const to = el('input', { class: 'mono', attrs: { type: 'text', 'aria-label': 'To' } });
  let exact = app.whole();
  const set = (range: { from: number; to: number }): void => {
    exact = range;
    from.value = seconds(range.from);
    to.value = seconds(range.to);
  };
  set(app.marked ?? app.whole());
  const stretch = select(
    [
      ['whole', 'the whole trace'],
      ['view', 'what the graphs show'],
      ...(app.marked ? [['marked', 'between the cursors'] as const] : []),
    ],
    app.marked ? 'marked' : 'whole',
    (value) => set(value === 'view' ? app.range : value === 'marked' && app.marked ? app.marked : app.whole()),
    'Stretch',
  );
  const format = select(formats.map((f) => [f.name, `${f.name} (.${f.extension}): ${f.about}`] as const), formats[0]?.name ?? '', () => undefined, 'Format');
  const problem = el('p', { class: 'bad', attrs: { role: 'alert' } });
  openDialog('Export', [filter.trim() === '' ? el('p', {}, 'All records') : el('p', {}, 'Records of the filter ', el('code', {}, filter)), field('Stretch', stretch), el('div', { class: 'pair' }, field('From', from), field('To', to)), field('Format', format), problem], [
    {
      label: 'Export',
      primary: true,
      run: () => {
        // The texts are rounded: the last record may be later than its own.
        const time = (input: HTMLInputElement, of: number): number | null => (input.value === seconds(of) ? of : parseTime(input.value));
        const range = { from: time(from, exact.from), to: time(to, exact.to) };
        if (range.from === null || range.to === null || range.to < range.from) {
          problem.textContent = 'From and to are times, the earlier first: write for example 12.5 or 1m30s.';
          return false;
        }
        void run(app, view, filter, format.value, range.from, range.to);
        return true;
      },
    },
    { label: 'Cancel' },
  ]);
}

async function run(app: App, view: number, filter: string, format: string, from: number, to: number): Promise<void> {
  try {
    const { name, bytes, omitted } = await app.ask('export', { view, format, from, to });
    save(name, bytes);
    const whole = app.whole();
    if (filter.trim() === '' && from <= whole.from && to >= whole.to) app.board?.saved();
    app.notify(omitted.length > 0 ? 'warning' : 'info', `${name}: ${count(bytes.length)} bytes.${omitted.length > 0 ? ` Left out, since the format cannot hold it: ${omitted.join('; ')}.` : ''}`);
  } catch (error) {
    app.failed(error);
  }
}
