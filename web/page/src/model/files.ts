// Files in and out: read by slices, so that a trace never lies in the page's memory as a whole; saved by a link that is clicked.

const FIRST_PIECE = 1 << 20;
/** A view waits for two of them at most: one that is being read, and one that the engine has been given. */
const PIECE = 4 << 20;

export interface Piece {
  bytes: Uint8Array;
  more: boolean;
}

/** The file's bytes in pieces: a small one first, so that a view shows its first rows at once. The next one is read while one is used. */
export async function* pieces(file: Blob): AsyncGenerator<Piece, void, void> {
  const read = (from: number, to: number): Promise<ArrayBuffer> => {
    const bytes = file.slice(from, to).arrayBuffer();
    // Whoever waits for it is told; nobody may, if the trace is closed before.
    bytes.catch(() => undefined);
    return bytes;
  };
  let at = Math.min(file.size, FIRST_PIECE);
  let next: Promise<ArrayBuffer> | null = read(0, at);
  while (next) {
    const bytes = new Uint8Array(await next);
    const end = Math.min(file.size, at + PIECE);
    next = end > at ? read(at, end) : null;
    at = end;
    yield { bytes, more: next !== null };
  }
}

const DATABASES = /\.(dbc|toml|kcd|sym|arxml|dbf|xml|eds|dcf|xdd|xdc|a2l|cdd|pdx|odx[a-z-]*|dsdl|uavcan)$/i;

/** Whether a file is taken for a database by its name; all else is taken for a trace. */
export function isDatabase(name: string): boolean {
  return DATABASES.test(name);
}

export function save(name: string, bytes: Uint8Array | string, type = 'application/octet-stream'): void {
  const content = typeof bytes === 'string' ? new TextEncoder().encode(bytes) : bytes;
  saveBlob(name, new Blob([content as Uint8Array<ArrayBuffer>], { type }));
}

export function saveBlob(name: string, blob: Blob): void {
  const url = URL.createObjectURL(blob);
  const link = document.createElement('a');
  link.href = url;
  link.download = name.replace(/[^\p{L}\p{N}._ -]/gu, '_');
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

export function decodeBase64(text: string): Uint8Array<ArrayBuffer> {
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

/** Base64 in pieces, so that the decoded text of a large report is never one string. */
export function blobOfBase64(text: string): Blob {
  const parts: Uint8Array<ArrayBuffer>[] = [];
  for (let at = 0; at < text.length; at += PIECE) parts.push(decodeBase64(text.slice(at, at + PIECE)));
  return new Blob(parts);
}

export async function gunzip(blob: Blob): Promise<Blob> {
  if (typeof DecompressionStream === 'undefined') throw new Error('This browser cannot unpack the report (no DecompressionStream): open it with a newer one.');
  return new Response(blob.stream().pipeThrough(new DecompressionStream('gzip'))).blob();
}
