// Graphs of signals and of bus load: panels one above the other over one axis of time.

import type { App } from '../model/app';
import { clock, duration, quantity, seconds } from '../model/format';
import { type Item, type Panel, itemLabel, itemTexts, itemUnit } from '../model/panels';
import type { Commands } from '../ui/commands';
import { button, el, replace, select, setText } from '../ui/dom';
import { CursorValues } from '../graph/cursor-values';
import { readColours } from '../graph/colours';
import { type Colours, type Sheet, type Trace, drawPanel, drawTimeAxis, isDigital } from '../graph/draw';
import { GraphPointer } from '../graph/pointer';
import { CanvasPen } from '../graph/pen';
import { saveCsv, savePng, saveSvg } from '../graph/save-picture';
import { SeriesCache, valueAt } from '../graph/series-cache';
import { SignalTree, droppedItem } from '../graph/tree';
import type { View } from './view';

const AXIS_HEIGHT = 24;

interface Shown {
  panel: Panel;
  element: HTMLElement;
  canvas: HTMLCanvasElement;
  legend: { item: Item; colour: HTMLElement; a: HTMLElement; b: HTMLElement; delta: HTMLElement }[];
}

export class GraphsView implements View {
  readonly id = 'graphs';
  readonly title = 'Graphs';
  readonly element: HTMLElement;
  readonly #tree: SignalTree;
  readonly #cache: SeriesCache;
  readonly #panels = el('div', { class: 'panels' });
  readonly #axis = el('canvas', { class: 'time-axis', attrs: { 'aria-hidden': 'true' } });
  readonly #state = el('span', { class: 'state mono', attrs: { role: 'status' } });
  readonly #pointer: GraphPointer;
  readonly #exact: CursorValues;
  #shown: Shown[] = [];
  #visible = false;
  #scheduled = false;
  #hover: number | null = null;
  #zoomBox: { from: number; to: number } | null = null;
  /** How often the graphs were drawn: what a test and a measurement count. */
  drawn = 0;

