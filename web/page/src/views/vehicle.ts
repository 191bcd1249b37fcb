// A vehicle, asked by OBD-II through the device: its VIN, trouble codes and values.

import type { App } from '../model/app';
import type { Connection } from '../live/connection';
import type { State, VehicleRow } from '../live/protocol';
import { button, el, replace, setText } from '../ui/dom';

export class Vehicle {
  readonly element: HTMLElement;
  readonly #ask: HTMLButtonElement;
  readonly #text = el('p', { attrs: { role: 'status' } });
  readonly #rows = el('tbody', { id: 'vehicle' });
  readonly #table: HTMLElement;
  #drawn = '';

  constructor(
    private readonly app: App,
    private readonly live: Connection,
  ) {
    this.#ask = button('Ask the vehicle', () => this.toggle(), { id: 'vehicle-ask' });
    const head = ['Parameter', 'Name', 'ECU', 'Value', 'Least', 'Most'];
    this.#table = el('table', { class: 'numbers', attrs: { hidden: '' } }, el('thead', {}, el('tr', {}, ...head.map((h) => el('th', { attrs: { scope: 'col' } }, h)))), this.#rows);
    this.element = el('div', {}, el('div', { class: 'row' }, this.#ask, el('span', { class: 'muted' }, 'By OBD-II: its VIN and trouble codes, and its values once a second until you end it. Requests and answers are in the trace and among the conversations.')), this.#text, this.#table);
  }

  toggle(): void {
    const on = !this.live.state?.vehicle?.isAsked;
    void this.live.ask('askVehicle', { on }).catch((error: unknown) => this.app.failed(error));
  }

  draw({ vehicle, isNormal, maySend, sendOption }: State): void {
    const key = JSON.stringify([vehicle, isNormal, maySend]);
    if (key === this.#drawn) return;
    this.#drawn = key;
    this.#ask.disabled = !isNormal;
    setText(this.#ask, vehicle?.isAsked ? 'Ask nothing any more' : 'Ask the vehicle');
    const how = maySend ? 'Asking is sending, and the channels only listen: let them take part first.' : `Asking is sending: start ${this.live.command} with ${sendOption}.`;
    setText(this.#text, vehicle?.text ?? (isNormal ? 'Nothing is asked.' : how));
    this.#table.hidden = !vehicle || vehicle.rows.length === 0;
    replace(this.#rows, ...(vehicle?.rows ?? []).map(row));
  }
}

function row({ parameter, name, ecu, value, isCurrent, range }: VehicleRow): HTMLElement {
  const text = isCurrent ? value : `no answer, was ${value}`;
  return el('tr', { class: isCurrent ? '' : 'muted' }, el('td', { class: 'mono' }, parameter), el('th', { attrs: { scope: 'row' } }, name), el('td', { class: 'mono' }, ecu), el('td', {}, text), el('td', {}, range?.[0] ?? ''), el('td', {}, range?.[1] ?? ''));
}
