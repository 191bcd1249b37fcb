// Mouse, pen and fingers on the graphs: wheel zooms about the pointer, dragging marks a stretch to zoom into, Shift or the middle button or one finger
// pans, two fingers zoom, a click puts cursor A and a Shift click cursor B, a double click shows everything.

import type { App, Range } from '../model/app';
import { timeScale } from './draw';
import { type Scale, fromPixel, toPixel } from './scale';

/** Pixels that a pointer must travel before it drags. */
const DRAG = 4;
/** Pixels within which a cursor is grabbed. */
const GRAB = 5;

export interface PointerListener {
  hover(time: number | null): void;
  box(box: Range | null): void;
}

type Gesture =
  | { kind: 'none' }
  | { kind: 'box'; startX: number; start: number; moved: boolean }
  | { kind: 'pan'; startX: number; range: Range; moved: boolean }
  | { kind: 'cursor'; which: 'A' | 'B' }
  | { kind: 'pinch'; distance: number; centre: number; range: Range };

export class GraphPointer {
  readonly #fingers = new Map<number, number>();
  #gesture: Gesture = { kind: 'none' };
  #wheel: ReturnType<typeof setTimeout> | null = null;

  constructor(
    private readonly app: App,
    private readonly listener: PointerListener,
  ) {}

  attach(canvas: HTMLCanvasElement): void {
    canvas.addEventListener('pointerdown', (event) => this.#down(event, canvas));
    canvas.addEventListener('pointermove', (event) => this.#move(event, canvas));
    canvas.addEventListener('pointerup', (event) => this.#up(event, canvas));
    canvas.addEventListener('pointercancel', (event) => this.#cancel(event));
    canvas.addEventListener('pointerleave', () => this.listener.hover(null));
    canvas.addEventListener('dblclick', () => this.app.fit());
    canvas.addEventListener('wheel', (event) => this.#turn(event, canvas), { passive: false });
  }

  #scale(canvas: HTMLCanvasElement): Scale {
    return timeScale(this.app.range, canvas.clientWidth);
  }

  #x(event: MouseEvent, canvas: HTMLCanvasElement): number {
    return event.clientX - canvas.getBoundingClientRect().left;
  }

  #down(event: PointerEvent, canvas: HTMLCanvasElement): void {
    if (event.button > 1) return;
    canvas.setPointerCapture(event.pointerId);
    const x = this.#x(event, canvas);
    const range = { ...this.app.range };
    if (event.pointerType === 'touch') {
      this.#fingers.set(event.pointerId, x);
      const [first, second] = [...this.#fingers.values()];
      if (first !== undefined && second !== undefined) {
        this.#gesture = { kind: 'pinch', distance: Math.max(10, Math.abs(first - second)), centre: fromPixel(this.#scale(canvas), (first + second) / 2), range };
        return;
      }
      this.#gesture = { kind: 'pan', startX: x, range, moved: false };
      return;
    }
    const near = (time: number | null): boolean => time !== null && Math.abs(toPixel(this.#scale(canvas), time) - x) <= GRAB;
    if (event.button === 1) this.#gesture = { kind: 'pan', startX: x, range, moved: false };
    else if (!event.shiftKey && near(this.app.cursorA)) this.#gesture = { kind: 'cursor', which: 'A' };
    else if (!event.shiftKey && near(this.app.cursorB)) this.#gesture = { kind: 'cursor', which: 'B' };
    else if (event.shiftKey) this.#gesture = { kind: 'pan', startX: x, range, moved: false };
    else this.#gesture = { kind: 'box', startX: x, start: fromPixel(this.#scale(canvas), x), moved: false };
    if (event.button === 1) event.preventDefault();
  }

  #move(event: PointerEvent, canvas: HTMLCanvasElement): void {
    const x = this.#x(event, canvas);
    const scale = this.#scale(canvas);
    const time = Math.min(scale.to, Math.max(scale.from, fromPixel(scale, x)));
    const gesture = this.#gesture;
    if (event.pointerType === 'touch' && this.#fingers.has(event.pointerId)) this.#fingers.set(event.pointerId, x);
    switch (gesture.kind) {
      case 'none':
        this.listener.hover(x >= scale.start ? time : null);
        return;
      case 'cursor':
        this.app.setCursor(gesture.which, time);
        return;
      case 'box':
        gesture.moved ||= Math.abs(x - gesture.startX) >= DRAG;
        if (gesture.moved) this.listener.box({ from: Math.min(gesture.start, time), to: Math.max(gesture.start, time) });
        return;
      case 'pan': {
        if (!gesture.moved && Math.abs(x - gesture.startX) < DRAG) return;
        const by = ((gesture.startX - x) / (scale.end - scale.start)) * (gesture.range.to - gesture.range.from);
        this.app.look({ from: gesture.range.from + by, to: gesture.range.to + by }, !gesture.moved);
        gesture.moved = true;
        return;
      }
      case 'pinch': {
        const [first, second] = [...this.#fingers.values()];
        if (first === undefined || second === undefined) return;
        const factor = gesture.distance / Math.max(10, Math.abs(first - second));
        const { from, to } = gesture.range;
        this.app.look({ from: gesture.centre - (gesture.centre - from) * factor, to: gesture.centre + (to - gesture.centre) * factor }, false);
      }
    }
  }

  #up(event: PointerEvent, canvas: HTMLCanvasElement): void {
    const gesture = this.#gesture;
    const x = this.#x(event, canvas);
    const time = fromPixel(this.#scale(canvas), x);
    this.#cancel(event);
    if (gesture.kind === 'box') {
      if (gesture.moved) this.app.look({ from: Math.min(gesture.start, time), to: Math.max(gesture.start, time) });
      else this.app.setCursor('A', time);
    } else if (gesture.kind === 'pan' && !gesture.moved) this.app.setCursor(event.shiftKey ? 'B' : 'A', time);
  }

  #cancel(event: PointerEvent): void {
    this.#fingers.delete(event.pointerId);
    this.#gesture = { kind: 'none' };
    this.listener.box(null);
  }

  #turn(event: WheelEvent, canvas: HTMLCanvasElement): void {
    event.preventDefault();
    const unit = event.deltaMode === 1 ? 20 : event.deltaMode === 2 ? 400 : 1;
    const { from, to } = this.app.range;
    // A burst of the wheel is one step of undo.
    const step = this.#wheel === null;
    if (this.#wheel !== null) clearTimeout(this.#wheel);
    this.#wheel = setTimeout(() => (this.#wheel = null), 400);
    const sideways = event.shiftKey && event.deltaX === 0 ? event.deltaY : event.deltaX;
    if (sideways !== 0 && Math.abs(sideways) >= Math.abs(event.shiftKey ? 0 : event.deltaY)) {
      const by = ((sideways * unit) / canvas.clientWidth) * (to - from);
      this.app.look({ from: from + by, to: to + by }, step);
      return;
    }
    const centre = fromPixel(this.#scale(canvas), this.#x(event, canvas));
    const factor = Math.exp(event.deltaY * unit * 0.0015);
    this.app.look({ from: centre - (centre - from) * factor, to: centre + (to - centre) * factor }, step);
  }
}
