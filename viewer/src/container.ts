// Reads the form in which arrays travel: see gsencoder/infer/page/page.py.

export type Typed = Uint8Array | Int8Array | Uint16Array | Int16Array | Uint32Array | Int32Array | Float32Array;

const KINDS = {
  uint8: Uint8Array,
  int8: Int8Array,
  uint16: Uint16Array,
  int16: Int16Array,
  uint32: Uint32Array,
  int32: Int32Array,
  float32: Float32Array,
} as const;

interface Entry {
  type: keyof typeof KINDS;
  shape: number[];
  offset: number;
}

export interface Container<Meta> {
  meta: Meta;
  arrays: Map<string, Typed>;
}

export function readContainer<Meta>(buffer: ArrayBuffer): Container<Meta> {
  const text = new TextDecoder();
  if (text.decode(new Uint8Array(buffer, 0, Math.min(8, buffer.byteLength))) !== "GSVIEW01") {
    throw new Error("The server sent something else than a scene.");
  }
  const length = new DataView(buffer).getUint32(8, true);
  const header = JSON.parse(text.decode(new Uint8Array(buffer, 12, length))) as {
    meta: Meta;
    arrays: Record<string, Entry>;
  };
  const arrays = new Map<string, Typed>();
  for (const [name, entry] of Object.entries(header.arrays)) {
    const count = entry.shape.reduce((product, side) => product * side, 1);
    arrays.set(name, new KINDS[entry.type](buffer, 12 + length + entry.offset, count));
  }
  return { meta: header.meta, arrays };
}

/** An array of the given kind. */
export function arrayOf<T extends Typed>(
  container: Container<unknown>,
  name: string,
  kind: new (...values: never[]) => T,
): T {
  const array = container.arrays.get(name);
  if (!(array instanceof kind)) throw new Error(`The scene lacks its array ${name}.`);
  return array;
}
