// A report: a trace, databases and notes that `cantap report` put into the page itself.

import type { Connections, Finding } from '../api';
import type { App } from './app';
import { blobOfBase64, gunzip } from './files';

export interface Packed {
  name: string;
  encoding: 'gzip' | 'none';
  /** Bytes once unpacked. */
  size: number;
  /** Base64. */
  data: string;
}

/** A database in the page; null: for all channels. */
export type ServedDatabase = Packed & { channel: number | null };

export interface Report {
  version: 1;
  title: string;
  created: string;
  command: string;
  notes: string[];
  trace: Packed;
  databases: ServedDatabase[];
  /** Null: a report of before, or none is known. */
  connections: Connections | null;
  /** Bit rates that the trace itself does not give, in bit/s. */
  bitrates: { channel: number; bitrate: number; dataBitrate: number | null }[];
  findings: Finding[];
  /** What was left out to keep to the size limit, in sentences. */
  thinned: string[];
}

/** The report in this page; null if there is none. Throws if it is damaged. */
export function embeddedReport(root: Document): Report | null {
  const text = root.getElementById('cantap-report')?.textContent?.trim();
  if (!text) return null;
  let raw: Partial<Report>;
  try {
    raw = JSON.parse(text) as Partial<Report>;
  } catch {
    throw new Error('The report in this page is damaged: its file was cut or changed. Ask for it again, or write it anew with “cantap report”.');
  }
  if (raw.version !== 1 || !raw.trace) throw new Error('The report in this page is of another version: write it anew with the “cantap report” that this page came with.');
  return {
    version: 1,
    title: raw.title ?? raw.trace.name,
    created: raw.created ?? '',
    command: raw.command ?? '',
    notes: raw.notes ?? [],
    trace: raw.trace,
    databases: raw.databases ?? [],
    connections: raw.connections ?? null,
    bitrates: raw.bitrates ?? [],
    findings: raw.findings ?? [],
    thinned: raw.thinned ?? [],
  };
}

/** Adds the databases and connections that the page carries; one that is unusable is reported, and the others are added. */
export async function addCarried(app: App, { databases, connections }: { databases: readonly ServedDatabase[]; connections: Connections | null }): Promise<void> {
  for (const database of databases) {
    try {
      await app.addDatabase(database.name, new Uint8Array(await (await unpack(database)).arrayBuffer()), database.channel);
    } catch (error) {
      app.failed(error);
    }
  }
  try {
    if (connections) await app.connect(connections);
  } catch (error) {
    app.failed(error);
  }
}

/** The packed file as it was, byte for byte. */
export async function unpack(packed: Packed): Promise<File> {
  const blob = blobOfBase64(packed.data);
  const plain = packed.encoding === 'gzip' ? await gunzip(blob) : blob;
  if (plain.size !== packed.size) throw new Error(`${packed.name}: ${plain.size} of ${packed.size} bytes came out of the report. Its file was cut: ask for it again.`);
  return new File([plain], packed.name);
}
