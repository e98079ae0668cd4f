"use strict";

/* Small helpers for the page's elements. Text only ever goes in as text, never as markup. */
progden.page = (() => {
  const byId = (id) => document.getElementById(id);

  /** An element with attributes and children; `on…` functions listen, null leaves out. */
  function element(name, attributes = {}, ...children) {
    return fill(document.createElement(name), attributes, children);
  }

  function svg(name, attributes = {}, ...children) {
    return fill(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
  }

  function fill(made, attributes, children) {
    for (const [key, value] of Object.entries(attributes)) {
      if (value === null || value === undefined) continue;
      if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
      else made.setAttribute(key, value);
    }
    made.append(...children.filter((child) => child !== null));
    return made;
  }

  /** Gives a select these [value, text] pairs, and calls `chosen` with what is picked. */
  function select(id, options, chosen) {
    const made = byId(id);
    setOptions(made, options);
    made.addEventListener("change", () => chosen(made.value));
    return made;
  }

  function setOptions(made, options) {
    made.replaceChildren(...options.map(([value, text]) => element("option", { value }, text)));
  }

  /** A number as tables and labels show it, in three digits. */
  function number(value) {
    if (value === null || value === undefined) return "–";
    if (!Number.isFinite(value)) return String(value);
    const size = Math.abs(value);
    if (size === 0) return "0";
    if (size < 1e-3 || size >= 1e5) return value.toExponential(2).replaceAll("-", "−");
    return (size >= 1000 ? value.toFixed(0) : value.toPrecision(3)).replace("-", "−");
  }

  /** How plots and labels tell methods apart: a colour of the scheme, a marker, a dash. */
  const MARKERS = [
    "M4 0A4 4 0 1 1-4 0A4 4 0 1 1 4 0Z",
    "M-3.5-3.5H3.5V3.5H-3.5Z",
    "M0-5L4.5 3.5H-4.5Z",
    "M0-5L5 0L0 5L-5 0Z",
    "M0 5L4.5-3.5H-4.5Z",
    "M-4.5-1.5H-1.5V-4.5H1.5V-1.5H4.5V1.5H1.5V4.5H-1.5V1.5H-4.5Z",
    "M-5 0L-1.5-1.5L0-5L1.5-1.5L5 0L1.5 1.5L0 5L-1.5 1.5Z",
  ];
  const COLORS = 8;
  function style(method) {
    return {
      color: `var(--method-${method % COLORS})`,
      marker: MARKERS[method % MARKERS.length],
      dash: ["none", "6 3", "2 3"][Math.floor(method / COLORS) % 3],
    };
  }

  function swatch(method) {
    const { color, marker, dash } = style(method);
    return svg(
      "svg", { width: 26, height: 12, viewBox: "-13 -6 26 12", "aria-hidden": "true" },
      svg("path", { d: "M-13 0H13", stroke: color, "stroke-width": 2, "stroke-dasharray": dash }),
      svg("path", { d: marker, fill: color }),
    );
  }

  return { byId, element, svg, select, setOptions, number, style, swatch };
})();
