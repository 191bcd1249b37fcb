// A table of any length: only the rows in sight are elements. Browsers limit an element's height (Chromium to 33 million pixels), so for long
// tables the scroll bar's position is a share of the table, while wheel and touch move by whole rows.

import { el } from './dom';

/** Well below every browser's limit. */
const MAX_HEIGHT = 8_000_000;
/** Pixels of the head, as in the style sheet. */
const HEAD = 22;

export interface Column {
  name: string;
  /** CSS class of its cells; widths are in the style sheet. */
  class: string;
  /** What its name leaves out. */
  title?: string;
}

export interface RowSource {
  length(): number;
  /** Fills a row's cells; false if its content is not there yet. */
  fill(row: HTMLElement, cells: HTMLElement[], index: number): boolean;
  /** Which rows are in sight now: to fetch what is missing. */
  visible?(from: number, to: number): void;
  /** The selected row changed. */
  selected?(index: number): void;
  /** Enter, or a double click. */
  opened?(index: number): void;
}

let lists = 0;

export class VirtualList {
  /** The scrolled table itself: it holds the focus and its head stays at the top. */
  readonly element: HTMLElement;
  readonly #spacer: HTMLElement;
  readonly #layer: HTMLElement;
  readonly #rows: { row: HTMLElement; cells: HTMLElement[] }[] = [];
  readonly #prefix = `list${++lists}`;
  #top = 0;
  #selected = -1;
  #scheduled = false;
  #expected: number | null = null;
  #lastScroll = 0;
  #height = 0;
  /** How often rows were drawn: what a test and a measurement count. */
  drawn = 0;

