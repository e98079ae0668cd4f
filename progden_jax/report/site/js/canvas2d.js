"use strict";

/* Draws panels without WebGL, pixel by pixel: the same pictures, but slower, and shrunk ones unsmoothed. */
progden.canvas2d = (canvas) => {
  const { TONES, MAPS, toSrgb, position, mapped, BAD } = progden.color;
  const { floats } = progden.images;
  const context = canvas.getContext("2d");

  function drawPanel({ rect, image, reference, map, full, factor, tone, zoom, origin }) {
    const left = Math.max(rect.x, Math.floor(origin.x));
    const top = Math.max(rect.y, Math.floor(origin.y));
    const right = Math.min(rect.x + rect.width, Math.ceil(origin.x + image.width * zoom));
    const bottom = Math.min(rect.y + rect.height, Math.ceil(origin.y + image.height * zoom));
    if (right <= left || bottom <= top) return;
    const drawn = context.createImageData(right - left, bottom - top);
    const column = (x) => Math.floor((x + 0.5 - origin.x) / zoom);
    const row = (y) => Math.floor((y + 0.5 - origin.y) / zoom);
    // All exposed and toned bytes of a half float: far fewer than there are pixels.
    const scale = image.scale * factor;
    const bytes = map === "image" && Uint8ClampedArray.from(
      floats, (v) => 255 * toSrgb(TONES[tone].apply(Math.max(v * scale, 0))));
    const { channels, halves } = image;
    const given = MAPS[map];
    const value = (of, at, channel) =>
      floats[of.halves[of.channels === 1 ? at : 3 * at + channel]] * of.scale;

    function colour(at) {
      const last = channels === 1 ? 0 : 2;
      let sum = 0;
      for (let channel = 0; channel <= last; channel++) {
        const z = value(image, at, channel);
        sum += given.error ? given.error(z, value(reference, at, channel)) : z;
      }
      if (!Number.isFinite(sum)) return BAD;
      return mapped(given, position(given, full, sum / (last + 1)));
    }
    function picture(at) {
      const triple = [0, 1, 2].map((c) => halves[channels === 1 ? at : 3 * at + c]);
      return triple.every((half) => Number.isFinite(floats[half]))
        ? triple.map((half) => bytes[half])
        : BAD;
    }

    const of = bytes ? picture : colour;
    for (let y = top, to = 0; y < bottom; y++) {
      const j = row(y);
      let before = -1;
      let rgb = BAD;
      for (let x = left; x < right; x++, to += 4) {
        const i = column(x);
        if (i < 0 || j < 0 || i >= image.width || j >= image.height) continue;
        if (i !== before) rgb = of(j * image.width + i);
        before = i;
        drawn.data.set([rgb[0], rgb[1], rgb[2], 255], to);
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
