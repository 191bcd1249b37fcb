// One identifier's periods: figures and a histogram.

import type { Answer } from '../api';
import type { App } from '../model/app';
import { clock, count, duration, idText, percent } from '../model/format';
import type { Commands } from '../ui/commands';
import { el, replace } from '../ui/dom';
import { readColours } from '../graph/colours';
import { CanvasPen } from '../graph/pen';
import { facts } from './summary';
import { OfIdentifier } from './of-identifier';
import type { View } from './view';

type Periods = Answer<'periods'>;

export class StatisticsView implements View {
  readonly id = 'statistics';
  readonly title = 'Periods';
  readonly element: HTMLElement;
  readonly #chosen: OfIdentifier;
  readonly #figures = el('div', { class: 'figures' });
  readonly #canvas = el('canvas', { class: 'histogram', attrs: { role: 'img' } });
  readonly #table = el('div', { class: 'scroll', attrs: { tabindex: 0, role: 'group', 'aria-label': 'Histogram as numbers' } });
  #periods: Periods | null = null;

  constructor(
    private readonly app: App,
    commands: Commands,
  ) {
    this.#chosen = new OfIdentifier(app, () => this.#fetch());
    const bar = el('div', { class: 'bar' }, ...this.#chosen.controls);
    this.element = el('section', { class: 'view view-statistics', attrs: { 'aria-label': 'Periods' } }, bar, el('div', { class: 'page-scroll', attrs: { tabindex: 0, role: 'group', 'aria-label': 'Figures' } }, this.#figures, this.#canvas, this.#table));
    app.on('profile', () => this.#draw());
    new ResizeObserver(() => this.#draw()).observe(this.#canvas);
    commands.add(...this.#chosen.commands(this.id, this.title));
  }

  shown(): void {
    this.#chosen.shown();
  }

  hidden(): void {
    this.#chosen.hidden();
  }

  async #fetch(): Promise<void> {
    const chosen = this.app.identifier;
    if (!chosen) return;
    const periods = await this.app.ask('periods', chosen);
    this.#periods = periods;
    const total = periods.counts.reduce((sum, n) => sum + n, 0);
    const name = idText(chosen.id, chosen.extended);
    const by = clock(periods.byDevice, this.app.summary);
    const frames = this.#chosen.picker.row?.count;
    replace(
      this.#figures,
      el('h3', {}, `Periods of ${name} on channel ${chosen.channel}`),
      total === 0
        ? el('p', {}, 'Fewer than two frames: there is no period.')
        : facts([
            ...(frames === undefined ? [] : [['Frames', count(frames)] as [string, string]]),
            ['Periods', count(total)],
            ['Mean', duration(periods.mean)],
            ['Smallest', duration(periods.min)],
            ['Largest', duration(periods.max)],
            ['Standard deviation', duration(periods.deviation)],
            ...(by ? [['Measured', by] as [string, string]] : []),
          ]),
    );
    this.#canvas.setAttribute('aria-label', `Histogram of the periods of ${name}: the numbers stand below`);
    replace(
      this.#table,
      el(
        'table',
        { class: 'numbers' },
        el('thead', {}, el('tr', {}, ...['from', 'to', 'periods', 'share'].map((h) => el('th', { attrs: { scope: 'col' } }, h)))),
        el('tbody', {}, ...[...periods.counts].map((n, i) => (n === 0 ? null : el('tr', {}, el('td', {}, duration(periods.edges[i] as number)), el('td', {}, duration(periods.edges[i + 1] as number)), el('td', {}, count(n)), el('td', {}, percent(n / total)))))),
      ),
    );
    this.#draw();
  }

  #draw(): void {
    const periods = this.#periods;
    const { clientWidth: width, clientHeight: height } = this.#canvas;
    if (!periods || width === 0 || height === 0) return;
    this.#canvas.width = width * devicePixelRatio;
    this.#canvas.height = height * devicePixelRatio;
    const context = this.#canvas.getContext('2d');
    if (!context) return;
    context.scale(devicePixelRatio, devicePixelRatio);
    drawHistogram(new CanvasPen(context), periods, width, height, readColours(this.#canvas));
  }
}

/** Bars by the square root of their counts, so that a single late frame among a million is still seen. */
function drawHistogram(pen: CanvasPen, { edges, counts }: Periods, width: number, height: number, colours: ReturnType<typeof readColours>): void {
  pen.rect(0, 0, width, height, colours.background);
  const most = counts.reduce((a, b) => Math.max(a, b), 0);
  const from = edges[0] as number;
  const to = edges[edges.length - 1] as number;
  if (most === 0 || !(to > from)) return;
  const bottom = height - 22;
  const left = 66;
  const x = (t: number): number => left + ((t - from) / (to - from)) * (width - left - 12);
  for (const share of [0.01, 0.1, 0.25, 0.5, 1]) {
    const y = Math.round(bottom - Math.sqrt(share) * (bottom - 12)) + 0.5;
    if (share * most < 1) continue;
    pen.line([left, y, width - 12, y], colours.grid, 1);
    pen.text(count(share * most), left - 6, y, { colour: colours.text, align: 'right', size: 10 });
  }
  for (const [i, n] of counts.entries()) {
    if (n === 0) continue;
    const start = x(edges[i] as number);
    const bar = Math.max(2, Math.sqrt(n / most) * (bottom - 12));
    pen.rect(start, bottom - bar, Math.max(1, x(edges[i + 1] as number) - start - 1), bar, colours.lines[0] ?? 'gray');
  }
  pen.line([left, bottom + 0.5, width - 12, bottom + 0.5], colours.axis, 1);
  for (let i = 0; i <= 4; i++) {
    const t = from + ((to - from) * i) / 4;
    pen.text(duration(t), x(t), height - 10, { colour: colours.text, align: i === 0 ? 'left' : i === 4 ? 'right' : 'center', size: 11 });
  }
  pen.text('periods', left - 6, height - 10, { colour: colours.text, align: 'right', size: 10 });
}
