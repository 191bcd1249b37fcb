// Conversations: requests, answers and announcements as a list, and as a ladder between those who speak.

import type { ProtocolEvent, ProtocolNode } from '../api';
import type { App } from '../model/app';
import { clock, count, duration, plural, seconds } from '../model/format';
import { Latest } from '../model/latest';
import type { Commands } from '../ui/commands';
import { el, select, setText, svg } from '../ui/dom';
import { match } from '../ui/palette';
import { VirtualList } from '../ui/virtual-list';
import type { View } from './view';

const COLUMNS = [
  { name: 'Time / s', class: 'c-time' },
  { name: 'Took', class: 'c-period' },
  { name: 'Ch', class: 'c-channel' },
  { name: 'Protocol', class: 'c-protocol' },
  { name: 'Kind', class: 'c-protocol' },
  { name: 'From', class: 'c-party' },
  { name: 'To', class: 'c-party' },
  { name: 'What', class: 'c-what' },
];
const LADDER = [
  { name: 'Time / s', class: 'c-time' },
  { name: 'From → to', class: 'c-ladder' },
  { name: 'What', class: 'c-what' },
];

const NODES = [
  { name: 'Ch', class: 'c-channel' },
  { name: 'Protocol', class: 'c-protocol' },
  { name: 'Node', class: 'c-party' },
  { name: 'State', class: 'c-node-state' },
  { name: 'Since / s', class: 'c-time' },
  { name: 'Drive (CiA 402)', class: 'c-node-state' },
  { name: 'Since / s', class: 'c-time' },
  { name: 'Missed', class: 'c-count' },
  { name: 'Faults', class: 'c-count' },
  { name: 'Who it is, and trouble codes', class: 'c-what' },
];
const SHAPES = [
  ['ladder', 'ladder'],
  ['list', 'list'],
  ['nodes', 'nodes'],
] as [string, string][];

/** Seconds that are read of a live trace. */
const LIVE = 60;
/** More events than this are left out, and said so. */
const LIMIT = 100_000;
/** Pixels of a rung, and with its text below it. */
const RUNG = { wide: 26, narrow: 46 };
/** Lanes of the ladder; who speaks less often shares the last one. */
const LANES = 8;
/** As in `narrow.css`. */
const NARROW = '(max-width: 700px)';
const LADDER_WIDTH = { wide: 480, narrow: 200 };

export class ConversationsView implements View {
  readonly id = 'conversations';
  readonly title = 'Conversations';
  readonly element: HTMLElement;
  readonly #list: VirtualList;
  readonly #ladder: VirtualList;
  readonly #nodeList: VirtualList;
  readonly #lanes = el('div', { class: 'lanes', attrs: { 'aria-hidden': 'true' } });
  readonly #search = el('input', { attrs: { type: 'search', placeholder: 'Search conversations', 'aria-label': 'Search conversations', spellcheck: 'false' } });
  readonly #state = el('span', { class: 'state', attrs: { role: 'status' } });
  readonly #asking: Latest<null>;
  readonly #shape: HTMLSelectElement;
  #events: ProtocolEvent[] = [];
  #shown: ProtocolEvent[] = [];
  #nodes: ProtocolNode[] = [];
  #shownNodes: ProtocolNode[] = [];
  #notCounted = 0;
  #parties: string[] = [];
  #total = 0;
  #width = LADDER_WIDTH.wide;
  #visible = false;

