"use strict";

/* Images, each loaded when it is first looked at, and kept while there is room. */
progden.images = (() => {
  // Decoded pixels, of which a graphics card holds a copy.
  const ROOM = 512 * 2 ** 20;
  const entries = new Map(); // name -> {state, image}, the longest unused first
  const decoding = new Map(); // number of a decoder's job -> its end
  let held = 0;
  let changed = () => {};
  let dropped = () => {};

  /** {state: "loading" | "ready" | "failed", image}: asking loads. */
  function get(name) {
    const entry = entries.get(name) ?? load(name);
    entries.delete(name);
    entries.set(name, entry);
    return entry;
  }

  function load(name) {
    const script = document.createElement("script");
    script.src = `images/${name}.js`;
    script.onload = () => script.remove();
    script.onerror = () => {
      script.remove();
      entries.set(name, { state: "failed", image: null });
      changed();
    };
    document.head.append(script);
    return { state: "loading", image: null };
  }

  /** Called by the image files. */
  progden.image = async (name, about, text) => {
    const count = about.width * about.height * about.channels;
    try {
      const halves = await decodeAside(text, count, about.channels);
      entries.set(name, { state: "ready", image: { ...about, name, halves } });
      held += halves.byteLength;
    } catch (error) {
      console.error(`image ${name} cannot be decoded`, error);
      entries.set(name, { state: "failed", image: null });
    }
    changed();
  };

  /** Give back what has not been looked at for longest, but never what is `shown` now. */
  function trim(shown) {
    for (const [name, { image }] of entries) {
      if (held <= ROOM) return;
      if (!image || shown.has(name)) continue;
      held -= image.halves.byteLength;
      entries.delete(name);
      dropped(image);
    }
  }

  /** The inverse of progden_jax.report.images.encode; self-contained, for it also runs in a worker. */
  async function decode(text, count, channels) {
    let packed;
    if (Uint8Array.fromBase64) {
      packed = Uint8Array.fromBase64(text);
    } else {
      const binary = atob(text);
      packed = new Uint8Array(binary.length);
      for (let i = 0; i < binary.length; i++) packed[i] = binary.charCodeAt(i);
    }
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    if (bytes.length !== 2 * count) throw new Error(`${bytes.length} bytes for ${count} values`);
    const halves = new Uint16Array(count);
    const pixels = count / channels;
    for (let channel = 0, i = 0, last = 0; channel < channels; channel++) {
      for (let at = channel; at < count; at += channels, i++) {
        last = (last + (bytes[i] << 8) + bytes[count + i]) & 0xffff;
        halves[at] = last;
      }
    }
    return halves;
  }

  const decodeAside = (() => {
    const source = `${decode}
      onmessage = async ({ data: [job, ...given] }) => {
        try {
          const halves = await decode(...given);
          postMessage([job, halves], [halves.buffer]);
        } catch (error) {
          postMessage([job, null, String(error)]);
        }
      };`;
    let workers = [];
    try {
      const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
      const count = Math.min(4, Math.max(1, (navigator.hardwareConcurrency || 2) - 1));
      workers = Array.from({ length: count }, () => new Worker(url));
    } catch {
      return decode; // a browser that allows no workers here decodes where it draws
    }
    let jobs = 0;
    for (const worker of workers) {
      worker.onmessage = ({ data: [job, halves, error] }) => {
        const [resolve, reject] = decoding.get(job);
        decoding.delete(job);
        if (halves) resolve(halves);
        else reject(new Error(error));
      };
    }
    return (...given) =>
      new Promise((resolve, reject) => {
        const job = jobs++;
        decoding.set(job, [resolve, reject]);
        workers[job % workers.length].postMessage([job, ...given]);
      });
  })();

  const floats = new Float32Array(65536);
  for (let half = 0; half < 65536; half++) {
    const sign = half & 0x8000 ? -1 : 1;
    const exponent = (half >> 10) & 31;
    const mantissa = half & 1023;
    if (exponent === 31) floats[half] = mantissa ? NaN : sign * Infinity;
    else if (exponent === 0) floats[half] = sign * mantissa * 2 ** -24;
    else floats[half] = sign * (1024 + mantissa) * 2 ** (exponent - 25);
  }

  /** The values of one pixel, as they were stored. */
  function pixel(image, x, y) {
    const at = (y * image.width + x) * image.channels;
    return Array.from(
      image.halves.subarray(at, at + image.channels), (half) => floats[half] * image.scale,
    );
  }

  return {
    get, trim, decode, floats, pixel,
    onChange: (listener) => (changed = listener),
    onDrop: (listener) => (dropped = listener),
  };
})();
