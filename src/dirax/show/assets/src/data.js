// The numbers of the page: JSON beside one deflated block of arrays, written by dirax.show.arrays.

const TYPES = { f8: Float64Array, f4: Float32Array, u4: Uint32Array, i2: Int16Array };
const WHOLE = { f8: BigUint64Array, f4: Uint32Array, u4: Uint32Array, i2: Uint16Array };

// The data, with every record of an array replaced by the array.
export async function load(document) {
  const data = JSON.parse(document.getElementById("data").textContent);
  const bytes = await inflated(document.getElementById("arrays").textContent);
  return filled(data, bytes);
}

async function inflated(base64) {
  const text = atob(base64.trim());
  const packed = Uint8Array.from(text, (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function filled(value, bytes) {
  if (Array.isArray(value)) return value.map((entry) => filled(entry, bytes));
  if (value === null || typeof value !== "object") return value;
  if (value.kind in TYPES && "at" in value) return restored(value, bytes);
  if ("start" in value && "step" in value) return Float64Array.from({ length: value.count }, (_, i) => value.start + value.step * i);
  return Object.fromEntries(Object.entries(value).map(([name, entry]) => [name, filled(entry, bytes)]));
}

// Bytes of the same significance lie side by side, of the numbers or of the differences of their bit patterns.
function restored({ kind, at, count, delta, scale }, bytes) {
  const size = TYPES[kind].BYTES_PER_ELEMENT;
  const raw = new Uint8Array(count * size);
  for (let k = 0; k < size; k++) for (let i = 0; i < count; i++) raw[i * size + k] = bytes[at + k * count + i];
  if (delta) {
    const whole = new WHOLE[kind](raw.buffer);
    for (let i = 1; i < count; i++) whole[i] += whole[i - 1]; // wraps around as the differences did
  }
  const found = new TYPES[kind](raw.buffer);
  return scale === undefined ? found : Float32Array.from(found, (x) => x * scale);
}

// The last index with values[index] <= x, of ascending values; 0 before the first.
export function before(values, x) {
  let low = 0;
  let high = values.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (values[middle] <= x) low = middle;
    else high = middle - 1;
  }
  return low;
}

export function nearest(values, x) {
  const i = before(values, x);
  return i + 1 < values.length && values[i + 1] - x < x - values[i] ? i + 1 : i;
}

// A number with so many significant digits, as Python prints it with %g.
export function exact(value, digits) {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const [mantissa, exponent] = value.toExponential(digits - 1).split("e");
  const power = Number(exponent);
  const trimmed = (text) => (text.includes(".") ? text.replace(/\.?0+$/, "") : text);
  if (power < -4 || power >= digits) return `${trimmed(mantissa)}e${power < 0 ? "-" : "+"}${String(Math.abs(power)).padStart(2, "0")}`;
  return trimmed(value.toFixed(Math.max(0, digits - 1 - power)));
}
