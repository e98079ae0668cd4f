"use strict";

/* Tabs, controls and keys; what they set is in progden.state, from which everything is drawn. */
(() => {
  const { data, state, results, color, viewer, plots, tables } = progden;
  const { byId, element, select, setOptions, number, swatch } = progden.page;
  const { REFERENCE, values } = state;
  const VIEWS = ["images", "plots", "tables"];
  const drawings = { images: viewer.draw, plots: plots.draw, tables: tables.draw };

  document.title = data.title;
  byId("title").textContent = data.title;

  const listed = (list) => list.map(({ name }, index) => [index, name]);
  const metrics = data.metrics.map(({ name, label }) => [name, label]);
  const maps = Object.entries(color.MAPS)
    .filter(([, { of }]) => of === "image" || data.rows.some(({ pictures }) => pictures[of]));
  const controls = {
    scene: select("scene", listed(data.scenes), (value) => chooseScene(Number(value))),
    spp: select("spp", [], (value) => state.set({ spp: Number(value) })),
    map: select("map", maps.map(([name, { label }]) => [name, label]), (map) => state.set({ map })),
    tone: select(
      "tone", Object.entries(color.TONES).map(([name, { label }]) => [name, label]),
      (tone) => state.set({ tone })),
    metric: select("metric", metrics, (metric) => state.set({ metric })),
    baseline: select("baseline", [["", "nothing"], ...listed(data.methods)],
      (value) => state.set({ baseline: value === "" ? null : Number(value) })),
    rows: select("table-kind",
      [["images", "every image"], ["methods", "means over scenes"], ["settings", "settings"]],
      (rows) => state.set({ rows, sort: "" })),
    tableMetric: select("table-metric", metrics, (metric) => state.set({ metric })),
    tableBaseline: select("table-baseline", listed(data.methods),
      (value) => state.set({ baseline: Number(value) })),
  };
  byId("exposure").addEventListener("input", ({ target }) =>
    state.set({ exposure: Number(target.value) }));
  const click = (id, action) => byId(id).addEventListener("click", action);
  click("layout-flip", () => state.set({ layout: "flip" }));
  click("layout-side", () => state.set({ layout: "side" }));
  click("zoom-in", () => viewer.zoomStep(1));
  click("zoom-out", () => viewer.zoomStep(-1));
  click("zoom-fit", viewer.fit);
  click("csv", tables.download);
  click("help-open", () => byId("help").showModal());
  click("scheme", () => state.set({ scheme: dark() ? "light" : "dark" }));

  const system = matchMedia("(prefers-color-scheme: dark)");
  system.addEventListener("change", state.notify);
  const dark = () => (values.scheme === "" ? system.matches : values.scheme === "dark");

  VIEWS.forEach((view, index) => {
    const tab = byId(`tab-${view}`);
    tab.addEventListener("click", () => state.set({ view }));
    tab.addEventListener("keydown", ({ key }) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[key];
      if (!step) return;
      const next = VIEWS[(index + step + VIEWS.length) % VIEWS.length];
      state.set({ view: next });
      byId(`tab-${next}`).focus();
    });
  });

  /** To a scene, at the same samples if it has them, else at its next fewer ones. */
  function chooseScene(scene) {
    const known = results.sppsOf(scene);
    const fewer = known.filter((spp) => spp <= values.spp);
    state.set({ scene, spp: fewer.length ? fewer[fewer.length - 1] : known[0] });
  }

  /** Show a method, or where several are shown switch it on or off. */
  function choose(method) {
    if (values.view === "images" && values.layout === "flip") state.set({ method });
    else if (method !== REFERENCE) state.toggle(method);
  }

  function step(list, now, by) {
    const at = list.indexOf(now);
    return list[(at + by + list.length) % list.length];
  }

  const withReference = [REFERENCE, ...data.methods.keys()];
  const stepMethod = (by) => state.set({ method: step(withReference, values.method, by) });
  const stepSpp = (by) => state.set({ spp: step(results.sppsOf(values.scene), values.spp, by) });
  const stepScene = (by) => chooseScene(step([...data.scenes.keys()], values.scene, by));
  const stepMap = (by) => state.set({ map: step(maps.map(([name]) => name), values.map, by) });
  const expose = (stops) =>
    state.set({ exposure: Math.min(10, Math.max(-10, values.exposure + stops)) });

  /** [keys as events name them, what people read, action or null where it is only told]. */
  const KEYS = [
    [[], "1 … 9", "show a method; side by side, in plots and tables: switch it on or off"],
    ["rR", "r", "show the reference", () => choose(REFERENCE)],
    [["]"], "] [", "next, previous method", () => stepMethod(1)],
    [["["], null, null, () => stepMethod(-1)],
    [["."], ". ,", "more, fewer samples", () => stepSpp(1)],
    [[","], null, null, () => stepSpp(-1)],
    [["n"], "n N", "next, previous scene", () => stepScene(1)],
    [["N"], null, null, () => stepScene(-1)],
    [["m"], "m M", "next, previous map: image, differences, FLIP, α, SURE", () => stepMap(1)],
    [["M"], null, null, () => stepMap(-1)],
    ["sS", "s", "side by side, or one picture", () =>
      state.set({ layout: values.layout === "flip" ? "side" : "flip" })],
    [["e"], "e E", "exposure up, down by half a stop", () => expose(0.5)],
    [["E"], null, null, () => expose(-0.5)],
    ["tT", "t", "next tone curve", () =>
      state.set({ tone: step(Object.keys(color.TONES), values.tone, 1) })],
    [["+", "="], "+ −", "zoom in, out to the next power of two; the wheel zooms too", () => viewer.zoomStep(1)],
    [["-", "_"], null, null, () => viewer.zoomStep(-1)],
    [["0"], "0", "fit", viewer.fit],
    [[], "← ↑ → ↓", "pan, with the picture focused; so does dragging"],
    [["i"], "i p a", "images, plots (convergence), tables", () => state.set({ view: "images" })],
    [["p"], null, null, () => state.set({ view: "plots" })],
    [["a"], null, null, () => state.set({ view: "tables" })],
    ["dD", "d", "dark or light", () => byId("scheme").click()],
    [["?"], "?", "this help", () => byId("help").showModal()],
  ];
  byId("keys").replaceChildren(element("dl", {}, ...KEYS.filter(([, read]) => read).flatMap(
    ([, read, text]) => [element("dt", {}, ...read.split(" ").flatMap((key) => [
      key === "…" ? " … " : element("kbd", {}, key)])), element("dd", {}, text)])));
  byId("about").textContent =
    `Made by progden report ${data.version} on ${data.created}. Pixels that are NaN or infinite are magenta. ` +
    "Exposure is relative to what brings the reference's 90th percentile to 0.7.";

  const PANS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || byId("help").open) return;
    // Selects find options by what is typed.
    if (event.target.closest?.("select")) return;
    if (event.key in PANS && event.target === byId("stage")) {
      const [right, down] = PANS[event.key];
      viewer.pan(right / 8, down / 8);
    } else if (/^[1-9]$/.test(event.key)) {
      if (Number(event.key) > data.methods.length) return;
      choose(Number(event.key) - 1);
    } else {
      const found = KEYS.find(([keys]) => keys.includes(event.key));
      if (!found) return;
      found[3]();
    }
    event.preventDefault();
  });

  const chips = withReference.map((method) => {
    const name = method === REFERENCE ? "Reference" : data.methods[method].name;
    const key = method === REFERENCE ? "r" : method < 9 ? String(method + 1) : "";
    const chip = element("button", { class: "chip", "data-method": name, onclick: () => choose(method) },
      element("kbd", { "aria-hidden": "true" }, key),
      method === REFERENCE ? null : swatch(method), name);
    return [method, chip];
  });
  byId("methods").replaceChildren(...chips.map(([, chip]) => chip));

  let listedSpps = "";

  function update() {
    // A link may name samples that its scene does not have.
    const known = results.sppsOf(values.scene);
    if (!known.includes(values.spp)) values.spp = known[0];
    document.documentElement.dataset.scheme = dark() ? "dark" : "light";
    for (const view of VIEWS) {
      const chosen = view === values.view;
      byId(view).hidden = !chosen;
      byId(`tab-${view}`).setAttribute("aria-selected", chosen);
      byId(`tab-${view}`).tabIndex = chosen ? 0 : -1;
    }
    const flipping = values.view === "images" && values.layout === "flip";
    const hidden = state.hidden();
    for (const [method, chip] of chips) {
      const pressed = flipping ? method === values.method : !hidden.has(method);
      chip.setAttribute("aria-pressed", pressed);
      chip.hidden = method === REFERENCE && !flipping;
    }
    if (known.join() !== listedSpps) {
      listedSpps = known.join();
      setOptions(controls.spp, known.map((spp) => [spp, `${spp} spp`]));
    }
    for (const name of ["scene", "spp", "map", "tone", "metric", "rows"]) controls[name].value = values[name];
    controls.tableMetric.value = values.metric;
    controls.baseline.value = values.baseline ?? "";
    controls.tableBaseline.value = values.baseline ?? 0;
    byId("layout-flip").setAttribute("aria-pressed", values.layout === "flip");
    byId("layout-side").setAttribute("aria-pressed", values.layout === "side");
    byId("exposure").value = values.exposure;
    const stops = `${values.exposure < 0 ? "−" : "+"}${Math.abs(values.exposure)} EV`;
    byId("stops").textContent = stops;
    byId("exposure").setAttribute("aria-valuetext", stops);
    announce();
    legend();
    drawings[values.view](values);
  }

  function announce() {
    if (values.view !== "images" || values.layout !== "flip") return;
    const name = values.method === REFERENCE ? "Reference" : data.methods[values.method].name;
    const text = `${name}, ${data.scenes[values.scene].name}, ${values.spp} samples`;
    if (byId("announcement").textContent !== text) byId("announcement").textContent = text;
  }

  /** The colours of a map with their values. */
  function legend() {
    const map = color.MAPS[values.map];
    if (!map.colors) return byId("legend").replaceChildren();
    const full = map.full(2 ** (data.scenes[values.scene].exposure + values.exposure));
    const stops = Array.from({ length: 33 }, (_, i) => `rgb(${color.mapped(map, i / 32).join(" ")})`);
    const parts = map.steep ? [1, map.steep ** -0.5, 0] : [1, 0.5, 0];
    const signed = map.signed ? parts.filter((part) => part).map((part) => -part) : [];
    const ticks = [...parts, ...signed].map((part) => element(
      "span", { style: `left:${100 * color.position(map, full, part * full)}%` }, number(part * full)));
    byId("legend").replaceChildren(
      element("span", { class: "about" }, map.about),
      element("div", { class: "scale" },
        element("div", { class: "bar", style: `background:linear-gradient(to right,${stops})` }), ...ticks));
  }

  if (!state.pictures) byId("tab-images").disabled = true;
  state.listen(update);
  update();
})();
