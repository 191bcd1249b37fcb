// What the page keeps between two visits: layout, theme, filters. A browser may refuse (files from disk, private windows): then nothing is kept,
// and the page says so once instead of failing. The same text is the profile that a user saves as a file.

import { parseEntry } from './send-entry';

export interface Profile {
  cantapProfile: 1;
  theme: 'auto' | 'dark' | 'light';
  view: string;
  timeStyle: 'relative' | 'absolute' | 'delta';
  /** Graphs by names, since keys hold only as long as a database is loaded. */
  panels: { items: ProfileItem[]; style: string }[];
  filters: string[];
  /** What is sent often, a line for each, as in a file of the live view's send list. */
  sendList: string[];
}

export type ProfileItem = { kind: 'signal'; channel: number | null; id: number; extended: boolean; signal: string } | { kind: 'load'; channel: number } | { kind: 'field'; channel: number; name: string; between: string; message: string; which: string };

export const DEFAULT_PROFILE: Profile = { cantapProfile: 1, theme: 'auto', view: 'summary', timeStyle: 'relative', panels: [], filters: [], sendList: [] };

const KEY = 'cantap.profile';

export class Storage {
  /** Why nothing can be kept; null while all is well. */
  refused: string | null = null;

  load(): Profile {
    try {
      const text = localStorage.getItem(KEY);
      return text === null ? { ...DEFAULT_PROFILE } : parseProfile(text);
    } catch (error) {
      this.refused = error instanceof Error ? error.message : String(error);
      return { ...DEFAULT_PROFILE };
    }
  }

  save(profile: Profile): void {
    if (this.refused !== null) return;
    try {
      localStorage.setItem(KEY, JSON.stringify(profile));
    } catch (error) {
      this.refused = error instanceof Error ? error.message : String(error);
    }
  }
}

/** Reads a profile from text that anybody may have written; throws with what to do if it is none. */
export function parseProfile(text: string): Profile {
  const raw: unknown = JSON.parse(text);
  if (!isObject(raw) || raw['cantapProfile'] !== 1) throw new Error('This is no profile of cantap’s page, or of a newer version: choose a file that the page saved.');
  const theme = raw['theme'];
  const timeStyle = raw['timeStyle'];
  const panels: unknown[] = Array.isArray(raw['panels']) ? raw['panels'] : [];
  const sendList: unknown[] = Array.isArray(raw['sendList']) ? raw['sendList'] : [];
  const filters: unknown[] = Array.isArray(raw['filters']) ? raw['filters'] : [];
  return {
    cantapProfile: 1,
    theme: theme === 'dark' || theme === 'light' ? theme : 'auto',
    view: typeof raw['view'] === 'string' ? raw['view'] : DEFAULT_PROFILE.view,
    timeStyle: timeStyle === 'absolute' || timeStyle === 'delta' ? timeStyle : 'relative',
    panels: panels.filter(isObject).map((panel) => ({
      style: typeof panel['style'] === 'string' ? panel['style'] : 'step',
      items: (Array.isArray(panel['items']) ? (panel['items'] as unknown[]) : []).flatMap(parseItem),
    })),
    filters: filters.filter((f): f is string => typeof f === 'string').slice(0, 30),
    sendList: sendList.filter((line): line is string => typeof line === 'string' && isEntry(line)),
  };
}

function parseItem(raw: unknown): ProfileItem[] {
  if (!isObject(raw)) return [];
  const { kind, channel, id, extended, signal } = raw;
  if (kind === 'load' && typeof channel === 'number') return [{ kind, channel }];
  if (kind === 'field' && typeof channel === 'number') {
    const text = (name: string): string => (typeof raw[name] === 'string' ? raw[name] : '');
    return [{ kind, channel, name: text('name'), between: text('between'), message: text('message'), which: text('which') }];
  }
  if (kind === 'signal' && typeof id === 'number' && typeof signal === 'string') {
    return [{ kind, channel: typeof channel === 'number' ? channel : null, id, extended: extended === true, signal }];
  }
  return [];
}

function isEntry(line: string): boolean {
  try {
    return parseEntry(line).text !== '';
  } catch {
    return false;
  }
}

function isObject(value: unknown): value is Record<string, unknown> {
  return typeof value === 'object' && value !== null && !Array.isArray(value);
}
