// What all views share: the engine and what it holds, the stretch of time that is looked at, marks, notes. Views listen to topics and never
// to each other.

import type { Answer, Connections, Engine, Finding, Gap, IdRow, MessageInfo, Requests, SignalInfo, Summary } from '../api';
import type { Board } from '../live/board';
import type { Connection } from '../live/connection';
import type { Source } from '../live/source';
import { Emitter } from './emitter';
import { Fields } from './fields';
import { pieces } from './files';
import { count, plural, seconds } from './format';
import { History } from './history';
import { Panels } from './panels';
import type { Report } from './report';
import { Spacing } from './spacing';
import { type Profile, Storage } from './storage';

/** `steady` comes with `summary`, but of a trace that grows live only about once a second: for what is costly, or is read and not watched. */
const SEVERITIES = ['error', 'warning', 'info'];

export type Topic = 'live' | 'board' | 'live-state' | 'steady' | 'summary' | 'messages' | 'range' | 'cursors' | 'identifier' | 'panels' | 'fields' | 'fields-read' | 'notes' | 'own' | 'profile' | 'findings' | 'engine' | 'goto';

export interface Range {
  from: number;
  to: number;
}

export interface Identifier {
  channel: number;
  id: number;
  extended: boolean;
}

export interface Note {
  /** Seconds; null for a note about the whole trace. */
  time: number | null;
  text: string;
}

/** What is made in the page itself. */
export type Unsaved = 'notes' | 'signals';

/** A database as it was given: an engine that is started again needs it again. */
export interface Database {
  name: string;
  bytes: Uint8Array;
  channel: number | null;
}

export type Notify = (level: 'info' | 'warning' | 'error', text: string, action?: { label: string; run: () => void }) => void;

/** Seconds that the graphs show of a live trace until the user chooses. */
const FOLLOWED = 30;
/** Milliseconds between two `steady`. */
const STEADY = 1000;

export class App extends Emitter<Topic> {
  summary: Summary | null = null;
  messages: MessageInfo[] = [];
  gaps: Gap[] = [];
  /** Null: nobody has looked for them yet. */
  findings: Finding[] | null = null;
  /** Of a live trace: how long it was when they were looked for, in seconds. */
  findingsUntil = 0;
  report: Report | null = null;
  /** The trace's file, for saving it again as it was. */
  traceFile: File | null = null;
  databases: Database[] = [];
  connections: Connections | null = null;
  identifier: Identifier | null = null;
  cursorA: number | null = null;
  cursorB: number | null = null;
  notes: Note[] = [];
  /** Where a view was asked to go; the trace and the graphs follow. */
  target: { time: number } | null = null;
  /** What the trace is live from: the server, or a board that the page has opened itself. */
  live: Source | null = null;
  /** The server that this page comes from; null without one. */
  server: Connection | null = null;
  /** The board that was opened last; null before. */
  board: Board | null = null;
  /** The graphs stay at the end of a trace that grows live. */
  following = false;
  /** The views stand still, while records still arrive. */
  paused = false;
  /** Another trace has another number. */
  serial = 0;
  /** Null until the engine has died; then why. */
  dead: string | null = null;

  readonly storage = new Storage();
  readonly profile: Profile;
  readonly panels: Panels;
  readonly fields: Fields;
  readonly zoom = new History<Range>({ from: 0, to: 1 });
  readonly own = new History<string>('');
  #fitted = true;
  #zoomed = false;
  #steadyAt = 0;
  #refreshing = new Spacing(STEADY);
  #waitingSummary: Summary | null = null;
  #opening = 0;
  /** Notes or signals were made here, and not saved. */
  #unsaved = new Set<Unsaved>();
  #bitrates: Report['bitrates'] = [];

  constructor(
    private engine: Engine,
    private readonly restart: () => Promise<Engine>,
    readonly notify: Notify,
  ) {
    super();
    this.profile = this.storage.load();
    this.panels = new Panels(() => this.panelsChanged());
    this.panels.restore(this.profile.panels);
    this.fields = new Fields(this);
    addEventListener('beforeunload', (event) => {
      if (this.#unsaved.size > 0) event.preventDefault();
    });
  }

  /** What was made here and is in no file yet: a browser that closes the page asks first. */
  get unsaved(): ReadonlySet<Unsaved> {
    return this.#unsaved;
  }

  saved(what: Unsaved): void {
    this.#unsaved.delete(what);
  }

  changed(what: Unsaved, isEmpty: boolean): void {
    if (isEmpty) this.#unsaved.delete(what);
    else this.#unsaved.add(what);
  }

  /** Asks the engine. Once it has died, every question is refused with the same words; what is shown stays. */
  async ask<K extends keyof Requests>(request: K, parameters: Requests[K]['in']): Promise<Answer<K>> {
    if (this.dead !== null) throw new EngineStopped(this.dead);
    try {
      return await this.engine.ask(request, parameters);
    } catch (error) {
      if (error instanceof Error && error.name === 'EngineDied') {
        this.#died(error.message);
        throw new EngineStopped(error.message);
      }
      throw error;
    }
  }

  #died(reason: string): void {
    if (this.dead !== null) return;
    this.dead = reason;
    this.emit('engine');
    this.notify('error', `${reason.charAt(0).toUpperCase()}${reason.slice(1)}.`, {
      label: 'Start it again',
      run: () => void this.startAgain(),
    });
  }

