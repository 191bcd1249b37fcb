// Asks for the bit rates and for the port of a board, and opens it. A port is only given to a page after a click of the user.

import { Board, type Bitrates } from '../live/board';
import { NO_SERIAL, type SerialPort, serialOf } from '../live/serial';
import type { App } from '../model/app';
import { openDialog } from '../ui/dialog';
import { el, field } from '../ui/dom';
import { parseRate } from './summary';

/** Opens a board in a new trace, or `again` in the one of the board that was open; `same`: at the port that it has. */
export async function openBoard(app: App, { again = false, same = false } = {}): Promise<void> {
  const serial = serialOf(navigator);
  if (!serial) {
    app.notify('error', NO_SERIAL);
    return;
  }
  if (!again && !(await mayReplace(app))) return;
  let usb: { vendorId: number; productId: number };
  try {
    usb = await app.ask('boardUsb', {});
  } catch (error) {
    app.failed(error);
    return;
  }
  const before = app.board?.bitrates ?? [500_000, 500_000];
  const inputs = [1, 2].map((channel) => el('input', { class: 'mono', attrs: { type: 'text', 'aria-label': `Bit rate of channel ${channel}`, value: before[channel - 1] ?? '', inputmode: 'decimal' } }));
  const problem = el('p', { class: 'bad', attrs: { role: 'alert' } });
  const choose = async (bitrates: Bitrates): Promise<void> => {
    try {
      const known = same ? app.board?.port : null;
      const port = known ?? (await serial.requestPort({ filters: [{ usbVendorId: usb.vendorId, usbProductId: usb.productId }] }));
      await open(app, port, bitrates, again);
    } catch (error) {
      // The user has chosen none.
      if (error instanceof Error && error.name === 'NotFoundError') return;
      app.failed(error);
    }
  };
  openDialog(
    same ? 'Bit rates of the board' : 'Open a board',
    [
      el('div', { class: 'pair' }, ...inputs.map((input, i) => field(`Channel ${i + 1}, bit/s`, input, 'for example 500k; empty to leave it closed'))),
      el('p', {}, 'The channels only listen: nothing is sent, and no frame is acknowledged. A page cannot do anything else with a board.'),
      same ? el('p', { class: 'muted' }, 'The board is closed and opened again: for a moment nothing is received, and the trace has a gap there.') : null,
      problem,
    ],
    [
      {
        label: same ? 'Set' : 'Choose the board …',
        primary: true,
        run: () => {
          const rates = inputs.map((input) => (input.value.trim() === '' ? null : parseRate(input.value)));
          const wrong = inputs.find((input, i) => input.value.trim() !== '' && rates[i] === null);
          if (wrong || rates.every((rate) => rate === null)) {
            problem.textContent = wrong ? `“${wrong.value}” is no bit rate: write for example 500k.` : 'Give at least one channel a bit rate.';
            return false;
          }
          void choose([rates[0] ?? null, rates[1] ?? null]);
          return true;
        },
      },
      { label: 'Cancel' },
    ],
  );
  inputs[0]?.select();
}

async function open(app: App, port: SerialPort, bitrates: Bitrates, again: boolean): Promise<void> {
  const board = (app.board ??= withEvents(app));
  await board.stop();
  await board.open(port, bitrates, again);
  app.emit('board');
}

function withEvents(app: App): Board {
  const board = new Board(app);
  for (const topic of ['status', 'state', 'progress'] as const) board.on(topic, () => app.emit('live-state'));
  return board;
}

/** Asks, if there are records that would be lost with the trace that is shown. */
export function mayReplace(app: App): Promise<boolean> {
  const { board } = app;
  if (board?.isOpen) {
    app.notify('warning', 'A board is open, and what it sends is being taken in: close it first, and save what is not to be lost.');
    return Promise.resolve(false);
  }
  if (!board?.isUnsaved || app.live !== board) return Promise.resolve(true);
  return new Promise((answer) => {
    const dialog = openDialog('Discard what was received?', [el('p', {}, 'What came from the board was not saved. Another trace takes its place.')], [
      { label: 'Keep it', primary: true },
      {
        label: 'Discard it',
        run: () => {
          board.isUnsaved = false;
          answer(true);
        },
      },
    ]);
    dialog.addEventListener('close', () => answer(false));
  });
}
