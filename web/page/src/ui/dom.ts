// Building elements. Text goes in as text only: nothing here parses markup, so a name in a trace or a database cannot become any.

export type Child = Node | string | null | undefined | false;

type Handlers = { [K in keyof HTMLElementEventMap]?: (event: HTMLElementEventMap[K]) => void };

export interface Props {
  class?: string;
  id?: string;
  title?: string;
  /** Attributes as they are written, `role` and `aria-…` among them. Handlers and styles have no way in through here. */
  attrs?: Record<string, string | number | boolean | null>;
  on?: Handlers;
}

export function el<K extends keyof HTMLElementTagNameMap>(tag: K, props: Props = {}, ...children: Child[]): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  if (props.class) element.className = props.class;
  if (props.id) element.id = props.id;
  if (props.title) element.title = props.title;
  for (const [name, value] of Object.entries(props.attrs ?? {})) {
    if (value !== null && value !== false) element.setAttribute(name, value === true ? '' : String(value));
  }
  for (const [name, handler] of Object.entries(props.on ?? {})) element.addEventListener(name, handler as EventListener);
  append(element, children);
  return element;
}

export function append(parent: Element, children: Child[]): void {
  for (const child of children) {
    if (child === null || child === undefined || child === false) continue;
    parent.append(child);
  }
}

export function replace(parent: Element, ...children: Child[]): void {
  parent.replaceChildren();
  append(parent, children);
}

/** Sets an element's text only if it differs: most cells of a scrolled table keep theirs. */
export function setText(element: Element, text: string): void {
  if (element.textContent !== text) element.textContent = text;
}

export function button(label: string, run: () => void, props: Props = {}): HTMLButtonElement {
  return el('button', { ...props, attrs: { type: 'button', ...props.attrs }, on: { ...props.on, click: run } }, label);
}

/** A field with its label. */
export function field(label: string, control: HTMLElement, hint?: string): HTMLLabelElement {
  return el('label', { class: 'field' }, el('span', {}, label), control, hint ? el('small', {}, hint) : null);
}

export function select(options: readonly (readonly [value: string, label: string])[], value: string, change: (value: string) => void, label: string): HTMLSelectElement {
  const element = el('select', { attrs: { 'aria-label': label } }, ...options.map(([v, text]) => el('option', { attrs: { value: v } }, text)));
  element.value = value;
  element.addEventListener('change', () => change(element.value));
  return element;
}

const SVG = 'http://www.w3.org/2000/svg';

export function svg(tag: string, attrs: Record<string, string | number>, ...children: (Node | string)[]): SVGElement {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attrs)) element.setAttribute(name, String(value));
  element.append(...children);
  return element;
}