  async startAgain(): Promise<void> {
    try {
      this.engine.close();
      this.engine = await this.restart();
      this.dead = null;
      this.emit('engine');
      // The new engine has nothing of what the old one was given.
      for (const { name, bytes, channel } of this.databases) await this.ask('database', { name, bytes, channel });
      if (this.connections) await this.ask('connections', this.connections);
      if (this.own.current !== '') await this.ask('setOwnDatabase', { dbc: this.own.current });
      if (this.live) this.live.again();
      else if (this.traceFile) await this.openTrace(this.traceFile, this.#bitrates, true);
    } catch (error) {
      this.failed(error);
    }
  }

  /** Shows an error once; those of a stopped engine were shown already. */
  failed(error: unknown): void {
    if (error instanceof EngineStopped) return;
    this.notify('error', error instanceof Error ? error.message : String(error));
  }

  /** `bitrates`: what the file does not say itself, in bit/s. `again`: the trace that is shown already, whose notes and cursors stay. */
  async openTrace(file: File, bitrates: Report['bitrates'] = [], again = false): Promise<void> {
    const turn = ++this.#opening;
    const before = this.summary ? { file: this.traceFile, bitrates: this.#bitrates, fitted: this.#fitted } : null;
    this.traceFile = file;
    this.#bitrates = bitrates;
    if (!again) this.#fitted = true;
    let first = true;
    let read = 0;
    // The engine is given a piece while it reads the one before, so that it never waits for the page.
    let under: { answer: Promise<Summary>; bytes: number } | null = null;
    const taken = async (): Promise<boolean> => {
      if (!under) return true;
      const { answer, bytes } = under;
      under = null;
      const summary = await answer;
      if (turn !== this.#opening) return false;
      read += bytes;
      this.#take(summary);
      return true;
    };
    try {
      for await (const { bytes, more } of pieces(file)) {
        if (turn !== this.#opening) return;
        if (first) {
          const summary = await this.ask('open', { name: file.name, bytes, more, size: file.size });
          if (turn !== this.#opening) return;
          this.#forget(again);
          first = false;
          read += bytes.length;
          this.#take(summary);
          continue;
        }
        const answer = this.ask('append', { bytes, more });
        // It is waited for one piece later, or never, if the one before is refused.
        answer.catch(() => undefined);
        if (!(await taken())) return;
        under = { answer, bytes: bytes.length };
      }
      if (!(await taken())) return;
    } catch (error) {
      if (first) {
        // Nothing of the new file was taken in. The engine may have let go of the one before: it is read again.
        this.traceFile = null;
        if (before?.file && this.dead === null) {
          this.#fitted = before.fitted;
          await this.openTrace(before.file, before.bitrates, true);
        }
        throw error instanceof EngineStopped ? error : new Error(`${file.name}: ${error instanceof Error ? error.message : String(error)}`);
      }
      const reason = error instanceof Error ? error.message : String(error);
      this.notify('error', `${file.name} was read to byte ${count(read)} of ${count(file.size)}, and no further: ${reason} What was read stays.`);
    }
    for (const { channel, bitrate, dataBitrate } of bitrates) await this.ask('bitrate', { channel, bitrate, ...(dataBitrate === null ? {} : { dataBitrate }) });
    await this.refresh();
    for (const issue of this.summary?.issues ?? []) this.notify('warning', `${issue.text}${issue.count > 1 ? ` (${plural(issue.count, 'time')})` : ''}`);
  }

  /** A live source that has sent nothing yet: an empty trace, in which the views wait. */
  async begin(name: string): Promise<void> {
    this.following = true;
    this.#fitted = false;
    this.#take(await this.ask('open', { name, bytes: new Uint8Array(), more: true, size: null }));
    this.emit('live');
  }

  /** Takes in records of a live source; `anew`: they begin another trace. */
  async takeLive(name: string, chunks: Uint8Array, anew: boolean): Promise<void> {
    if (anew) this.beginLive();
    this.taken(anew ? await this.ask('open', { name, bytes: chunks, more: true, size: null }) : await this.ask('append', { bytes: chunks, more: true }), anew);
  }

  /** Another trace will be live. */
  beginLive(): void {
    this.#opening++;
    this.traceFile = null;
    this.#fitted = false;
    this.following = true;
    this.#refreshing = new Spacing(STEADY);
  }

  /** The engine has taken in records of a live source. */
  taken(summary: Summary, anew: boolean): void {
    if (anew) this.#forget();
    // Rows have other numbers then, which the views must know.
    const moved = summary.forgotten !== this.summary?.forgotten;
    if (this.paused && !anew && !moved) {
      this.#waitingSummary = summary;
      return;
    }
    this.#take(summary);
    this.#refreshing.ask(() => void this.#refreshing.run(() => this.#refreshLive()));
  }

  async #refreshLive(): Promise<void> {
    try {
      const summary = this.summary;
      if (!summary) return;
      const [messages, gaps] = await Promise.all([this.ask('messages', {}), this.ask('gaps', { from: summary.begin, to: null as unknown as number })]);
      this.gaps = gaps;
      const known = (list: MessageInfo[]): string => list.map((m) => `${m.key} ${m.count > 0}`).join();
      const changed = known(messages) !== known(this.messages);
      this.messages = messages;
      if (changed) {
        this.panels.resolve(messages);
        this.emit('messages');
        this.emit('panels');
      }
    } catch (error) {
      this.failed(error);
    }
  }

  /** Lets the views stand still, or go on from what has arrived meanwhile. */
  pause(paused: boolean): void {
    this.paused = paused;
    const waiting = this.#waitingSummary;
    this.#waitingSummary = null;
    if (!paused && waiting) this.#take(waiting);
    this.emit('live');
  }

  /** Stays at the end again, with as much in sight as before. */
  follow(): void {
    this.following = true;
    this.pause(false);
    if (this.summary) this.#take(this.summary);
  }

  #forget(again = false): void {
    this.serial++;
    this.findings = null;
    this.gaps = [];
    this.fields.forget(!again);
    if (again) return;
    this.identifier = null;
    this.cursorA = this.cursorB = null;
    if (!this.summary) return;
    // What a report says is about its own trace; so are notes at a time, which stay as texts.
    this.report = null;
    const { name } = this.summary;
    this.notes = this.notes.map((note) => (note.time === null ? note : { time: null, text: `${name}, ${seconds(note.time)} s: ${note.text}` }));
    this.emit('notes');
  }

  #take(summary: Summary): void {
    this.summary = summary;
    if (this.#fitted) this.zoom.amend(this.whole());
    else if (this.following) {
      const span = Math.min(this.range.to - this.range.from, summary.duration - summary.begin) || 1;
      const wide = Math.max(span, Math.min(FOLLOWED, summary.duration - summary.begin));
      this.zoom.amend({ from: summary.duration - (this.#zoomed ? span : wide), to: summary.duration });
    }
    this.emit('summary');
    this.emit('range');
    const now = performance.now();
    if (!this.live || now >= this.#steadyAt) {
      this.#steadyAt = now + STEADY;
      this.emit('steady');
    }
  }

  /** Asks anew what depends on the whole trace or on the databases. */
  async refresh(): Promise<void> {
    if (!this.summary) return;
    const [summary, messages, gaps, findings] = await Promise.all([
      this.ask('summary', {}),
      this.ask('messages', {}),
      this.ask('gaps', { from: 0, to: this.summary.duration }),
      this.ask('findings', {}),
    ]);
    this.messages = messages;
    this.gaps = gaps;
    this.findings = this.#joined(findings);
    this.findingsUntil = summary.duration;
    this.panels.resolve(messages);
    this.#take(summary);
    this.emit('messages');
    this.emit('findings');
    this.emit('panels');
  }

  /** Looks for findings in what there is now. */
  async lookForFindings(): Promise<void> {
    try {
      const until = this.summary?.duration ?? 0;
      this.findings = this.#joined(await this.ask('findings', {}));
      this.findingsUntil = until;
      this.emit('findings');
    } catch (error) {
      this.failed(error);
    }
  }

  /** Those of the report and those of the engine, the worst first. */
  #joined(findings: Finding[]): Finding[] {
    const seen = new Set<string>();
    const all = [...(this.report?.findings ?? []), ...findings].filter((f) => {
      const key = `${f.time} ${f.text}`;
      return seen.has(key) ? false : (seen.add(key), true);
    });
    return all.sort((a, b) => SEVERITIES.indexOf(a.severity) - SEVERITIES.indexOf(b.severity));
  }

  async addDatabase(name: string, bytes: Uint8Array, channel: number | null): Promise<void> {
    const answer = await this.ask('database', { name, bytes, channel });
    this.databases.push({ name, bytes, channel });
    this.fields.forget(false);
    for (const warning of answer.warnings.slice(0, 5)) this.notify('warning', `${name}: ${warning}`);
    if (answer.warnings.length > 5) this.notify('warning', `${name}: ${count(answer.warnings.length - 5)} more warnings.`);
    await this.refresh();
    this.emit('messages');
  }

  /** Who talks to whom where a trace does not show it. */
  async connect(connections: Connections): Promise<void> {
    await this.ask('connections', connections);
    this.connections = connections;
    this.fields.forget(false);
  }

  /** The user's own database as text: one step of undo. */
  async setOwn(dbc: string): Promise<void> {
    await this.ask('setOwnDatabase', { dbc });
    this.fields.forget(false);
    await this.refresh();
    this.emit('own');
  }

  /** The bit rate of a channel in bit/s, by the user. */
  async setBitrate(channel: number, bitrate: number): Promise<void> {
    try {
      await this.ask('bitrate', { channel, bitrate });
      this.#bitrates = [...this.#bitrates.filter((known) => known.channel !== channel), { channel, bitrate, dataBitrate: this.#bitrates.find((known) => known.channel === channel)?.dataBitrate ?? null }];
      await this.refresh();
    } catch (error) {
      this.failed(error);
    }
  }

  whole(): Range {
    const { begin, duration } = this.summary ?? { begin: 0, duration: 0 };
    return { from: begin, to: duration > begin ? duration : begin + 1 };
  }

  get range(): Range {
    return this.zoom.current;
  }

  /** Looks at a stretch; `step` false for what a drag passes through. Kept within the trace and above a nanosecond. */
  look(range: Range, step = true): void {
    const whole = this.whole();
    const span = Math.min(Math.max(range.to - range.from, 1e-8), whole.to - whole.from);
    const from = Math.min(Math.max(range.from, whole.from), whole.to - span);
    const next = { from, to: from + span };
    if (next.from === this.range.from && next.to === this.range.to) return;
    this.#fitted = false;
    this.#zoomed = true;
    // Whoever looks at the end goes on with it.
    this.following = this.live !== null && next.to >= whole.to - span * 0.01;
    if (step) this.zoom.push(next);
    else this.zoom.amend(next);
    this.emit('range');
  }

  fit(): void {
    this.look(this.whole());
    this.#fitted = true;
    this.#zoomed = false;
  }

  unzoom(): void {
    if (this.zoom.undo()) this.emit('range');
  }

  rezoom(): void {
    if (this.zoom.redo()) this.emit('range');
  }

  setCursor(which: 'A' | 'B', time: number | null): void {
    if (which === 'A') this.cursorA = time;
    else this.cursorB = time;
    this.emit('cursors');
  }

  /** Between the two cursors, or null. */
  get marked(): Range | null {
    if (this.cursorA === null || this.cursorB === null) return null;
    return { from: Math.min(this.cursorA, this.cursorB), to: Math.max(this.cursorA, this.cursorB) };
  }

  choose(identifier: Identifier): void {
    this.identifier = identifier;
    this.emit('identifier');
  }

  /** Leads the trace and the graphs to a time. */
  goto(time: number): void {
    this.target = { time };
    this.setCursor('A', time);
    const { from, to } = this.range;
    if (time < from || time > to) this.look({ from: time - (to - from) / 2, to: time + (to - from) / 2 });
    this.emit('goto');
  }

  addNote(note: Note): void {
    this.notes.push(note);
    this.notes.sort((a, b) => (a.time ?? -1) - (b.time ?? -1));
    this.changed('notes', false);
    this.emit('notes');
  }

  deleteNote(note: Note): void {
    this.notes = this.notes.filter((n) => n !== note);
    this.changed('notes', this.notes.length === 0);
    this.emit('notes');
  }

  findSignal(key: number): { message: MessageInfo; signal: SignalInfo } | null {
    for (const message of this.messages) {
      const signal = message.signals.find((s) => s.key === key);
      if (signal) return { message, signal };
    }
    return null;
  }

  saveProfile(): void {
    this.profile.panels = this.panels.profile();
    this.storage.save(this.profile);
    this.emit('profile');
  }

  private panelsChanged(): void {
    this.panels.resolve(this.messages);
    this.saveProfile();
    this.emit('panels');
  }
}

/** The engine is no longer there; this was said already. */
export class EngineStopped extends Error {}

export function sameIdentifier(a: Identifier | null, b: Identifier | IdRow): boolean {
  return a !== null && a.channel === b.channel && a.id === b.id && a.extended === b.extended;
}
