// Numbers that protocols have in their messages: looked for when they are asked for, some records at a time, so that all else is answered between.

import type { FieldInfo } from '../api';
import type { App } from './app';

/** Records of a request: a fraction of a second. */
const RECORDS = 20_000;

export class Fields {
  list: FieldInfo[] = [];
  /** They were asked for in this trace. */
  wanted = false;
  reading = false;
  /** Records in which they were looked for. */
  read = 0;
  /** Values that are not kept, because there are too many. */
  leftOut = 0;
  /** Changes when what was found is void. */
  #turn = 0;

  constructor(private readonly app: App) {
    app.on('steady', () => this.#goOn());
    app.on('panels', () => this.#goOn());
  }

  /** What was found is void: `another` trace is open, or there are other databases. */
  forget(another: boolean): void {
    this.#turn++;
    this.list = [];
    this.read = this.leftOut = 0;
    if (another) this.wanted = false;
    this.app.panels.resolveFields([]);
    this.app.emit('fields');
    this.#goOn();
  }

  look(): void {
    this.wanted = true;
    this.#goOn();
  }

  /** Reads what has come meanwhile, if anybody wants it. A file is first read itself. */
  #goOn(): void {
    const { summary, live, panels } = this.app;
    if (!summary || (summary.growing && !live)) return;
    this.wanted ||= panels.hasFields;
    if (this.wanted && !this.reading && this.read < summary.records) void this.#read();
  }

  async #read(): Promise<void> {
    this.reading = true;
    try {
      while (this.reading) {
        const turn = this.#turn;
        const { fields, read, leftOut } = await this.app.ask('fields', { records: RECORDS });
        if (turn !== this.#turn) continue;
        const { records, growing } = this.app.summary ?? { records: 0, growing: false };
        this.reading = read < records && read !== this.read;
        const isNew = fields.length !== this.list.length || (!this.reading && !growing);
        this.list = fields;
        this.leftOut = leftOut;
        this.read = read;
        this.app.panels.resolveFields(fields);
        this.app.emit(isNew ? 'fields' : 'fields-read');
      }
    } catch (error) {
      this.app.failed(error);
    } finally {
      this.reading = false;
    }
  }
}
