"use strict";

/* The stage: one canvas with a panel per picture, all at one zoom and one place. Lengths are device pixels
   but for those of styles. A panel is {rect, image, reference, map, full, factor, tone, zoom, origin}. */
progden.viewer = (() => {
  const { data, state, results, images, color } = progden;
  const { byId, element, number, swatch } = progden.page;
  const { REFERENCE, values } = state;
  const STRIP = 40; // style pixels above a panel, for its label
  const GAP = 6;
  const stage = byId("stage");
  let canvas = byId("canvas");
  let renderer = null;
  let view = null; // what was drawn last: {zoom, x, y, size, slots}
  let cursor = null; // the pixel whose values are shown: {x, y}

  /** What stands side by side, or alone: methods, or the reference. */
  function entries() {
    if (values.layout === "flip") return [values.method];
    const reference = results.reference(values.scene, values.spp) ? [REFERENCE] : [];
    const has = (method) => results.row(values.scene, values.spp, method);
    return [...reference, ...state.shown().filter(has)];
  }

  /** {picture, reference, map, missing}: names of images, or why there is none. */
  function wanted(method) {
    const reference = results.reference(values.scene, values.spp);
    if (method === REFERENCE) {
      return { picture: reference, map: "image", missing: "no reference" };
    }
    const pictures = results.row(values.scene, values.spp, method)?.pictures ?? {};
    const { of, error, label } = color.MAPS[values.map];
    if (error && !reference) return { picture: null, map: values.map, missing: "no reference" };
    const missing = of === "image" ? "no image kept" : `no ${label} of this`;
    return { picture: pictures[of], reference: error && reference, map: values.map, missing };
  }

  function start() {
    // ?canvas and ?webgl choose, for those who look for a fault.
    const asked = new URLSearchParams(location.search);
    renderer = asked.has("canvas") ? null : progden.webgl(canvas, asked.has("webgl"));
    if (!renderer) useCanvas();
    canvas.addEventListener("webglcontextlost", useCanvas);
    stage.dataset.renderer = renderer.name;
    images.onChange(state.notify);
    images.onDrop((image) => renderer.forget(image));
  }

  /** Draws without WebGL from now on; a canvas that had a context keeps its kind, so a new one. */
  function useCanvas() {
    const fresh = canvas.cloneNode();
    canvas.replaceWith(fresh);
    canvas = fresh;
    renderer = progden.canvas2d(canvas);
    stage.dataset.renderer = renderer.name;
    state.notify();
  }

  /** Rows and columns that make `count` pictures largest. */
  function grid(count, width, height, aspect, strip) {
    let best = null;
    for (let columns = 1; columns <= count; columns++) {
      const rows = Math.ceil(count / columns);
      const scale = Math.min(width / columns / aspect, height / rows - strip);
      if (!best || scale > best.scale) best = { columns, rows, scale };
    }
    return best;
  }

  function slots(list, size) {
    const ratio = devicePixelRatio;
    const [gap, strip] = [Math.round(GAP * ratio), Math.round(STRIP * ratio)];
    const { columns, rows } = grid(
      list.length, canvas.width, canvas.height, size ? size.width / size.height : 1.5, strip);
    const width = Math.floor((canvas.width - gap * (columns - 1)) / columns);
    const height = Math.floor((canvas.height - gap * (rows - 1)) / rows);
    return list.map((method, i) => {
      const x = (i % columns) * (width + gap);
      const y = Math.floor(i / columns) * (height + gap) + strip;
      return { method, rect: { x, y, width, height: Math.max(1, height - strip) } };
    });
  }

  /** The magnification that shows all of an image, whole for one that is small enough. */
  function fit(size, rect) {
    const zoom = Math.min(rect.width / size.width, rect.height / size.height);
    return zoom >= 1 ? Math.floor(zoom) : zoom;
  }

  function resize() {
    const width = Math.max(1, Math.round(stage.clientWidth * devicePixelRatio));
    const height = Math.max(1, Math.round(stage.clientHeight * devicePixelRatio));
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
  }

  function draw() {
    if (!renderer) start();
    resize();
    const loaded = entries().map((method) => {
      const { picture, reference, map, missing } = wanted(method);
      const found = picture ? images.get(picture) : { state: missing };
      const other = reference ? images.get(reference) : null;
      const ready = found.state === "ready" && (!other || other.state === "ready");
      const waiting = [found, other].find((entry) => entry && entry.state !== "ready");
      return { method, map, image: found.image, reference: other?.image, ready, status: waiting?.state };
    });
    const size = loaded.find(({ image }) => image)?.image ?? null;
    const placed = slots(loaded.map(({ method }) => method), size);
    if (size && Math.max(size.width, size.height) > renderer.largest) return useCanvas();
    view = { size, slots: placed, zoom: 1, x: 0, y: 0 };
    if (size) {
      const whole = values.zoom === null;
      view.zoom = whole ? fit(size, placed[0].rect) : values.zoom;
      view.x = whole ? size.width / 2 : Math.min(Math.max(values.x, 0), size.width);
      view.y = whole ? size.height / 2 : Math.min(Math.max(values.y, 0), size.height);
    }
    placed.forEach((slot, i) => Object.assign(slot, loaded[i]));
    renderer.draw(placed.filter(({ ready }) => ready).map(panel));
    images.trim(new Set(loaded.flatMap(({ image, reference }) => [image?.name, reference?.name])));
    stage.dataset.state = placed.some(({ status }) => status === "loading") ? "loading" : "ready";
    label();
    byId("message").textContent = placed.length ? "" : "There are no pictures of this in the report.";
  }

  function panel({ rect, image, reference, map }) {
    const factor = 2 ** (data.scenes[values.scene].exposure + values.exposure);
    const { x, y, zoom } = view;
    const origin = {
      x: rect.x + Math.round(rect.width / 2 - x * zoom),
      y: rect.y + Math.round(rect.height / 2 - y * zoom),
    };
    const full = color.MAPS[map].full?.(factor) ?? 1;
    return { rect, image, reference, map, full, factor, tone: values.tone, zoom, origin };
  }

  function label() {
    byId("labels").replaceChildren(...view.slots.map((slot) => {
      const { method, rect, status } = slot;
      const metric = data.metrics.find(({ name }) => name === values.metric);
      const error = method === REFERENCE
        ? null : results.value(values.scene, values.spp, method, values.metric);
      const texts = {
        loading: "loading …", failed: "this image's file is missing or damaged", undefined: "",
      };
      slot.readout = element("span", { class: "values" });
      const style = `left:${rect.x / devicePixelRatio}px;width:${rect.width / devicePixelRatio}px;` +
        `top:${rect.y / devicePixelRatio - STRIP}px`;
      return element(
        "div", { class: "label", style },
        element("span", { class: "name" },
          method === REFERENCE ? null : swatch(method),
          method === REFERENCE ? "Reference" : data.methods[method].name),
        error === null ? null
          : element("span", { class: "error" }, `${metric.label} ${number(error)}`),
        element("span", { class: "status" }, status in texts ? texts[status] : status),
        slot.readout,
      );
    }));
    readOut();
  }

  /** The values under the cursor, of every panel. */
  function readOut() {
    const inside = view?.size && cursor
      && cursor.x >= 0 && cursor.y >= 0 && cursor.x < view.size.width && cursor.y < view.size.height;
    const zoom = view?.size ? `${number(100 * view.zoom)} %` : "";
    byId("readout").textContent = inside ? `pixel ${cursor.x}, ${cursor.y} · ${zoom}` : zoom;
    for (const slot of view?.slots ?? []) {
      slot.readout.textContent = inside && slot.ready ? describe(slot) : "";
    }
  }

  function describe({ image, reference, map }) {
    const { error } = color.MAPS[map];
    let numbers = images.pixel(image, cursor.x, cursor.y);
    if (error) {
      const truth = images.pixel(reference, cursor.x, cursor.y);
      numbers = numbers.map((value, i) => error(value, truth[i]));
    }
    return numbers.map(number).join("  ");
  }

  function slotAt(x, y) {
    const strip = STRIP * devicePixelRatio;
    const within = ({ rect }) =>
      x >= rect.x && y >= rect.y - strip && x < rect.x + rect.width && y < rect.y + rect.height;
    return view?.slots.find(within) ?? view?.slots[0];
  }

  /** The place of an event in the canvas, and the image point that is there. */
  function locate(event) {
    const box = canvas.getBoundingClientRect();
    const x = (event.clientX - box.left) * devicePixelRatio;
    const y = (event.clientY - box.top) * devicePixelRatio;
    const slot = slotAt(x, y);
    if (!view?.size || !slot) return null;
    const { origin } = panel(slot);
    const { rect } = slot;
    return {
      image: { x: (x - origin.x) / view.zoom, y: (y - origin.y) / view.zoom },
      fromMiddle: { x: x - rect.x - rect.width / 2, y: y - rect.y - rect.height / 2 },
    };
  }

  /** Magnify by a factor about a place, by default the panels' middle. */
  function zoomBy(factor, place = null) {
    if (!view?.size) return;
    const zoom = Math.min(256, Math.max(1 / 64, view.zoom * factor));
    const { image, fromMiddle } = place ?? { image: view, fromMiddle: { x: 0, y: 0 } };
    moveTo(image.x - fromMiddle.x / zoom, image.y - fromMiddle.y / zoom, zoom);
  }

  function moveTo(x, y, zoom = view.zoom) {
    const inside = (value, end) => Math.min(Math.max(value, 0), end);
    Object.assign(view, { zoom, x: inside(x, view.size.width), y: inside(y, view.size.height) });
    state.set({ zoom, x: view.x, y: view.y });
  }

  /** To the next power of two up (1) or down (−1). */
  function zoomStep(direction) {
    if (!view?.size) return;
    const now = Math.log2(view.zoom);
    const next = direction > 0 ? Math.floor(now + 1e-3) + 1 : Math.ceil(now - 1e-3) - 1;
    zoomBy(2 ** (next - now));
  }

  /** Pan by parts of a panel; the values read out are then those of the middle. */
  function pan(right, down) {
    if (!view?.size) return;
    const { rect } = view.slots[0];
    moveTo(view.x + (right * rect.width) / view.zoom, view.y + (down * rect.height) / view.zoom);
    cursor = { x: Math.floor(view.x), y: Math.floor(view.y) };
  }

  const pointers = new Map();
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1;
    zoomBy(2 ** (-Math.max(-400, Math.min(400, event.deltaY * lines)) / 200), locate(event));
  }, { passive: false });
  stage.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    stage.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
  });
  stage.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (before && view?.size) {
      const other = [...pointers.values()].find(({ pointerId }) => pointerId !== event.pointerId);
      if (other) {
        const distance = (a) => Math.hypot(a.clientX - other.clientX, a.clientY - other.clientY);
        zoomBy(distance(event) / Math.max(1, distance(before)), locate(other));
      } else {
        const scale = devicePixelRatio / view.zoom;
        moveTo(view.x - (event.clientX - before.clientX) * scale,
          view.y - (event.clientY - before.clientY) * scale);
      }
      pointers.set(event.pointerId, event);
    }
    const place = locate(event);
    cursor = place && { x: Math.floor(place.image.x), y: Math.floor(place.image.y) };
    readOut();
  });
  for (const name of ["pointerup", "pointercancel"]) {
    stage.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  stage.addEventListener("pointerleave", () => {
    cursor = null;
    readOut();
  });
  new ResizeObserver(() => state.notify()).observe(stage);

  return {
    draw, zoomStep, pan,
    fit: () => state.set({ zoom: null, x: 0, y: 0 }),
    panels: () => view.slots.filter(({ ready }) => ready).map(panel),
  };
})();
