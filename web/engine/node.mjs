// The engine under node, for tests and measurements: what `web/page/src/engine.ts` is in the page.

const aligned = (length) => Math.ceil(length / 8) * 8;

/** Starts an engine; `ask` answers a request, and throws an error with its text if it is refused. */
export async function start(wasm) {
  const { instance } = await WebAssembly.instantiate(wasm, {});
  const engine = instance.exports;

  function ask(request, parameters, bytes) {
    const head = new TextEncoder().encode(JSON.stringify({ request, parameters: bytes ? { ...parameters, bytes: { $u8: [0, bytes.byteLength] } } : parameters }));
    const begin = aligned(4 + head.byteLength);
    const length = begin + (bytes?.byteLength ?? 0);
    const address = engine.cantap_allocate(length);
    new DataView(engine.memory.buffer).setUint32(address, head.byteLength, true);
    new Uint8Array(engine.memory.buffer, address + 4, head.byteLength).set(head);
    if (bytes) new Uint8Array(engine.memory.buffer, address + begin, bytes.byteLength).set(bytes);
    const answer = engine.cantap_ask(address, length) >>> 0;
    const view = new DataView(engine.memory.buffer);
    const size = view.getUint32(answer, true);
    const headLength = view.getUint32(answer + 8, true);
    const text = new TextDecoder().decode(new Uint8Array(engine.memory.buffer, answer + 12, headLength));
    const sections = answer + 8 + aligned(4 + headLength);
    const { ok, error } = JSON.parse(text, (_key, value) => {
      for (const [name, Type] of Object.entries({ $u8: Uint8Array, $u32: Uint32Array, $f64: Float64Array })) {
        const place = value?.[name];
        if (place) return new Type(engine.memory.buffer.slice(sections + place[0], sections + place[0] + place[1] * Type.BYTES_PER_ELEMENT));
      }
      return value;
    });
    engine.cantap_free(answer, size);
    if (error !== undefined) throw new Error(error);
    return ok;
  }

  return { ask, memory: () => engine.memory.buffer.byteLength };
}
