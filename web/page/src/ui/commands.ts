// What can be done, each with a name and mostly a key: the palette, the list of keys and the keyboard all read the same table.

export interface Command {
  id: string;
  title: string;
  /** As `KeyboardEvent.key`, with `Ctrl+` before it if need be; the first is the one that is shown. */
  keys?: string[];
  /** Only in this view; everywhere without it. */
  view?: string;
  run: () => void;
}

export class Commands {
  readonly #list: Command[] = [];

  add(...commands: Command[]): void {
    this.#list.push(...commands);
  }

  all(view: string): Command[] {
    return this.#list.filter((c) => c.view === undefined || c.view === view);
  }

  every(): readonly Command[] {
    return this.#list;
  }

  /** Runs what the key stands for in this view; a command of the view goes before one of everywhere. */
  key(event: KeyboardEvent, view: string): boolean {
    const name = keyName(event);
    const typing = isTyping(event.target);
    // In a field, undo and redo are the field's own.
    if (typing && ((!event.ctrlKey && !event.metaKey) || /^[zy]$/i.test(event.key))) return false;
    const found = this.all(view)
      .filter((c) => c.keys?.includes(name))
      .sort((a, b) => Number(a.view === undefined) - Number(b.view === undefined))[0];
    if (!found) return false;
    event.preventDefault();
    found.run();
    return true;
  }
}

function keyName(event: KeyboardEvent): string {
  const key = event.key.length === 1 && event.ctrlKey ? event.key.toLowerCase() : event.key;
  return `${event.ctrlKey || event.metaKey ? 'Ctrl+' : ''}${event.altKey ? 'Alt+' : ''}${event.shiftKey && event.key.length > 1 ? 'Shift+' : ''}${event.ctrlKey && event.shiftKey && event.key.length === 1 ? 'Shift+' : ''}${key}`;
}

/** Whether keys go into a field of text. */
export function isTyping(target: EventTarget | null): boolean {
  if (target instanceof HTMLInputElement) return !['checkbox', 'radio', 'button', 'range', 'file', 'color'].includes(target.type);
  return target instanceof HTMLTextAreaElement || target instanceof HTMLSelectElement;
}

const SHOWN: Record<string, string> = { ArrowLeft: '←', ArrowRight: '→', ArrowUp: '↑', ArrowDown: '↓', ' ': 'Space' };

export function keyLabel(key: string): string {
  return key
    .split(/(?<=.)\+(?=.)/)
    .map((part) => SHOWN[part] ?? part)
    .join('+');
}
