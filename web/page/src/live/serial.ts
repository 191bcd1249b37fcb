// The part of Web Serial that is used; TypeScript's own types do not have it. https://wicg.github.io/serial/

export interface SerialPort extends EventTarget {
  readonly readable: ReadableStream<Uint8Array> | null;
  readonly writable: WritableStream<Uint8Array> | null;
  open(options: { baudRate: number; bufferSize?: number }): Promise<void>;
  close(): Promise<void>;
  setSignals?(signals: { dataTerminalReady?: boolean; requestToSend?: boolean }): Promise<void>;
}

export interface Serial {
  requestPort(options: { filters: { usbVendorId: number; usbProductId: number }[] }): Promise<SerialPort>;
}

/** The browser's serial ports, or null if it offers none to this page. */
export function serialOf(where: Navigator): Serial | null {
  return (where as Navigator & { serial?: Serial }).serial ?? null;
}

export const NO_SERIAL = 'This browser gives pages no serial ports: open the page in Chrome, Edge or Opera on a computer, or use “cantap ui” with any browser.';