  constructor(
    label: string,
    private readonly columns: Column[],
    private readonly source: RowSource,
    private readonly rowHeight = 20,
    role: 'grid' | 'treegrid' = 'grid',
  ) {
    this.#spacer = el('div', { class: 'list-spacer' });
    this.#layer = el('div', { class: 'list-layer', attrs: { role: 'rowgroup' } });
    const head = el('div', { class: 'list-head', attrs: { role: 'rowgroup' } }, el('div', { class: 'list-row', attrs: { role: 'row', 'aria-rowindex': 1 } }, ...columns.map((c) => el('div', { class: `cell ${c.class}`, title: c.title ?? '', attrs: { role: 'columnheader' } }, c.name))));
    this.element = el('div', { class: 'list', attrs: { role, tabindex: 0, 'aria-label': label, 'aria-colcount': columns.length } }, head, this.#spacer, this.#layer);
    this.element.addEventListener('scroll', () => this.#scrolled(), { passive: true });
    // After a finger has moved by rows, the bar is put where these rows are.
    this.element.addEventListener('scrollend', () => this.#place());
    this.element.addEventListener('wheel', (event) => this.#wheel(event), { passive: false });
    this.element.addEventListener('keydown', (event) => this.#key(event));
    this.#layer.addEventListener('click', (event) => this.#click(event));
    this.#layer.addEventListener('dblclick', () => this.source.opened?.(this.#selected));
    new ResizeObserver(() => {
      this.#height = Math.max(0, this.element.clientHeight - HEAD);
      this.#layout();
    }).observe(this.element);
  }

  get selected(): number {
    return this.#selected;
  }

  /** First row in sight. */
  get top(): number {
    return Math.floor(this.#top);
  }

  get #page(): number {
    return Math.max(1, Math.floor(this.#height / this.rowHeight));
  }

  get #lastTop(): number {
    return Math.max(0, this.source.length() - this.#height / this.rowHeight);
  }

  get #full(): number {
    return this.source.length() * this.rowHeight;
  }

  /** The length or the content changed. */
  refresh(): void {
    if (this.#selected >= this.source.length()) this.#selected = this.source.length() - 1;
    this.#layout();
  }

  #layout(): void {
    this.#spacer.style.height = `${Math.min(this.#full, MAX_HEIGHT)}px`;
    this.element.setAttribute('aria-rowcount', String(this.source.length() + 1));
    this.scrollTo(this.#top);
    this.#schedule();
  }

  scrollTo(top: number): void {
    this.#top = Math.min(Math.max(0, top), this.#lastTop);
    this.#place();
    this.#schedule();
  }

  /** Puts the scroll bar where the rows are. */
  #place(): void {
    const range = Math.min(this.#full, MAX_HEIGHT) - this.#height;
    const position = this.#lastTop > 0 ? (this.#top / this.#lastTop) * range : 0;
    const rounded = this.#full <= MAX_HEIGHT ? this.#top * this.rowHeight : position;
    this.element.scrollTop = rounded;
    this.#expected = this.element.scrollTop;
    this.#lastScroll = this.element.scrollTop;
  }

  #scrolled(): void {
    const at = this.element.scrollTop;
    if (this.#expected !== null && Math.abs(at - this.#expected) < 1) return;
    this.#expected = null;
    const step = at - this.#lastScroll;
    this.#lastScroll = at;
    const range = this.element.scrollHeight - HEAD - this.#height;
    if (this.#full <= MAX_HEIGHT) this.#top = at / this.rowHeight;
    else if (at <= 0) this.#top = 0;
    else if (at >= range - 1) this.#top = this.#lastTop;
    // A finger moves by little and by little; the bar leaps.
    else if (Math.abs(step) < this.#height) this.#top += step / this.rowHeight;
    else this.#top = (at / range) * this.#lastTop;
    this.#top = Math.min(Math.max(0, this.#top), this.#lastTop);
    this.#schedule();
  }

  #wheel(event: WheelEvent): void {
    if (event.ctrlKey || event.deltaY === 0 || event.shiftKey) return;
    event.preventDefault();
    const pixels = event.deltaMode === 1 ? event.deltaY * this.rowHeight : event.deltaMode === 2 ? event.deltaY * this.#height : event.deltaY;
    this.scrollTo(this.#top + pixels / this.rowHeight);
  }

  select(index: number, show = true): void {
    const length = this.source.length();
    if (length === 0) return;
    const next = Math.min(Math.max(0, index), length - 1);
    const changed = next !== this.#selected;
    this.#selected = next;
    if (show) {
      const page = this.#page;
      if (next < this.#top || next >= this.#top + page) {
        const near = next < this.#top ? this.#top - next <= page : next - this.#top - page <= page;
        this.scrollTo(near ? (next < this.#top ? next : next - page + 1) : next - Math.floor(page / 2));
      }
    }
    this.#schedule();
    if (changed) this.source.selected?.(next);
  }

  #key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.altKey || event.metaKey || event.target !== this.element) return;
    const page = this.#page;
    const at = this.#selected < 0 ? Math.floor(this.#top) : this.#selected;
    const moves: Record<string, number> = { ArrowDown: at + 1, ArrowUp: at - 1, j: at + 1, k: at - 1, PageDown: at + page, PageUp: at - page, Home: 0, End: this.source.length() - 1 };
    const next = moves[event.key];
    if (next !== undefined) {
      event.preventDefault();
      this.select(this.#selected < 0 && event.key !== 'End' ? at : next);
    } else if (event.key === 'Enter' && this.#selected >= 0) {
      event.preventDefault();
      this.source.opened?.(this.#selected);
    }
  }

  #click(event: MouseEvent): void {
    const row = (event.target as Element).closest<HTMLElement>('.list-row');
    if (row?.dataset['index']) this.select(Number(row.dataset['index']), false);
  }

  #schedule(): void {
    if (this.#scheduled) return;
    this.#scheduled = true;
    requestAnimationFrame(() => {
      this.#scheduled = false;
      this.#draw();
    });
  }

  #draw(): void {
    const length = this.source.length();
    const first = Math.floor(this.#top);
    const shown = this.#height === 0 ? 0 : Math.min(Math.ceil(this.#height / this.rowHeight) + 1, length - first);
    while (this.#rows.length < shown) this.#rows.push(this.#makeRow(this.#rows.length));
    // The layer sticks to the viewport, so rows are placed against its edge and not in a space of millions of pixels.
    const offset = -(this.#top - first) * this.rowHeight;
    for (const [i, { row, cells }] of this.#rows.entries()) {
      if (i >= shown) {
        row.hidden = true;
        continue;
      }
      const index = first + i;
      row.hidden = false;
      row.style.transform = `translateY(${offset + i * this.rowHeight}px)`;
      row.dataset['index'] = String(index);
      row.setAttribute('aria-rowindex', String(index + 2));
      row.setAttribute('aria-selected', String(index === this.#selected));
      row.classList.toggle('selected', index === this.#selected);
      row.classList.toggle('pending', !this.source.fill(row, cells, index));
    }
    const active = this.#selected - first;
    if (active >= 0 && active < shown) this.element.setAttribute('aria-activedescendant', `${this.#prefix}-${active}`);
    else this.element.removeAttribute('aria-activedescendant');
    this.drawn++;
    this.element.dataset['drawn'] = String(this.drawn);
    if (shown > 0) this.source.visible?.(first, first + shown);
  }

  #makeRow(number: number): { row: HTMLElement; cells: HTMLElement[] } {
    const cells = this.columns.map((c) => el('div', { class: `cell ${c.class}`, attrs: { role: 'gridcell' } }));
    const row = el('div', { class: 'list-row', id: `${this.#prefix}-${number}`, attrs: { role: 'row' } }, ...cells);
    this.#layer.append(row);
    return { row, cells };
  }
}
