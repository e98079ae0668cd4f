"use strict";

/* What is shown, kept in the URL's hash so that a reload or a link brings it back. */
progden.state = (() => {
  const { data } = progden;
  const REFERENCE = -1;

  const oneOf = (...names) => ({
    initial: names[0],
    parse: (text) => (names.includes(text) ? text : undefined),
    print: String,
  });
  const named = (list, initial) => ({
    initial,
    parse: (text) => {
      const index = list.findIndex((item) => item.name === text);
      return index < 0 ? undefined : index;
    },
    print: (index) => list[index].name,
  });
  const numeric = (initial, low, high, digits) => ({
    initial,
    parse: (text) => {
      const value = Number(text);
      return text.trim() !== "" && value >= low && value <= high ? value : undefined;
    },
    print: (value) => String(Number(value.toFixed(digits))),
  });

  const method = named(data.methods, 0);
  const metrics = data.metrics.map((metric) => metric.name);
  const pictures = data.rows.some((row) => row.pictures.image);
  const fields = {
    view: oneOf(...(pictures ? ["images", "plots", "tables"] : ["plots", "tables", "images"])),
    scene: named(data.scenes, 0),
    spp: numeric(data.rows[0].spp, 0, Infinity, 0),
    // No method has an empty name, so that can stand for the reference.
    method: {
      initial: 0,
      parse: (text) => (text === "" ? REFERENCE : method.parse(text)),
      print: (index) => (index === REFERENCE ? "" : method.print(index)),
    },
    layout: oneOf("flip", "side"),
    map: oneOf("image", "signed", "absolute", "relative", "flip", "alpha", "sure"),
    tone: oneOf("srgb", "reinhard", "aces"),
    exposure: numeric(0, -30, 30, 2),
    // The magnification (null fits), in device pixels; the image point at the middle of a panel.
    zoom: numeric(null, 1 / 64, 256, 4),
    x: numeric(0, -1e6, 1e6, 4),
    y: numeric(0, -1e6, 1e6, 4),
    hide: {
      initial: "",
      parse: (text) => (/^(\d+(\.\d+)*)?$/.test(text) ? text : undefined),
      print: String,
    },
    metric: oneOf(...metrics),
    baseline: { ...method, initial: null },
    rows: oneOf("images", "methods", "settings"),
    sort: { initial: "", parse: String, print: String },
    scheme: oneOf("", "light", "dark"),
  };

  const values = {};
  const listeners = [];
  let written = null;
  let timer = 0;
  let frame = 0;

  function read() {
    const given = new URLSearchParams(location.hash.slice(1));
    for (const [name, field] of Object.entries(fields)) {
      const parsed = given.has(name) ? field.parse(given.get(name)) : undefined;
      values[name] = parsed === undefined ? field.initial : parsed;
    }
  }

  function write() {
    const hash = new URLSearchParams();
    for (const [name, field] of Object.entries(fields)) {
      if (values[name] !== field.initial) hash.set(name, field.print(values[name]));
    }
    written = `#${hash}`;
    history.replaceState(null, "", written);
  }

  function set(changes) {
    for (const [name, value] of Object.entries(changes)) {
      const { initial, parse, print } = fields[name];
      // As a reload will read it, so that one shows the same to the pixel.
      const kept = value === initial ? value : parse(print(value));
      values[name] = kept === undefined ? value : kept;
    }
    // Browsers refuse more than about a hundred of these in half a minute.
    clearTimeout(timer);
    timer = setTimeout(write, 200);
    notify();
  }

  /** Listeners run once before the next frame, however much has changed. */
  function notify() {
    if (frame) return;
    frame = requestAnimationFrame(() => {
      frame = 0;
      for (const listener of listeners) listener(values);
    });
  }

  addEventListener("hashchange", () => {
    if (location.hash === written) return;
    read();
    notify();
  });
  addEventListener("pagehide", () => {
    clearTimeout(timer);
    write();
  });
  read();

  const hidden = () => new Set(values.hide === "" ? [] : values.hide.split(".").map(Number));
  return {
    REFERENCE, values, set, notify, hidden, pictures,
    listen: (listener) => listeners.push(listener),
    /** Methods that are not switched off, in order. */
    shown: () => data.methods.map((_, index) => index).filter((index) => !hidden().has(index)),
    toggle(index) {
      const now = hidden();
      if (!now.delete(index)) now.add(index);
      set({ hide: [...now].sort((a, b) => a - b).join(".") });
    },
  };
})();
