// What a page can be live from: a server (`Connection`), or a board on a serial port of this browser (`Board`).

import type { Emitter } from '../model/emitter';
import type { State } from './protocol';

export type Status = 'connecting' | 'open' | 'lost' | 'ended';

export interface Source extends Emitter<'status' | 'state' | 'progress'> {
  readonly status: Status;
  /** Why there is no connection, for the user. */
  readonly reason: string;
  readonly state: State | null;
  /** Records taken in, and those that the source has. */
  readonly next: number;
  readonly latest: number;
  /** The engine has lost what it had. */
  again(): void;
}
