// The frame around the views: tabs, status line, keyboard, palette, theme, files dropped anywhere.

import type { App } from './model/app';
import { openFiles } from './model/open-files';
import { blobOfBase64, gunzip, save } from './model/files';
import { bytes, duration, idText, missing, parseTime, percent, plural } from './model/format';
import { parseProfile } from './model/storage';
import { Commands, type Command, keyLabel } from './ui/commands';
import { openDialog } from './ui/dialog';
import { button, el, setText } from './ui/dom';
import { openPalette } from './ui/palette';
import { BitsView } from './views/bits';
import { BoardView } from './views/board';
import { ConversationsView } from './views/conversations';
import { DeviceView } from './views/device';
import { openExport } from './views/export';
import { FixedView } from './views/fixed';
import { GraphsView } from './views/graphs';
import { NotesView } from './views/notes';
import { openBoard } from './views/open-board';
import { StatisticsView } from './views/statistics';
import { SummaryView } from './views/summary';
import { TraceView } from './views/trace';
import type { View } from './views/view';

export class Shell {
  readonly element: HTMLElement;
  readonly #commands = new Commands();
  readonly #views: View[];
  readonly #trace: TraceView;
  readonly #notes: NotesView;
  readonly #tabs = new Map<string, HTMLButtonElement>();
  readonly #status = el('span', { class: 'mono', attrs: { role: 'status' } });
  readonly #losses = el('span', { class: 'mono' });
  readonly #chosen = el('span', { class: 'mono' });
  readonly #name = el('span', { class: 'trace-name' });
  readonly #progress = el('progress', { attrs: { max: 1, 'aria-label': 'Read of the file' } });
  readonly #picker = el('input', { attrs: { type: 'file', multiple: true, hidden: true, 'aria-label': 'Open trace and database files' } });
  readonly #liveState = el('span', { class: 'live-state', attrs: { role: 'status' } });
  readonly #pause = button('Pause', () => this.#togglePause(), { id: 'live-pause', title: 'Let the views stand still while records still arrive (P)' });
  readonly #record = button('● Record', () => this.#device?.toggleRecording(), { id: 'live-record', title: 'Record to a file (R)' });
  readonly #tabList = el('div', { class: 'tabs', attrs: { role: 'tablist', 'aria-label': 'Views' } });
  readonly #main = el('main');
  readonly #liveTools = el('span', { class: 'tools live' }, this.#liveState, this.#pause, this.#record);
  #device: DeviceView | null = null;
  #current: View;

