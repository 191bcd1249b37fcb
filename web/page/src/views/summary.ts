// The first page: what was recorded, what was lost, what was found.

import type { Finding, Summary } from '../api';
import type { App } from '../model/app';
import { unpack } from '../model/report';
import { saveBlob } from '../model/files';
import { bitrate, count, duration, idText, missing, percent, plural, seconds, utc } from '../model/format';
import type { Commands } from '../ui/commands';
import { openDialog } from '../ui/dialog';
import { button, el, field, replace } from '../ui/dom';
import type { View } from './view';

export class SummaryView implements View {
  readonly id = 'summary';
  readonly title = 'Summary';
  readonly element = el('section', { class: 'view view-summary', attrs: { 'aria-label': 'Summary', tabindex: 0 } });

  constructor(
    private readonly app: App,
    commands: Commands,
    private readonly lead: (view: string) => void,
  ) {
    for (const topic of ['steady', 'findings', 'messages', 'notes'] as const) app.on(topic, () => !this.element.hidden && this.#draw());
    commands.add({ id: 'summary.bitrate', title: 'Set a channel’s bit rate', run: () => this.#askBitrate(this.app.summary?.channels[0]?.channel ?? 1) });
  }

  shown(): void {
    this.#draw();
  }

  #draw(): void {
    const { app } = this;
    const { summary, report } = app;
    if (!summary) return;
    // Live, it is drawn each second: whoever is at a button by the keyboard stays there.
    const buttons = (): HTMLElement[] => [...this.element.querySelectorAll('button')];
    const focused = buttons().indexOf(document.activeElement as HTMLElement);
    replace(
      this.element,
      el('h2', {}, report?.title ?? summary.name),
      report ? this.#reportFacts() : null,
      el('div', { class: 'columns' }, el('div', {}, section('Trace', facts(this.#traceFacts(summary))), section('Channels', this.#channels(summary)), section('Losses', this.#losses(summary))), el('div', {}, section(app.findings === null ? 'Findings' : `Findings (${count(app.findings.length)})`, this.#findings(summary)), section('Databases', this.#databases()))),
    );
    if (focused >= 0) buttons()[focused]?.focus({ preventScroll: true });
  }

  #traceFacts(summary: Summary): [string, string][] {
    return [
      ['File', summary.name],
      ['Format', summary.format],
      ...(summary.startUtcNs ? [['Start', `${utc(summary.startUtcNs, 0)} UTC`] as [string, string]] : []),
      ['Length', duration(summary.duration)],
      ['Frames', count(summary.frames)],
      ['Records', count(summary.records + summary.forgotten)],
      ...(summary.forgotten > 0 ? [['Kept', `the newest ${count(summary.records)}, from ${seconds(summary.begin)} s on`] as [string, string]] : []),
      ...(summary.growing ? [['Read', summary.progress === null ? 'live' : percent(summary.progress)] as [string, string]] : []),
      ...summary.issues.map((issue): [string, string] => ['Not read', `${issue.text}${issue.count > 1 ? ` (${plural(issue.count, 'time')})` : ''}`]),
    ];
  }

  #channels(summary: Summary): HTMLElement {
    const head = ['Channel', 'Frames', 'Load', 'Bit rate', 'Errors', 'Sent', 'Remote'];
    return el(
      'div',
      { class: 'scroll', attrs: { tabindex: 0, role: 'group', 'aria-label': 'Channels' } },
      el(
        'table',
        { class: 'numbers' },
        el('thead', {}, el('tr', {}, ...head.map((h) => el('th', { attrs: { scope: 'col' } }, h)))),
        el(
          'tbody',
          {},
          ...summary.channels.map((c) =>
            el(
              'tr',
              {},
              el('th', { attrs: { scope: 'row' } }, String(c.channel)),
              el('td', {}, count(c.frames)),
              el('td', {}, percent(c.load)),
              el('td', {}, button(bitrate(c.bitrate), () => this.#askBitrate(c.channel), { class: 'link', title: 'Set the bit rate', attrs: { 'aria-label': `Bit rate of channel ${c.channel}: ${bitrate(c.bitrate)}, change` } })),
              el('td', { class: c.errors > 0 ? 'bad' : '' }, count(c.errors)),
              el('td', {}, count(c.sent)),
              el('td', {}, count(c.remote)),
            ),
          ),
        ),
      ),
    );
  }

  #losses(summary: Summary): HTMLElement {
    if (summary.losses.length === 0) return el('p', {}, 'None is known: every stage of the recording counted 0, or the format cannot tell.');
    return el(
      'ul',
      { class: 'plain' },
      ...summary.losses.map((l) => el('li', { class: l.count > 0 || l.atLeast ? 'bad' : '' }, `${l.stage === 'unknown' ? 'at an unknown stage' : l.stage}${l.channel === null ? '' : `, channel ${l.channel}`}: ${missing(l.count, l.atLeast)}`)),
    );
  }

  /** Nothing found and nothing looked for are two things. */
  #findings(summary: Summary): HTMLElement {
    const { app } = this;
    const { findings } = app;
    const isLive = summary.growing && summary.progress === null;
    const look = (label: string): HTMLElement => button(label, () => void app.lookForFindings(), { id: 'find-findings' });
    if (findings === null) return isLive ? el('div', {}, el('p', {}, 'Of a live trace they are looked for when you ask.'), look('Look for findings')) : el('p', {}, 'They are looked for when the whole file was read.');
    return el(
      'div',
      {},
      findings.length === 0 ? el('p', {}, 'Nothing stood out.') : el('ol', { class: 'findings' }, ...findings.map((finding) => el('li', { class: finding.severity }, this.#finding(finding)))),
      isLive ? el('p', { class: 'muted' }, `Of the time up to ${seconds(app.findingsUntil)} s. `, look('Look again')) : null,
    );
  }

  #finding(finding: Finding): HTMLElement {
    const place = [finding.time === null ? '' : `${seconds(finding.time)} s`, finding.channel === null ? '' : `channel ${finding.channel}`, finding.id === null ? '' : idText(finding.id, finding.extended)].filter(Boolean).join(', ');
    return el('span', {}, el('b', { class: 'severity' }, finding.severity), ' ', finding.text, ' ', finding.time !== null || finding.id !== null ? button(place, () => this.#follow(finding), { class: 'link mono' }) : null);
  }

  #follow(finding: Finding): void {
    if (finding.id !== null && finding.channel !== null) this.app.choose({ channel: finding.channel, id: finding.id, extended: finding.extended });
    if (finding.time !== null) {
      this.app.goto(finding.time);
      this.lead('trace');
    } else this.lead('statistics');
  }

  #databases(): HTMLElement {
    const { databases, messages } = this.app;
    if (databases.length === 0) return el('p', {}, 'None. Drop a DBC, KCD, SYM, ARXML or DBF file anywhere on this page.');
    const seen = messages.filter((m) => m.count > 0).length;
    return el('div', {}, el('ul', { class: 'plain' }, ...databases.map(({ name, channel }) => el('li', {}, channel === null ? name : `${name}, channel ${channel}`))), el('p', {}, `${plural(messages.length, 'message')}, ${count(seen)} of them in this trace.`));
  }

  #reportFacts(): HTMLElement {
    const { report } = this.app;
    if (!report) return el('p');
    return el(
      'div',
      { class: 'report-facts' },
      report.created || report.command ? el('p', { class: 'muted' }, [report.created.replace(/^(\S+)T(\S+)Z$/, 'made $1 $2 UTC'), report.command].filter(Boolean).join(' · ')) : null,
      ...report.notes.map((text) => el('p', { class: 'report-note' }, text)),
      ...report.thinned.map((text) => el('p', { class: 'bad' }, text)),
      button('Save the trace', () => void this.#saveTrace(), { title: 'The file as it was, byte for byte' }),
    );
  }

  async #saveTrace(): Promise<void> {
    const { report } = this.app;
    if (!report) return;
    try {
      saveBlob(report.trace.name, await unpack(report.trace));
    } catch (error) {
      this.app.failed(error);
    }
  }

  #askBitrate(channel: number): void {
    const input = el('input', { class: 'mono', attrs: { type: 'text', 'aria-label': 'Bit rate', value: this.app.summary?.channels.find((c) => c.channel === channel)?.bitrate ?? 500000, inputmode: 'decimal' } });
    const problem = el('p', { class: 'bad', attrs: { role: 'alert' } });
    openDialog(`Bit rate of channel ${channel}`, [field('Bit/s', input, 'for example 500000, 500k, 1M'), problem], [
      {
        label: 'Set',
        primary: true,
        run: () => {
          const value = parseRate(input.value);
          if (value === null) {
            problem.textContent = `“${input.value}” is no bit rate: write for example 500k.`;
            return false;
          }
          void this.app.setBitrate(channel, value);
          return true;
        },
      },
      { label: 'Cancel' },
    ]);
    input.select();
  }
}

/** A rate as in docs/grammar.md: `500000`, `500k`, `0.5M`, `500kbit/s`. */
export function parseRate(text: string): number | null {
  const parts = /^\s*(\d+(?:\.\d*)?)\s*([kM]?)(?:bit\/s)?\s*$/.exec(text);
  if (!parts) return null;
  const value = Number(parts[1]) * (parts[2] === 'k' ? 1e3 : parts[2] === 'M' ? 1e6 : 1);
  return value > 0 ? Math.round(value) : null;
}

function section(title: string, ...children: HTMLElement[]): HTMLElement {
  return el('section', { class: 'block' }, el('h3', {}, title), ...children);
}

export function facts(list: [string, string][]): HTMLElement {
  return el('dl', {}, ...list.flatMap(([name, value]) => [el('dt', {}, name), el('dd', {}, value)]));
}