  constructor(
    private readonly app: App,
    commands: Commands,
    private readonly lead: (view: string) => void,
  ) {
    this.#asking = new Latest(
      async () => {
        const { events, total, nodes, notCounted } = await app.ask('conversations', { from: app.live ? app.whole().to - LIVE : -Infinity, to: Infinity, limit: LIMIT });
        this.#events = events;
        this.#total = total;
        this.#nodes = nodes;
        this.#notCounted = notCounted;
        this.#arrange();
      },
      (error) => app.failed(error),
    );
    const opened = (index: number): void => {
      const event = this.#shown[index];
      if (!event) return;
      app.goto(event.time);
      this.lead('trace');
    };
    const lastChange = (index: number): void => {
      const node = this.#shownNodes[index];
      if (!node) return;
      app.goto(Math.max(node.stateSince ?? -Infinity, node.driveSince ?? -Infinity, node.stateSince === null && node.driveSince === null ? node.last : -Infinity));
      this.lead('trace');
    };
    const isNarrow = matchMedia(NARROW).matches;
    this.#list = new VirtualList('Conversations', COLUMNS, { length: () => this.#shown.length, fill: (row, cells, index) => this.#fill(row, cells, index), opened });
    this.#ladder = new VirtualList('Conversations as a ladder', LADDER, { length: () => this.#shown.length, fill: (row, cells, index) => this.#rung(row, cells, index), opened }, isNarrow ? RUNG.narrow : RUNG.wide);
    this.#nodeList = new VirtualList('Nodes', NODES, { length: () => this.#shownNodes.length, fill: (row, cells, index) => this.#fillNode(row, cells, index), opened: lastChange });
    this.#search.addEventListener('input', () => this.#arrange());
    this.#shape = select(
      SHAPES,
      'ladder',
      () => this.#shapeChanged(),
      'Shape',
    );
    this.element = el('section', { class: 'view view-conversations', attrs: { 'aria-label': 'Conversations' } }, el('div', { class: 'bar' }, this.#search, this.#shape, this.#state), this.#lanes, this.#ladder.element, this.#list.element, this.#nodeList.element);
    this.element.classList.toggle('two-lines', isNarrow);
    this.#shapeChanged();
    for (const topic of ['steady', 'messages'] as const) app.on(topic, () => this.#ask());
    commands.add(
      { id: 'conversations.search', title: 'Conversations: search', keys: ['/'], view: this.id, run: () => this.#search.focus() },
      {
        id: 'conversations.shape',
        title: 'Conversations: ladder, list or nodes',
        keys: ['l'],
        view: this.id,
        run: () => {
          const at = SHAPES.findIndex(([shape]) => shape === this.#shape.value);
          this.#shape.value = SHAPES[(at + 1) % SHAPES.length]?.[0] ?? 'ladder';
          this.#shapeChanged();
        },
      },
    );
  }

  shown(): void {
    this.#visible = true;
    this.#ask();
  }

  hidden(): void {
    this.#visible = false;
  }

  #ask(): void {
    if (this.#visible && this.app.summary && (this.app.live || !this.app.summary.growing)) this.#asking.ask(null);
  }

  #shapeChanged(): void {
    const shape = this.#shape.value;
    this.#list.element.hidden = shape !== 'list';
    this.#nodeList.element.hidden = shape !== 'nodes';
    this.#lanes.hidden = this.#ladder.element.hidden = shape !== 'ladder';
    this.#say();
    (shape === 'list' ? this.#list : shape === 'nodes' ? this.#nodeList : this.#ladder).refresh();
  }

  #arrange(): void {
    this.#width = matchMedia(NARROW).matches ? LADDER_WIDTH.narrow : LADDER_WIDTH.wide;
    this.element.style.setProperty('--ladder', `${this.#width}px`);
    const query = this.#search.value.trim();
    this.#shown = query === '' ? this.#events : this.#events.filter((e) => match(query, `${e.protocol} ${e.kind} ${e.from} ${e.to} ${e.text}`) !== null);
    const about = (n: ProtocolNode): string => `${n.protocol} ${n.node} ${n.state ?? ''} ${n.drive ?? ''} ${aboutNode(n)}`;
    this.#shownNodes = query === '' ? this.#nodes : this.#nodes.filter((n) => match(query, about(n)) !== null);
    const spoken = new Map<string, number>();
    for (const event of this.#shown) for (const party of [event.from, event.to]) if (party) spoken.set(party, (spoken.get(party) ?? 0) + 1);
    const ranked = [...spoken].sort((a, b) => b[1] - a[1]).map(([party]) => party);
    this.#parties = ranked.length > LANES ? [...ranked.slice(0, LANES - 1), `${ranked.length - LANES + 1} others`] : ranked;
    this.#lanes.replaceChildren(
      ...this.#parties.map((party, i) => {
        const label = el('span', { title: party }, party);
        label.style.left = `${this.#laneX(i)}px`;
        label.style.maxWidth = `${this.#width / Math.max(1, this.#parties.length) - 6}px`;
        return label;
      }),
    );
    this.#say();
    this.#list.refresh();
    this.#ladder.refresh();
    this.#nodeList.refresh();
  }

  #say(): void {
    if (this.#shape.value === 'nodes') {
      const more = this.#notCounted > 0 ? `; ${plural(this.#notCounted, 'event')} of others not counted, because there are too many nodes, services or objects` : '';
      setText(this.#state, `${count(this.#shownNodes.length)} of ${plural(this.#nodes.length, 'node')}, as they are at the end${this.app.live ? `, by the last ${LIVE} s` : ''}${more}`);
      return;
    }
    const left = this.#total - this.#events.length;
    setText(this.#state, `${count(this.#shown.length)} of ${plural(this.#total, 'event')}${this.app.live ? ` of the last ${LIVE} s` : ''}${left > 0 ? `; the last ${count(left)} are left out` : ''}${this.#clock()}`);
  }

  /** Whose clock measured how long they took. */
  #clock(): string {
    const long = this.#shown.filter((event) => event.end > event.time);
    const by = long.length > 0 ? clock(long.every((event) => event.took.byDevice), this.app.summary) : '';
    return by && `, measured ${by}`;
  }

  #laneX(i: number): number {
    return ((i + 0.5) * this.#width) / Math.max(1, this.#parties.length);
  }

  /** Where a party's lane is. Who is not known has none: what it says comes from the edge. */
  #lane(party: string): number {
    const at = this.#parties.indexOf(party);
    return at >= 0 ? at : this.#parties.length - 1;
  }

  #fill(row: HTMLElement, cells: HTMLElement[], index: number): boolean {
    const event = this.#shown[index];
    if (!event) return false;
    row.classList.toggle('failed', event.failed);
    const texts = [seconds(event.time), event.end > event.time ? duration(event.took.seconds) : '', String(event.channel), event.protocol, event.kind, event.from, event.to, event.text];
    for (const [i, text] of texts.entries()) setText(cells[i] as HTMLElement, text);
    return true;
  }

  #fillNode(row: HTMLElement, cells: HTMLElement[], index: number): boolean {
    const node = this.#shownNodes[index];
    if (!node) return false;
    row.classList.toggle('failed', node.missed > 0 || node.faults > 0);
    const since = (time: number | null): string => (time === null ? '' : seconds(time));
    const texts = [String(node.channel), node.protocol, node.node, node.state ?? '', since(node.stateSince), node.drive ?? '', since(node.driveSince), count(node.missed), count(node.faults), aboutNode(node)];
    for (const [i, text] of texts.entries()) setText(cells[i] as HTMLElement, text);
    return true;
  }

  #rung(row: HTMLElement, cells: HTMLElement[], index: number): boolean {
    const event = this.#shown[index];
    if (!event) return false;
    row.classList.toggle('failed', event.failed);
    const [time, rung, what] = cells as [HTMLElement, HTMLElement, HTMLElement];
    setText(time, seconds(event.time));
    setText(what, `${event.kind}: ${event.text}${event.end > event.time ? ` (${duration(event.took.seconds)})` : ''}`);
    const key = `${index} ${event.time} ${event.from} ${event.to} ${this.#parties.length}`;
    if (rung.dataset['key'] === key) return true;
    rung.dataset['key'] = key;
    const from = event.from === '' ? 1 : this.#laneX(this.#lane(event.from));
    const to = event.to ? this.#laneX(this.#lane(event.to)) : null;
    const lines = this.#parties.map((_, i) => svg('line', { x1: this.#laneX(i), x2: this.#laneX(i), y1: 0, y2: 26, class: 'lane' }));
    const arrow =
      to === null || to === from
        ? [svg('circle', { cx: from, cy: 13, r: 4, class: 'arrow' })]
        : [svg('line', { x1: from, x2: to, y1: 13, y2: 13, class: event.from === '' ? 'arrow unknown' : 'arrow' }), svg('path', { d: `M${to} 13l${to > from ? -7 : 7} -4v8z`, class: 'arrow head' })];
    rung.replaceChildren(svg('svg', { width: this.#width, height: 26, role: 'img', 'aria-label': event.to ? `${event.from || 'unknown'} to ${event.to}` : event.from || 'unknown' }, ...lines, ...arrow));
    return true;
  }
}

/** Who a node is, and its trouble codes. */
function aboutNode(node: ProtocolNode): string {
  return [node.identity ?? '', ...Object.entries(node.codes).map(([list, codes]) => `${list}: ${codes}`)].filter((text) => text !== '').join('; ');
}
