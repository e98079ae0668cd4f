"use strict";

/* Errors over samples, both axes logarithmic: the mean over scenes, large, and each scene. */
progden.plots = (() => {
  const { data, state, results } = progden;
  const { byId, element, svg, number, style } = progden.page;

  /** Ticks of a logarithmic axis: [value, whether labelled], more than decades where few fit. */
  function ticks(low, high) {
    const found = [];
    const decades = Math.log10(high / low);
    const step = Math.max(1, Math.ceil(decades / 7));
    for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++) {
      for (const lead of [1, 2, 3, 4, 5, 6, 7, 8, 9]) {
        const value = lead * 10 ** power;
        if (value < low * 0.999 || value > high * 1.001) continue;
        const often = decades < 0.7 ? true : decades < 2.2 ? [1, 2, 5].includes(lead) : lead === 1;
        found.push([value, often && power % step === 0]);
      }
    }
    return found.length ? found : [[low, true], [high, true]];
  }

  const plain = (value) =>
    value >= 1e-3 && value < 1e5 ? String(Number(value.toPrecision(3))) : value.toExponential(0);

  /**
   * A plot of series [{method, points: [{spp, value, low, high, count}]}], those without points left out.
   */
  function plot(series, { title, unit, width, height, line = null }) {
    const points = series.flatMap((one) => one.points);
    const caption = element("h3", {}, title);
    if (!points.length) return element("figure", {}, caption, element("p", {}, "Nothing to plot."));
    const margin = { left: 58, right: 14, top: 10, bottom: 40 };
    const ys = points.flatMap(({ value, low, high }) => [value, low ?? value, high ?? value]);
    if (line !== null) ys.push(line);
    const spread = (list) => {
      const [low, high] = [Math.min(...list), Math.max(...list)];
      const room = Math.max((high / low) ** 0.06, 1.05);
      return [low / room, high * room];
    };
    const xRange = spread(points.map(({ spp }) => spp));
    const yRange = spread(ys);
    const along = (value, [low, high], from, to) =>
      from + ((to - from) * Math.log(value / low)) / Math.log(high / low);
    const x = (value) => along(value, xRange, margin.left, width - margin.right);
    const y = (value) => along(value, yRange, height - margin.bottom, margin.top);

    const drawn = svg("svg", {
      viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": describe(series, title, unit),
    });
    const grid = (x1, y1, x2, y2, name) => drawn.append(
      svg("path", { d: `M${x1} ${y1}L${x2} ${y2}`, class: name }));
    const text = (at, body, attributes) => drawn.append(
      svg("text", { x: at[0], y: at[1], ...attributes }, body));
    for (const [value, labelled] of ticks(...yRange)) {
      grid(margin.left, y(value), width - margin.right, y(value), labelled ? "grid" : "minor");
      if (labelled) text([margin.left - 7, y(value) + 4], plain(value), { "text-anchor": "end" });
    }
    for (const spp of [...new Set(points.map((point) => point.spp))]) {
      grid(x(spp), margin.top, x(spp), height - margin.bottom, "grid");
      text([x(spp), height - margin.bottom + 16], String(spp), { "text-anchor": "middle" });
    }
    if (line !== null) grid(margin.left, y(line), width - margin.right, y(line), "baseline");
    text([(margin.left + width - margin.right) / 2, height - 6], "samples per pixel",
      { "text-anchor": "middle", class: "axis" });
    const middle = (margin.top + height - margin.bottom) / 2;
    text([13, middle], unit,
      { "text-anchor": "middle", class: "axis", transform: `rotate(-90 13 ${middle})` });
    for (const { method, points: own } of series) {
      drawn.append(curve(method, own, x, y));
    }
    return element("figure", {}, caption, drawn);
  }

  function curve(method, points, x, y) {
    const { color, marker, dash } = style(method);
    const name = data.methods[method].name;
    const group = svg("g", { class: "curve", "data-method": name });
    const d = points.map(({ spp, value }, i) => `${i ? "L" : "M"}${x(spp)} ${y(value)}`).join("");
    group.append(svg("path", {
      d, fill: "none", stroke: color, "stroke-width": 2, "stroke-dasharray": dash,
    }));
    for (const { spp, value, low, high } of points) {
      const at = x(spp);
      if (low !== null && low !== undefined) {
        group.append(svg("path", {
          d: `M${at} ${y(low)}V${y(high)}M${at - 4} ${y(low)}h8M${at - 4} ${y(high)}h8`,
          stroke: color, "stroke-width": 1.2, opacity: 0.8,
        }));
      }
      const span = low == null ? "" : ` (${number(low)} to ${number(high)})`;
      group.append(svg("path",
        { d: marker, fill: color, class: "point", transform: `translate(${at} ${y(value)})` },
        svg("title", {}, `${name}, ${spp} spp: ${number(value)}${span}`)));
    }
    return group;
  }

  function describe(series, title, unit) {
    const ends = series.filter(({ points }) => points.length).map(({ method, points }) => {
      const [first, last] = [points[0], points[points.length - 1]];
      return `${data.methods[method].name} from ${number(first.value)} at ${first.spp}` +
        ` to ${number(last.value)} at ${last.spp}`;
    });
    return `${title}: ${unit} over samples per pixel. ${ends.join("; ")}.`;
  }

  let drawnFor = "";

  function draw({ metric, baseline }) {
    const width = Math.min(760, Math.max(300, byId("mean-plot").clientWidth));
    const now = JSON.stringify([metric, baseline, state.shown(), width]);
    if (now === drawnFor) return;
    drawnFor = now;
    const { label } = data.metrics.find(({ name }) => name === metric);
    const methods = state.shown();
    const relative = baseline !== null;
    const unit = relative ? `${label} / ${data.methods[baseline].name}` : label;
    const positive = (points) => points.filter((point) => point && point.value > 0);
    const means = methods.map((method) => ({
      method,
      points: positive(results.spps.map((spp) => {
        const mean = results.mean(spp, method, metric, baseline);
        // Without a baseline an interval would only say how much scenes differ.
        return mean && { spp, ...mean, ...(relative ? {} : { low: null, high: null }) };
      })),
    }));
    const line = relative ? 1 : null;
    const percent = Math.round(100 * data.confidence);
    const over = data.scenes.length === 1 ? "1 scene" : `${data.scenes.length} scenes`;
    const title = `Geometric mean over ${over}` +
      (relative && data.scenes.length > 1 ? `, with its ${percent} % interval` : "");
    byId("mean-plot").replaceChildren(plot(means, { title, unit, width, height: Math.min(420, 0.7 * width), line }));
    byId("scene-plots").replaceChildren(...data.scenes.map((scene, index) => {
      const series = methods.map((method) => ({
        method,
        points: positive(results.spps.map((spp) => {
          const top = results.value(index, spp, method, metric);
          const bottom = relative ? results.value(index, spp, baseline, metric) : 1;
          return top !== null && bottom > 0 ? { spp, value: top / bottom } : null;
        })),
      }));
      return plot(series, { title: scene.name, unit, width: 400, height: 280, line });
    }));
  }

  new ResizeObserver(state.notify).observe(byId("mean-plot"));
  return { draw };
})();
