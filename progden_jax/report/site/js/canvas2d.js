"use strict";

/* Draws panels without WebGL, pixel by pixel: the same pictures, but slower, and shrunk ones unsmoothed. */
progden.canvas2d = (canvas) => {
  const { TONES, MAPS, toSrgb, position, mapped, BAD } = progden.color;
  const { floats } = progden.images;
  const context = canvas.getContext("2d");

  // As bytes R, G, B, A lie in memory, on all machines that browsers run on.
  const pack = (r, g, b) => (r | (g << 8) | (b << 16) | (255 << 24)) >>> 0;
  const MAGENTA = pack(...BAD);

  /** Pixel's index -> its colour on screen. */
  function picture({ channels, halves, scale }, factor, tone) {
    // The bytes of every half float there is: far fewer than there are pixels.
    const { apply } = TONES[tone];
    const bytes = Uint8ClampedArray.from(
      floats, (v) => 255 * toSrgb(apply(Math.max(v * scale * factor, 0))));
    const next = channels === 1 ? 0 : 1;
    return (index) => {
      const at = index * channels;
      const [r, g, b] = [halves[at], halves[at + next], halves[at + 2 * next]];
      if (!Number.isFinite(floats[r] + floats[g] + floats[b])) return MAGENTA;
      return pack(bytes[r], bytes[g], bytes[b]);
    };
  }

  /** Pixel's index -> the colour of a map's value. */
  function mapOf(image, reference, map, full) {
    const given = MAPS[map];
    const { channels } = image;
    return (index) => {
      let sum = 0;
      for (let at = index * channels; at < (index + 1) * channels; at++) {
        const z = floats[image.halves[at]] * image.scale;
        sum += given.error ? given.error(z, floats[reference.halves[at]] * reference.scale) : z;
      }
      if (!Number.isFinite(sum)) return MAGENTA;
      return pack(...mapped(given, position(given, full, sum / channels)));
    };
  }

  function drawPanel({ rect, image, reference, map, full, factor, tone, zoom, origin }) {
    const left = Math.max(rect.x, Math.floor(origin.x));
    const top = Math.max(rect.y, Math.floor(origin.y));
    const right = Math.min(rect.x + rect.width, Math.ceil(origin.x + image.width * zoom));
    const bottom = Math.min(rect.y + rect.height, Math.ceil(origin.y + image.height * zoom));
    if (right <= left || bottom <= top) return;
    const drawn = context.createImageData(right - left, bottom - top);
    const column = (x) => Math.floor((x + 0.5 - origin.x) / zoom);
    const row = (y) => Math.floor((y + 0.5 - origin.y) / zoom);
    const colorAt = map === "image" ? picture(image, factor, tone) : mapOf(image, reference, map, full);
    const bytes = new Uint32Array(drawn.data.buffer);
    for (let y = top, to = 0; y < bottom; y++) {
      const j = row(y);
      for (let x = left, before = -1, packed = 0; x < right; x++, to++) {
        const i = column(x);
        if (i < 0 || j < 0 || i >= image.width || j >= image.height) continue;
        if (i !== before) packed = colorAt(j * image.width + i);
        before = i;
        bytes[to] = packed;
      }
    }
    context.putImageData(drawn, left, top);
  }

  return {
    name: "canvas",
    largest: Infinity,
    draw(panels) {
      context.clearRect(0, 0, canvas.width, canvas.height);
      panels.forEach(drawPanel);
    },
    forget() {},
  };
};
