"use strict";

/* From values to colours: tone curves and maps, each in JavaScript and in GLSL side by side. */
progden.color = (() => {
  const { data } = progden;

  /** Display values of linear light in [0, ∞); the sRGB curve follows. ACES as Narkowicz 2015 fits it. */
  const TONES = {
    srgb: { label: "sRGB, clipped", apply: (v) => Math.min(v, 1), glsl: "min(v, 1.0)" },
    reinhard: { label: "Reinhard", apply: (v) => v / (1 + v), glsl: "v / (1.0 + v)" },
    aces: {
      label: "ACES",
      apply: (v) => Math.min((v * (2.51 * v + 0.03)) / (v * (2.43 * v + 0.59) + 0.14), 1),
      glsl: "min(v * (2.51 * v + 0.03) / (v * (2.43 * v + 0.59) + 0.14), 1.0)",
    },
  };

  const toSrgb = (v) => (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055);

  /**
   * What can be shown of a pixel besides its colour. `of` names the picture it is taken from; `error`
   * is of one channel z and its reference m, averaged over channels. `full` is the end of the colour
   * scale, given the exposure's factor: where light that the tone curve makes white is the end.
   * `steep` compresses a scale of many decades by asinh(steep · v / full).
   */
  const MAPS = {
    image: { label: "Image", of: "image" },
    signed: {
      label: "Difference", of: "image", colors: "signed", signed: true, steep: 100,
      full: (factor) => 1 / factor,
      about: "image − reference, mean of R, G, B",
      error: (z, m) => z - m, glsl: "z - m",
    },
    absolute: {
      label: "Absolute difference", of: "image", colors: "error", steep: 100,
      full: (factor) => 1 / factor,
      about: "|image − reference|, mean of R, G, B",
      error: (z, m) => Math.abs(z - m), glsl: "abs(z - m)",
    },
    relative: {
      label: "Relative difference", of: "image", colors: "error", steep: 0,
      full: () => 1,
      about: "|z − μ| / (|z| + |μ| + 0.01), whose mean is SMAPE",
      error: (z, m) => Math.abs(z - m) / (Math.abs(z) + Math.abs(m) + 0.01),
      glsl: "abs(z - m) / (abs(z) + abs(m) + 0.01)",
    },
    flip: {
      label: "FLIP", of: "flip", colors: "flip", steep: 0, full: () => 1,
      about: "HDR-FLIP, whose mean is the table's",
    },
    alpha: {
      label: "α", of: "alpha", colors: "alpha", steep: 0, full: () => 1,
      about: "weight of the denoised image, mean of R, G, B",
    },
    sure: {
      label: "SURE", of: "sure", colors: "signed", signed: true, steep: 1e4,
      full: (factor) => 1 / factor ** 2,
      about: "estimated squared error of the denoised image, mean of R, G, B; may be negative",
    },
  };

  const colormaps = Object.fromEntries(
    Object.entries(data.colormaps).map(([name, text]) => [
      name, Uint8Array.from(atob(text), (character) => character.charCodeAt(0)),
    ]),
  );

  /** Where a value lies on a map's colours, in [0, 1]. */
  function position(map, full, value) {
    const part = value / full;
    const bent = map.steep ? Math.asinh(map.steep * part) / Math.asinh(map.steep) : part;
    return Math.min(Math.max(map.signed ? 0.5 + 0.5 * bent : bent, 0), 1);
  }

  /** The colour of a position, as bytes [r, g, b]. */
  function mapped(map, at) {
    const index = 3 * Math.min(255, Math.floor(at * 256));
    return colormaps[map.colors].subarray(index, index + 3);
  }

  return { TONES, MAPS, toSrgb, colormaps, position, mapped, BAD: [255, 0, 255] };
})();
