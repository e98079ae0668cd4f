"use strict";

/* Draws panels with WebGL 2: half floats go to the card as they are, so that exposure, tone curve, zoom
   and maps cost nothing but a redraw. */
progden.webgl = (canvas, evenSlow) => {
  const { TONES, MAPS, colormaps } = progden.color;
  const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
  if (!gl) return null;
  // WebGL in software is slower than none: Chromium's, Mesa's and Windows' are.
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const card = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  if (!evenSlow && /swiftshader|llvmpipe|softpipe|software|basic render/i.test(card)) return null;

  const names = Object.keys(MAPS);
  const tones = Object.keys(TONES);
  const branches = (keys, body) => keys.map((key, i) => `if (choice == ${i}) ${body(key)};`).join("\n");
  const VERTEX = `#version 300 es
    void main() {
      gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    precision highp int;
    uniform highp sampler2D picture, reference, colors;
    uniform float pictureScale, referenceScale, factor, zoom, full, steep;
    uniform vec2 origin; // of the image in the canvas, from its top left
    uniform int map, tone, taps, canvasHeight;
    uniform bool grey, isSigned;
    out vec4 result;

    vec3 curve(vec3 v, int choice) { ${branches(tones, (key) => `return ${TONES[key].glsl}`)} return v; }
    vec3 error(vec3 z, vec3 m, int choice) {
      ${branches(names, (key) => `return ${MAPS[key].glsl ?? "z"}`)}
      return z;
    }
    // isnan and isinf may be compiled away.
    bool bad(vec3 v) {
      const uint infinite = 0x7f800000u;
      return any(equal(floatBitsToUint(v) & infinite, uvec3(infinite)));
    }

    vec3 shown(ivec2 at) {
      vec3 v = texelFetch(picture, at, 0).rgb * pictureScale;
      if (grey) v = v.rrr;
      if (bad(v)) return vec3(1, 0, 1);
      if (map == 0) {
        v = curve(max(v * factor, 0.0), tone);
        return mix(12.92 * v, 1.055 * pow(v, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, v));
      }
      vec3 e = error(v, texelFetch(reference, at, 0).rgb * referenceScale, map);
      if (bad(e)) return vec3(1, 0, 1);
      float part = (e.r + e.g + e.b) / 3.0 / full;
      // asinh by its logarithm, which loses nothing for small values, as the library's may.
      float size = steep * abs(part);
      float bent = steep > 0.0 ? sign(part) * log(size + sqrt(size * size + 1.0)) : part;
      if (steep > 0.0) bent /= log(steep + sqrt(steep * steep + 1.0));
      float place = clamp(isSigned ? 0.5 + 0.5 * bent : bent, 0.0, 1.0);
      return texelFetch(colors, ivec2(min(255, int(place * 256.0)), 0), 0).rgb;
    }

    void main() {
      vec2 device = vec2(gl_FragCoord.x, float(canvasHeight) - gl_FragCoord.y) - origin;
      ivec2 size = textureSize(picture, 0);
      vec2 at = device / zoom;
      if (any(lessThan(at, vec2(0))) || any(greaterThanEqual(at, vec2(size)))) discard;
      vec3 sum = vec3(0);
      for (int y = 0; y < taps; y++) for (int x = 0; x < taps; x++) {
        vec2 tap = at + ((vec2(x, y) + 0.5) / float(taps) - 0.5) / zoom;
        sum += shown(clamp(ivec2(floor(tap)), ivec2(0), size - 1));
      }
      result = vec4(sum / float(taps * taps), 1);
    }`;

  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    console.warn("WebGL is not used:", gl.getProgramInfoLog(program));
    return null;
  }
  gl.useProgram(program);
  const uniform = new Proxy({}, { get: (known, name) =>
    (known[name] ??= gl.getUniformLocation(program, name)) });
  ["picture", "reference", "colors"].forEach((name, unit) => gl.uniform1i(uniform[name], unit));

  const textures = new Map(); // image or colour map -> texture

  function bind(unit, of, upload) {
    gl.activeTexture(gl.TEXTURE0 + unit);
    let texture = textures.get(of);
    if (texture) return gl.bindTexture(gl.TEXTURE_2D, texture);
    texture = gl.createTexture();
    textures.set(of, texture);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    }
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    return upload();
  }

  function bindImage(unit, image) {
    const [inside, outside] = image.channels === 1 ? [gl.R16F, gl.RED] : [gl.RGB16F, gl.RGB];
    bind(unit, image, () => gl.texImage2D(
      gl.TEXTURE_2D, 0, inside, image.width, image.height, 0, outside, gl.HALF_FLOAT, image.halves,
    ));
  }

  return {
    name: "webgl",
    largest: gl.getParameter(gl.MAX_TEXTURE_SIZE),

    /** See progden.viewer for what a panel holds. */
    draw(panels) {
      gl.disable(gl.SCISSOR_TEST);
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
      gl.enable(gl.SCISSOR_TEST);
      gl.uniform1i(uniform.canvasHeight, canvas.height);
      for (const { rect, image, reference, map, full, factor, tone, zoom, origin } of panels) {
        const { colors, steep, signed } = MAPS[map];
        gl.scissor(rect.x, canvas.height - rect.y - rect.height, rect.width, rect.height);
        bindImage(0, image);
        bindImage(1, reference ?? image);
        const bytes = colormaps[colors ?? "error"];
        bind(2, bytes, () =>
          gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, bytes));
        gl.uniform1f(uniform.pictureScale, image.scale);
        gl.uniform1f(uniform.referenceScale, (reference ?? image).scale);
        gl.uniform1f(uniform.factor, factor);
        gl.uniform1f(uniform.zoom, zoom);
        gl.uniform1f(uniform.full, full);
        gl.uniform1f(uniform.steep, steep ?? 0);
        gl.uniform2f(uniform.origin, origin.x, origin.y);
        gl.uniform1i(uniform.map, names.indexOf(map));
        gl.uniform1i(uniform.tone, tones.indexOf(tone));
        // Shrunk pictures average what falls into a pixel, as image viewers do.
        gl.uniform1i(uniform.taps, Math.min(8, Math.ceil(1 / zoom - 1e-6)));
        gl.uniform1i(uniform.grey, image.channels === 1);
        gl.uniform1i(uniform.isSigned, signed ? 1 : 0);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
      }
    },

    forget(image) {
      gl.deleteTexture(textures.get(image) ?? null);
      textures.delete(image);
    },
  };
};