  constructor(
    private readonly app: App,
    notices: HTMLElement,
  ) {
    const lead = (view: string): void => this.show(view);
    this.#trace = new TraceView(app, this.#commands, () => this.#export());
    this.#notes = new NotesView(app, this.#commands, lead);
    const fixed = new FixedView(app, this.#commands, () => this.show('bits'));
    this.#views = [new SummaryView(app, this.#commands, lead), this.#trace, new GraphsView(app, this.#commands), fixed, new BitsView(app, this.#commands), new StatisticsView(app, this.#commands), new ConversationsView(app, this.#commands, lead), this.#notes];
    if (app.server) this.#views.push((this.#device = new DeviceView(app, app.server, this.#commands, () => void openExport(app, 0, ''))));
    for (const topic of ['live', 'live-state'] as const) app.on(topic, () => this.#drawLive());
    // A frozen view is told from one to which nothing comes.
    app.on('range', () => this.#drawLive());
    this.#tabList.addEventListener('keydown', (event) => this.#tabKey(event));
    const header = el(
      'header',
      {},
      el('b', { class: 'brand' }, 'cantap'),
      this.#name,
      this.#tabList,
      this.#liveTools,
      el('span', { class: 'tools' }, button('Open …', () => this.#picker.click(), { title: 'Open a trace or databases (Ctrl+O)' }), button('Commands', () => this.#palette(), { title: 'Command palette (Ctrl+K)' }), button('?', () => this.#help(), { title: 'Keys (?)', attrs: { 'aria-label': 'Keys' } }), button('◐', () => this.#cycleTheme(), { title: 'Dark or light', attrs: { 'aria-label': 'Dark or light' } })),
    );
    this.#picker.addEventListener('change', () => {
      void openFiles(this.app, [...(this.#picker.files ?? [])]);
      this.#picker.value = '';
    });
    this.#views.forEach((view, i) => this.#place(view, i));
    this.element = el('div', { class: 'shell' }, header, this.#main, notices, el('footer', {}, this.#status, this.#progress, this.#losses, this.#chosen), this.#picker);
    this.#current = this.#views[0] as View;
    this.#addCommands();
    app.on('summary', () => this.#drawStatus());
    app.on('identifier', () => this.#drawChosen());
    app.on('engine', () => this.element.classList.toggle('engine-dead', app.dead !== null));
    this.#acceptFiles();
    document.addEventListener('keydown', (event) => {
      if (document.querySelector('dialog[open]')) return;
      if (event.key === 'Escape' && event.target instanceof HTMLInputElement) {
        event.target.blur();
        return;
      }
      this.#commands.key(event, this.#current.id);
    });
    this.#applyTheme();
    this.show(app.profile.view);
    this.#drawStatus();
    this.#drawLive();
    app.on('board', () => this.#showBoard());
  }

  /** The board that was opened has a view of its own. */
  #showBoard(): void {
    const { board } = this.app;
    if (board && !this.#views.some((view) => view.id === 'board')) {
      const view = new BoardView(this.app, board, () => void openExport(this.app, 0, ''));
      this.#views.push(view);
      this.#place(view, this.#views.length - 1);
    }
    this.#drawLive();
    this.show('board');
  }

  show(id: string): void {
    const next = this.#views.find((v) => v.id === id) ?? (this.#views[0] as View);
    if (next !== this.#current) this.#current.hidden?.();
    this.#current = next;
    for (const view of this.#views) view.element.hidden = view !== next;
    for (const [key, tab] of this.#tabs) {
      tab.setAttribute('aria-selected', String(key === next.id));
      tab.tabIndex = key === next.id ? 0 : -1;
    }
    this.#tabs.get(next.id)?.scrollIntoView({ block: 'nearest', inline: 'nearest' });
    this.element.dataset['view'] = next.id;
    next.shown();
    if (this.app.profile.view !== next.id) {
      this.app.profile.view = next.id;
      this.app.saveProfile();
    }
  }

  /** Gives a view its tab, its place and its key. */
  #place(view: View, i: number): void {
    view.element.id = `view-${view.id}`;
    view.element.setAttribute('role', 'tabpanel');
    view.element.hidden = true;
    this.#tabList.append(this.#tab(view, i));
    this.#main.append(view.element);
    this.#commands.add({ id: `view.${view.id}`, title: `View: ${view.title}`, keys: [String(i + 1)], run: () => this.#showAndFocus(view) });
  }

  #tab(view: View, i: number): HTMLButtonElement {
    const tab = button(view.title, () => this.show(view.id), { id: `tab-${view.id}`, title: `${view.title} (${i + 1})`, attrs: { role: 'tab', 'aria-controls': `view-${view.id}` } });
    view.element.setAttribute('aria-labelledby', tab.id);
    this.#tabs.set(view.id, tab);
    return tab;
  }

  #tabKey(event: KeyboardEvent): void {
    const at = this.#views.indexOf(this.#current);
    const moves: Record<string, number> = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: this.#views.length - 1 };
    const next = this.#views[moves[event.key] ?? -1];
    if (!next) return;
    event.preventDefault();
    event.stopPropagation();
    this.show(next.id);
    this.#tabs.get(next.id)?.focus();
  }

  #addCommands(): void {
    this.#commands.add(
      { id: 'palette', title: 'Command palette', keys: ['Ctrl+k'], run: () => this.#palette() },
      { id: 'help', title: 'Keys', keys: ['?'], run: () => this.#help() },
      { id: 'open', title: 'Open a trace or databases', keys: ['Ctrl+o'], run: () => this.#picker.click() },
      { id: 'export', title: 'Export records', keys: ['Ctrl+e'], run: () => this.#export() },
      { id: 'goto', title: 'Go to a time', keys: [':'], run: () => this.#askTime() },
      { id: 'theme', title: 'Dark, light, or as the system has it', keys: ['D'], run: () => this.#cycleTheme() },
      { id: 'profile.save', title: 'Save the layout as a profile', run: () => this.#saveProfile() },
      ...(this.app.server ? [] : [{ id: 'board.open', title: 'Open a board', run: () => void openBoard(this.app) }]),
      { id: 'live.pause', title: 'Live: pause, or follow what arrives', keys: ['P'], run: () => this.#togglePause() },
      { id: 'licences', title: 'Licences', run: () => void this.#licences() },
      { id: 'profile.load', title: 'Load a profile', run: () => this.#loadProfile() },
    );
  }

  #togglePause(): void {
    const { app } = this;
    if (!app.live) return;
    if (app.paused || !app.following) app.follow();
    else app.pause(true);
  }

  #drawLive(): void {
    const { app } = this;
    const { live } = app;
    this.#liveTools.hidden = !live;
    if (!live) return;
    this.#record.hidden = live !== app.server || app.server?.state?.mayRecord === false;
    const gone = live === app.board ? 'board gone' : 'connection lost';
    const state = live.state?.ended ? 'device gone' : live.status === 'open' ? (app.paused ? 'paused' : app.following ? 'live' : 'looking back') : live.status === 'ended' ? 'ended' : live.status === 'lost' ? gone : 'connecting';
    setText(this.#liveState, state);
    this.#liveState.title = live.reason;
    this.#liveState.dataset['status'] = live.state?.ended ? 'lost' : live.status;
    setText(this.#pause, app.paused ? 'Go on' : app.following ? 'Pause' : 'Follow');
    const recording = live.state?.recording;
    setText(this.#record, recording ? `■ ${duration(recording.seconds)}, ${bytes(recording.bytes)}` : '● Record');
    this.#record.title = recording ? `Ends the recording to ${recording.name} (R)` : 'Record to a file (R)';
    this.#record.setAttribute('aria-pressed', String(recording !== undefined && recording !== null));
    // The newest record's time, for whoever measures how late the page is.
    const { summary } = app;
    if (summary?.startUtcNs) this.element.dataset['newest'] = String(Number(summary.startUtcNs) / 1e6 + summary.duration * 1000);
    this.element.dataset['received'] = String(live.next);
    this.element.dataset['behind'] = String(live.latest - live.next);
  }

  #showAndFocus(view: View): void {
    this.show(view.id);
    view.element.querySelector<HTMLElement>('[tabindex="0"]')?.focus();
  }

  #palette(): void {
    const { app } = this;
    const commands: Command[] = this.#commands.every().map((command) => ({
      ...command,
      run: () => {
        if (command.view && command.view !== this.#current.id) this.show(command.view);
        command.run();
      },
    }));
    for (const message of app.messages) {
      for (const signal of message.signals) {
        commands.push({
          id: `signal.${message.key}.${signal.key}`,
          title: `Graph: ${message.name}.${signal.name}`,
          run: () => {
            app.panels.addSignal(message, signal);
            this.show('graphs');
          },
        });
      }
      commands.push({ id: `message.${message.key}`, title: `Trace: only ${message.name} (${idText(message.id, message.extended)})`, run: () => (this.show('trace'), this.#trace.setFilter(idText(message.id, message.extended))) });
    }
    openPalette(commands);
  }

  #help(): void {
    const rows = (list: readonly Command[]): HTMLElement[] => list.filter((c) => c.keys).flatMap((c) => [el('dt', {}, ...(c.keys ?? []).slice(0, 2).flatMap((k, i) => [i > 0 ? ' ' : '', el('kbd', {}, keyLabel(k))])), el('dd', {}, shortTitle(c))]);
    const every = this.#commands.every();
    openDialog(
      'Keys',
      [
        el('section', {}, el('h3', {}, 'Everywhere'), el('dl', {}, ...rows(every.filter((c) => c.view === undefined)))),
        ...this.#views.filter((v) => every.some((c) => c.view === v.id && c.keys)).map((v) => el('section', {}, el('h3', {}, v.title), el('dl', {}, ...rows(every.filter((c) => c.view === v.id))))),
        el('section', {}, el('h3', {}, 'Tables'), el('dl', {}, el('dt', {}, el('kbd', {}, '↑'), ' ', el('kbd', {}, '↓'), ' ', el('kbd', {}, 'PgUp'), ' ', el('kbd', {}, 'Home')), el('dd', {}, 'Move'), el('dt', {}, el('kbd', {}, 'Enter')), el('dd', {}, 'Open: lead the graphs there, or expand'))),
        el('section', {}, el('h3', {}, 'Mouse in the graphs'), el('dl', {}, el('dt', {}, 'wheel'), el('dd', {}, 'zoom about the pointer'), el('dt', {}, 'drag'), el('dd', {}, 'zoom into the stretch'), el('dt', {}, 'Shift+drag, Shift+wheel'), el('dd', {}, 'pan'), el('dt', {}, 'click, Shift+click'), el('dd', {}, 'cursor A, cursor B'), el('dt', {}, 'double click'), el('dd', {}, 'everything in sight'))),
      ],
      [{ label: 'Close', primary: true }],
      'keys',
    );
  }

  #askTime(): void {
    const input = el('input', { class: 'mono', attrs: { type: 'text', 'aria-label': 'Time' } });
    const problem = el('p', { class: 'bad', attrs: { role: 'alert' } });
    openDialog('Go to a time', [input, el('p', { class: 'muted' }, 'Seconds since the start, or 1m30s, 1:02:03, 400ms'), problem], [
      {
        label: 'Go',
        primary: true,
        run: () => {
          const time = parseTime(input.value);
          if (time === null) {
            problem.textContent = `“${input.value}” is no time: write for example 12.5 or 1m30s.`;
            return false;
          }
          this.app.goto(time);
          if (this.#current.id !== 'graphs') this.show('trace');
          return true;
        },
      },
      { label: 'Cancel' },
    ]);
    input.focus();
  }

  #export(): void {
    if (this.app.summary) void openExport(this.app, this.#trace.view, this.#trace.filter);
  }

  #saveProfile(): void {
    this.app.profile.panels = this.app.panels.profile();
    save('cantap-page.profile.json', `${JSON.stringify(this.app.profile, null, 2)}\n`, 'application/json');
  }

  #loadProfile(): void {
    const picker = el('input', { attrs: { type: 'file', accept: '.json', 'aria-label': 'Profile' } });
    picker.addEventListener('change', () => {
      const file = picker.files?.[0];
      if (file) {
        void file
          .text()
          .then((text) => {
            Object.assign(this.app.profile, parseProfile(text));
            this.app.panels.restore(this.app.profile.panels);
            this.app.panels.resolve(this.app.messages);
            this.app.emit('panels');
            this.app.saveProfile();
            this.#applyTheme();
            this.show(this.app.profile.view);
          })
          .catch((error: unknown) => this.app.notify('error', `${file.name}: ${error instanceof Error ? error.message : String(error)}`));
      }
    });
    picker.click();
  }

  async #licences(): Promise<void> {
    const packed = document.getElementById('cantap-licences')?.textContent ?? '';
    try {
      const others = packed === '' ? '' : await (await gunzip(blobOfBase64(packed))).text();
      openDialog('Licences', [el('p', {}, 'cantap: MIT or Apache-2.0, at your choice.'), el('pre', { class: 'licences', attrs: { tabindex: 0 } }, others)], [{ label: 'Close', primary: true }], 'keys');
    } catch (error) {
      this.app.failed(error);
    }
  }

  #cycleTheme(): void {
    const order = ['auto', 'dark', 'light'] as const;
    this.app.profile.theme = order[(order.indexOf(this.app.profile.theme) + 1) % 3] ?? 'auto';
    this.#applyTheme();
    this.app.saveProfile();
  }

  #applyTheme(): void {
    applyTheme(this.app.profile.theme);
  }

  #drawStatus(): void {
    const { summary } = this.app;
    if (!summary) return;
    this.element.dataset['forgotten'] = String(summary.forgotten);
    document.title = `${summary.name} · cantap`;
    setText(this.#name, summary.name);
    this.#name.title = summary.name;
    const file = this.app.traceFile;
    const reading = summary.growing && summary.progress !== null;
    setText(this.#status, `${plural(summary.frames, 'frame')} in ${duration(summary.duration)}${file ? `, ${summary.format}, ${bytes(file.size)}` : ''}${reading ? `, read ${percent(summary.progress)}` : ''}`);
    this.#progress.hidden = !reading;
    this.#progress.value = summary.progress ?? 0;
    const lost = summary.losses.reduce((sum, l) => sum + l.count, 0);
    const atLeast = summary.losses.some((l) => l.atLeast);
    const isWhole = lost === 0 && !atLeast;
    setText(this.#losses, isWhole ? 'no known loss' : `${missing(lost, atLeast)} lost`);
    this.#losses.classList.toggle('bad', !isWhole);
    this.element.dataset['records'] = String(summary.records);
    this.element.dataset['growing'] = String(summary.growing);
  }

  #drawChosen(): void {
    const chosen = this.app.identifier;
    setText(this.#chosen, chosen ? `chosen: ${idText(chosen.id, chosen.extended)} on channel ${chosen.channel}` : '');
  }

  #acceptFiles(): void {
    const hint = el('div', { class: 'drop-hint', attrs: { 'aria-hidden': 'true' } }, 'Drop traces and databases');
    hint.hidden = true;
    this.element.append(hint);
    addEventListener('dragover', (event) => {
      if (!event.dataTransfer?.types.includes('Files')) return;
      event.preventDefault();
      hint.hidden = false;
    });
    addEventListener('dragleave', (event) => {
      if (event.relatedTarget === null) hint.hidden = true;
    });
    addEventListener('drop', (event) => {
      hint.hidden = true;
      if (!event.dataTransfer?.types.includes('Files')) return;
      event.preventDefault();
      void openFiles(this.app, [...event.dataTransfer.files]);
    });
  }
}

const SYSTEM_IS_DARK = matchMedia('(prefers-color-scheme: dark)');

/** Applies a theme now, and the system's again when that changes. */
export function applyTheme(theme: 'auto' | 'dark' | 'light'): void {
  const apply = (): void => {
    document.documentElement.dataset['theme'] = theme === 'auto' ? (SYSTEM_IS_DARK.matches ? 'dark' : 'light') : theme;
  };
  SYSTEM_IS_DARK.onchange = apply;
  apply();
}

/** A command's title below the heading of its view: without the view's name. */
function shortTitle(command: Command): string {
  const title = command.view === undefined ? command.title : command.title.replace(/^(Graphs|Fixed view|Bits|Periods|Conversations): /, '');
  return title.charAt(0).toUpperCase() + title.slice(1);
}
