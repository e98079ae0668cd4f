"use strict";

/* Draws panels without WebGL: the same pictures, but another exposure takes a moment. */
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

  const painted = new WeakMap(); // image -> {as, drawn}, so that zoom and pan need no computing

  /** A canvas of the image's own size, its colours under these settings. */
  function paint({ image, reference, map, full, factor, tone }) {
    const as = [reference?.name, map, full, factor, tone].join();
    const known = painted.get(image);
    if (known?.as === as) return known.drawn;
    const drawn = known?.drawn ?? document.createElement("canvas");
    [drawn.width, drawn.height] = [image.width, image.height];
    const pixels = new ImageData(image.width, image.height);
    const bytes = new Uint32Array(pixels.data.buffer);
    const colorAt = map === "image" ? picture(image, factor, tone) : mapOf(image, reference, map, full);
    for (let index = 0; index < bytes.length; index++) bytes[index] = colorAt(index);
    drawn.getContext("2d").putImageData(pixels, 0, 0);
    painted.set(image, { as, drawn });
    return drawn;
  }

  function drawPanel(panel) {
    const { rect, image, zoom, origin } = panel;
    context.save();
    context.beginPath();
    context.rect(rect.x, rect.y, rect.width, rect.height);
    context.clip();
    context.imageSmoothingEnabled = zoom < 1;
    context.imageSmoothingQuality = "medium";
    context.drawImage(paint(panel), origin.x, origin.y, image.width * zoom, image.height * zoom);
    context.restore();
  }

  return {
    name: "canvas",
    largest: Infinity,
    draw(panels) {
      context.clearRect(0, 0, canvas.width, canvas.height);
      panels.forEach(drawPanel);
    },
    forget: (image) => painted.delete(image),
  };
};
