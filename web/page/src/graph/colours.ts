// The colours of drawings, from the style sheet's variables: so that dark and light are decided in one place.

import type { Colours } from './draw';

export function readColours(element: Element): Colours {
  const style = getComputedStyle(element);
  const read = (name: string): string => style.getPropertyValue(name).trim();
  return {
    background: read('--panel'),
    grid: read('--grid'),
    axis: read('--text'),
    text: read('--muted'),
    gap: read('--gap'),
    alarmAbove: read('--alarm-above'),
    alarmBelow: read('--alarm-below'),
    cursorA: read('--cursor-a'),
    cursorB: read('--cursor-b'),
    hover: read('--hover-line'),
    lane: read('--lane'),
    lines: [0, 1, 2, 3, 4, 5, 6, 7].map((i) => read(`--line-${i}`)),
  };
}
