// Where a signal's bits lie. Cells are numbered as they are drawn: byte 0 bit 7 first, so that cell = byte * 8 + (7 - bit).
// Start bits are as a DBC writes them (bit = byte * 8 + bit): the least significant bit of a little-endian signal, the most significant of a
// big-endian one.

export interface BitField {
  startBit: number;
  bitLength: number;
  littleEndian: boolean;
}

export function cellOfBit(bit: number): number {
  return (bit & ~7) | (7 - (bit & 7));
}

export const bitOfCell = cellOfBit; // the mapping is its own inverse

/** The cells of a field, its most significant bit first. */
export function cellsOf(field: BitField): number[] {
  const cells: number[] = [];
  if (field.littleEndian) {
    for (let i = field.bitLength - 1; i >= 0; i--) cells.push(cellOfBit(field.startBit + i));
  } else {
    const first = cellOfBit(field.startBit);
    for (let i = 0; i < field.bitLength; i++) cells.push(first + i);
  }
  return cells;
}

/**
 * The field from one marked cell to another. Big-endian fields are runs of cells. Little-endian ones run from bit to bit in the order of the
 * DBC's numbers, so the same two cells may take other bits in between.
 */
export function fieldBetween(a: number, b: number, littleEndian: boolean): BitField {
  if (littleEndian) {
    const [low, high] = order(bitOfCell(a), bitOfCell(b));
    return { startBit: low, bitLength: high - low + 1, littleEndian };
  }
  const [low, high] = order(a, b);
  return { startBit: bitOfCell(low), bitLength: high - low + 1, littleEndian };
}

function order(a: number, b: number): [number, number] {
  return a < b ? [a, b] : [b, a];
}

export interface Borders {
  top: boolean;
  right: boolean;
  bottom: boolean;
  left: boolean;
}

/** Which sides of a cell are the outline of the field it belongs to. */
export function borders(cell: number, cells: ReadonlySet<number>): Borders {
  const column = cell % 8;
  return {
    top: !cells.has(cell - 8),
    bottom: !cells.has(cell + 8),
    left: column === 0 || !cells.has(cell - 1),
    right: column === 7 || !cells.has(cell + 1),
  };
}