  constructor(
    private readonly app: App,
    commands: Commands,
  ) {
    this.#cache = new SeriesCache(app, () => this.redraw());
    this.#exact = new CursorValues(app, () => this.redraw());
    this.#tree = new SignalTree(app, () => undefined);
    this.#pointer = new GraphPointer(app, {
      hover: (time) => {
        this.#hover = time;
        this.redraw();
      },
      box: (box) => {
        this.#zoomBox = box;
        this.redraw();
      },
    });
    const pan = (share: number) => () => this.#pan(share);
    const bar = el(
      'div',
      { class: 'bar' },
      button('Fit', () => app.fit(), { title: 'Everything in sight (0)' }),
      button('−', () => this.#zoom(2), { title: 'Zoom out (−)', attrs: { 'aria-label': 'Zoom out' } }),
      button('+', () => this.#zoom(0.5), { title: 'Zoom in (+)', attrs: { 'aria-label': 'Zoom in' } }),
      button('←', pan(-0.25), { title: 'Earlier (←)', attrs: { 'aria-label': 'Earlier' } }),
      button('→', pan(0.25), { title: 'Later (→)', attrs: { 'aria-label': 'Later' } }),
      button('Undo zoom', () => app.unzoom(), { title: 'Undo zoom (Backspace)' }),
      button('PNG', () => this.#save('png'), { title: 'Save as PNG' }),
      button('SVG', () => this.#save('svg'), { title: 'Save as SVG' }),
      button('CSV', () => this.#save('csv'), { title: 'Save the columns in sight as CSV' }),
      this.#state,
    );
    const stack = el('div', { class: 'graph-stack', attrs: { tabindex: 0, role: 'group', 'aria-label': 'Graphs: arrows pan, plus and minus zoom' } }, this.#panels, this.#axis);
    this.element = el('section', { class: 'view view-graphs', attrs: { 'aria-label': 'Graphs' } }, bar, el('div', { class: 'split graphs-split' }, this.#tree.element, stack));
    this.#pointer.attach(this.#axis);
    this.#acceptDrops(this.#panels, null);
    this.#panels.addEventListener('scroll', () => this.redraw(), { passive: true });
    new ResizeObserver(() => this.redraw()).observe(stack);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.redraw());
    app.on('panels', () => this.#rebuild());
    app.on('range', () => this.redraw());
    app.on('cursors', () => this.redraw());
    app.on('notes', () => this.redraw());
    app.on('profile', () => this.redraw());
    for (const topic of ['messages', 'fields'] as const) {
      app.on(topic, () => {
        this.#cache.clear();
        this.#exact.clear();
        this.redraw();
      });
    }
    let serial = app.serial;
    app.on('summary', () => {
      // Of a trace that has grown, what is drawn stays until the rest is there.
      if (serial === app.serial) this.#cache.outdate();
      else this.#cache.clear();
      serial = app.serial;
      this.#exact.clear();
      this.redraw();
    });
    const cursor = (which: 'A' | 'B') => () => app.setCursor(which, this.#hover ?? (app.range.from + app.range.to) / 2);
    commands.add(
      { id: 'graphs.fit', title: 'Graphs: everything in sight', keys: ['0'], view: this.id, run: () => app.fit() },
      { id: 'graphs.in', title: 'Graphs: zoom in', keys: ['+', '='], view: this.id, run: () => this.#zoom(0.5) },
      { id: 'graphs.out', title: 'Graphs: zoom out', keys: ['-'], view: this.id, run: () => this.#zoom(2) },
      { id: 'graphs.left', title: 'Graphs: earlier', keys: ['ArrowLeft'], view: this.id, run: pan(-0.25) },
      { id: 'graphs.right', title: 'Graphs: later', keys: ['ArrowRight'], view: this.id, run: pan(0.25) },
      { id: 'graphs.unzoom', title: 'Graphs: undo zoom', keys: ['Backspace', 'Ctrl+z'], view: this.id, run: () => app.unzoom() },
      { id: 'graphs.rezoom', title: 'Graphs: redo zoom', keys: ['Shift+Backspace', 'Ctrl+Shift+z', 'Ctrl+y'], view: this.id, run: () => app.rezoom() },
      { id: 'graphs.a', title: 'Graphs: put cursor A', keys: ['a'], view: this.id, run: cursor('A') },
      { id: 'graphs.b', title: 'Graphs: put cursor B', keys: ['b'], view: this.id, run: cursor('B') },
      { id: 'graphs.a-left', title: 'Graphs: cursor A earlier', keys: ['['], view: this.id, run: () => this.#nudge(-1) },
      { id: 'graphs.a-right', title: 'Graphs: cursor A later', keys: [']'], view: this.id, run: () => this.#nudge(1) },
      { id: 'graphs.marked', title: 'Graphs: zoom to between the cursors', keys: ['m'], view: this.id, run: () => app.marked && app.look(app.marked) },
      { id: 'graphs.nocursors', title: 'Graphs: take the cursors away', keys: ['Escape'], view: this.id, run: () => (app.setCursor('A', null), app.setCursor('B', null)) },
      { id: 'graphs.search', title: 'Graphs: search signals', keys: ['/'], view: this.id, run: () => this.#tree.focus() },
      { id: 'graphs.clear', title: 'Graphs: take all graphs away', view: this.id, run: () => app.panels.clear() },
      { id: 'graphs.png', title: 'Graphs: save as PNG', view: this.id, run: () => this.#save('png') },
      { id: 'graphs.svg', title: 'Graphs: save as SVG', view: this.id, run: () => this.#save('svg') },
      { id: 'graphs.csv', title: 'Graphs: save the columns in sight as CSV', view: this.id, run: () => this.#save('csv') },
    );
  }

  shown(): void {
    this.#visible = true;
    this.#tree.show();
    this.#rebuild();
  }

  hidden(): void {
    this.#visible = false;
  }

  redraw(): void {
    if (this.#scheduled || !this.#visible) return;
    this.#scheduled = true;
    requestAnimationFrame(() => {
      this.#scheduled = false;
      this.#draw();
    });
  }

  #zoom(factor: number): void {
    const { from, to } = this.app.range;
    const centre = this.#hover ?? (from + to) / 2;
    this.app.look({ from: centre - (centre - from) * factor, to: centre + (to - centre) * factor });
  }

  #pan(share: number): void {
    const { from, to } = this.app.range;
    const by = (to - from) * share;
    this.app.look({ from: from + by, to: to + by });
  }

  #nudge(by: number): void {
    const { from, to } = this.app.range;
    if (this.app.cursorA !== null) this.app.setCursor('A', Math.min(to, Math.max(from, this.app.cursorA + (by * (to - from)) / 200)));
  }

  #rebuild(): void {
    if (!this.#visible) return;
    const { panels } = this.app;
    this.#shown = panels.list.map((panel) => this.#makePanel(panel));
    replace(this.#panels, ...this.#shown.map((s) => s.element), panels.list.length === 0 ? el('p', { class: 'empty' }, 'Choose signals from the tree, or drag them here.') : null);
    this.redraw();
  }

  #makePanel(panel: Panel): Shown {
    const { panels } = this.app;
    const legend = panel.items.map((item) => ({ item, colour: el('span', { class: 'swatch' }), a: el('span', { class: 'mono' }), b: el('span', { class: 'mono' }), delta: el('span', { class: 'mono' }) }));
    const entries = legend.map(({ item, colour, a, b, delta }) => {
      const entry = el('span', { class: 'legend', attrs: { draggable: 'true' } }, colour, el('span', { class: 'legend-name', title: itemLabel(item) }, itemLabel(item)), el('span', { class: 'muted legend-unit' }, itemUnit(item)), a, b, delta, button('×', () => panels.removeItem(panel, item), { class: 'icon', attrs: { 'aria-label': `Take ${itemLabel(item)} away` } }));
      entry.addEventListener('dragstart', (event) => {
        this.#carried = { panel, item };
        event.dataTransfer?.setData('text/plain', itemLabel(item));
      });
      entry.addEventListener('dragend', () => (this.#carried = null));
      return entry;
    });
    const at = panels.list.indexOf(panel);
    const name = panel.items.map(itemLabel).join(', ');
    const tools = el(
      'span',
      { class: 'panel-tools' },
      select(
        [
          ['step', 'step'],
          ['line', 'line'],
          ['points', 'points'],
        ],
        panel.style,
        (value) => panels.setStyle(panel, value === 'line' || value === 'points' ? value : 'step'),
        `Style of ${name}`,
      ),
      at > 0 ? button('Merge ↑', () => panels.mergeUp(panel), { title: 'Join with the graph above', attrs: { 'aria-label': `Join ${name} with the graph above` } }) : null,
      panel.items.length > 1 ? button('Split', () => panels.split(panel), { title: 'A graph for each', attrs: { 'aria-label': `Split ${name}` } }) : null,
      at > 0 ? button('↑', () => panels.movePanel(panel, -1), { class: 'icon', attrs: { 'aria-label': `Move ${name} up` } }) : null,
    );
    const canvas = el('canvas', { attrs: { role: 'img', 'aria-label': `Graph of ${name}` } });
    const element = el('div', { class: 'panel' }, el('div', { class: 'panel-head' }, ...entries, tools), el('div', { class: 'panel-canvas' }, canvas));
    this.#pointer.attach(canvas);
    this.#acceptDrops(element, panel);
    return { panel, element, canvas, legend };
  }

  #carried: { panel: Panel; item: Item } | null = null;

  #acceptDrops(element: HTMLElement, panel: Panel | null): void {
    element.addEventListener('dragover', (event) => {
      event.preventDefault();
      element.classList.add('drop');
    });
    element.addEventListener('dragleave', () => element.classList.remove('drop'));
    element.addEventListener('drop', (event) => {
      element.classList.remove('drop');
      if (event.dataTransfer?.types.includes('Files')) return;
      event.preventDefault();
      event.stopPropagation();
      const { panels } = this.app;
      if (this.#carried) {
        const { panel: from, item } = this.#carried;
        if (panel) panels.moveItem(from, item, panel);
        else if (from.items.length > 1) {
          panels.removeItem(from, item);
          panels.add(item);
        }
        return;
      }
      const item = droppedItem(event.dataTransfer, this.app);
      if (item) panels.add(item, panel);
    });
  }

  #sheet(shown: Shown, number: number, colours: Colours, width: number, height: number): Sheet {
    const { app } = this;
    const scale = devicePixelRatio;
    const traces = shown.panel.items.map(
      (item, i): Trace => ({
        label: itemLabel(item),
        unit: itemUnit(item),
        colour: colours.lines[(number + i) % colours.lines.length] ?? 'gray',
        series: this.#cache.get(item, app.range, Math.max(100, Math.min(2000, width * scale))),
        texts: itemTexts(item),
        alarms: item.kind === 'signal' ? (item.info?.alarms ?? null) : null,
        limits: item.kind === 'signal' && item.info ? [item.info.min, item.info.max].filter((v): v is number => v !== null) : [],
      }),
    );
    return {
      width,
      height,
      range: app.range,
      traces,
      style: shown.panel.style,
      gaps: app.gaps,
      cursorA: app.cursorA,
      cursorB: app.cursorB,
      hover: this.#hover,
      zoomBox: this.#zoomBox,
      notes: app.notes.flatMap((n) => (n.time === null ? [] : [{ time: n.time }])),
      colours,
    };
  }

  #sheets(): { sheets: Sheet[]; colours: Colours } {
    const colours = readColours(this.element);
    let number = 0;
    const sheets = this.#shown.map((shown) => {
      const sheet = this.#sheet(shown, number, colours, shown.canvas.clientWidth, shown.canvas.clientHeight);
      number += shown.panel.items.length;
      return sheet;
    });
    return { sheets, colours };
  }

  #draw(): void {
    const { app } = this;
    const { sheets, colours } = this.#sheets();
    // Graphs that are scrolled out of sight are not drawn; a scroll draws them.
    const frame = this.#panels.getBoundingClientRect();
    const inSight = this.#shown.map(({ element }) => {
      const { top, bottom } = element.getBoundingClientRect();
      return bottom >= frame.top && top <= frame.bottom;
    });
    for (const [i, sheet] of sheets.entries()) {
      const shown = this.#shown[i] as Shown;
      if (!inSight[i]) continue;
      const digital = isDigital(sheet.traces);
      shown.element.style.setProperty('--panel-min', digital ? `${sheet.traces.length * 32 + 4}px` : '110px');
      shown.element.classList.toggle('digital', digital);
      const context = prepare(shown.canvas);
      if (context) drawPanel(new CanvasPen(context), sheet);
      this.#drawLegend(shown, sheet);
    }
    const context = prepare(this.#axis);
    if (context) {
      const marks = [
        ...(app.cursorA === null ? [] : [{ time: app.cursorA, label: 'A', colour: colours.cursorA }]),
        ...(app.cursorB === null ? [] : [{ time: app.cursorB, label: 'B', colour: colours.cursorB }]),
      ];
      drawTimeAxis(new CanvasPen(context), this.#axis.clientWidth, AXIS_HEIGHT, app.range, colours, marks);
    }
    this.#drawState();
    this.drawn++;
    this.element.dataset['drawn'] = String(this.drawn);
    this.element.dataset['busy'] = String(this.#cache.busy);
    this.element.dataset['from'] = String(app.range.from);
    this.element.dataset['to'] = String(app.range.to);
  }

  #drawLegend(shown: Shown, sheet: Sheet): void {
    const { cursorA, cursorB } = this.app;
    for (const [i, entry] of shown.legend.entries()) {
      const trace = sheet.traces[i] as Trace;
      entry.colour.style.background = trace.colour;
      const failure = this.#cache.failure(entry.item);
      if (failure !== null || ('info' in entry.item && entry.item.info === null)) {
        setText(entry.a, failure ?? (entry.item.kind === 'signal' ? 'no database has it' : this.app.fields.reading ? 'is looked for' : 'no message has it'));
        continue;
      }
      const write = (value: number): string => trace.texts.find((t) => t.value === value)?.text ?? quantity(value, trace.unit, entry.item.kind === 'load' ? 4 : undefined);
      const at = (cursor: 'A' | 'B', time: number | null): number | null => {
        if (time === null || !trace.series) return null;
        const exact = this.#exact.get(entry.item, cursor, time);
        const drawn = valueAt(trace.series, time);
        return exact !== undefined ? exact : drawn && drawn.min === drawn.max ? drawn.min : null;
      };
      const a = at('A', cursorA);
      const b = at('B', cursorB);
      const hover = cursorA === null && this.#hover !== null && trace.series ? valueAt(trace.series, this.#hover) : null;
      setText(entry.a, a !== null ? `A ${write(a)}` : hover ? (hover.min === hover.max ? write(hover.min) : `${quantity(hover.min, '', 7)} … ${quantity(hover.max, trace.unit, 7)}`) : '');
      setText(entry.b, b !== null ? `B ${write(b)}` : '');
      setText(entry.delta, a !== null && b !== null ? `Δy ${quantity(b - a, trace.unit, entry.item.kind === 'load' ? 4 : 12)}` : '');
    }
  }

  #drawState(): void {
    const { range, cursorA, cursorB } = this.app;
    const parts = [`${seconds(range.from)} s … ${seconds(range.to)} s`, duration(range.to - range.from)];
    if (this.#hover !== null) parts.push(`at ${seconds(this.#hover)} s`);
    if (cursorA !== null) parts.push(`A ${seconds(cursorA)} s`);
    if (cursorB !== null) parts.push(`B ${seconds(cursorB)} s`);
    const apart = cursorA !== null && cursorB !== null && cursorA !== cursorB ? this.#exact.interval(cursorA, cursorB) : null;
    if (apart) parts.push(`Δt ${seconds(apart.seconds)} s (${quantity(1 / Math.abs(apart.seconds), 'Hz', 7)}) ${clock(apart.byDevice, this.app.summary)}`.trim());
    setText(this.#state, parts.join('   '));
  }

  #save(format: 'png' | 'svg' | 'csv'): void {
    const { sheets, colours } = this.#sheets();
    if (sheets.length === 0) {
      this.app.notify('info', 'There is no graph to save: choose a signal first.');
      return;
    }
    const name = `${this.app.summary?.name ?? 'graphs'}.${format}`;
    try {
      if (format === 'png') savePng(name, sheets, colours);
      else if (format === 'svg') saveSvg(name, sheets, colours);
      else saveCsv(name, sheets);
    } catch (error) {
      this.app.failed(error);
    }
  }
}

/** A canvas as large as it is shown, in device pixels. */
function prepare(canvas: HTMLCanvasElement): CanvasRenderingContext2D | null {
  const width = Math.round(canvas.clientWidth * devicePixelRatio);
  const height = Math.round(canvas.clientHeight * devicePixelRatio);
  if (width === 0 || height === 0) return null;
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  const context = canvas.getContext('2d', { alpha: false });
  context?.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
  return context;
}
