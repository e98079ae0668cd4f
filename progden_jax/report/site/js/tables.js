"use strict";

/* Tables: a row per image, per method and samples (means over scenes), or the methods' settings. */
progden.tables = (() => {
  const { data, state, results } = progden;
  const { byId, element, number, swatch } = progden.page;

  const label = (metric) => data.metrics.find(({ name }) => name === metric).label;
  const column = (name, title, numeric = true) => ({ name, title, numeric });
  const METHOD = column("method", "method", false);

  /** {columns, rows, note}: of a row, column name -> value. */
  const TABLES = {
    images() {
      const rows = data.rows.map((row) => ({
        scene: data.scenes[row.scene].name, spp: row.spp, method: data.methods[row.method].name,
        ...row.values, index: row.method,
      }));
      const metrics = data.metrics.map(({ name, label: title }) => column(name, title));
      return { columns: [column("scene", "scene", false), column("spp", "spp"), METHOD, ...metrics], rows };
    },
    methods({ metric, baseline }) {
      const against = baseline ?? 0;
      const rows = results.spps.flatMap((spp) => data.methods.map(({ name }, index) => {
        const mean = results.mean(spp, index, metric);
        const ratio = results.mean(spp, index, metric, against);
        return mean && {
          spp, method: name, index, scenes: mean.count, mean: mean.value, ratio: ratio?.value,
          low: ratio?.low, high: ratio?.high,
        };
      })).filter((row) => row);
      const percent = Math.round(100 * data.confidence);
      const note = `Geometric means of ${label(metric)} over scenes; their ratio to ` +
        `${data.methods[against].name}, scene by scene, with the ${percent} % t interval of its mean logarithm.`;
      const columns = [
        column("spp", "spp"), METHOD, column("scenes", "scenes"), column("mean", label(metric)),
        column("ratio", "ratio"), column("low", "from"), column("high", "to"),
      ];
      return { columns, rows, note };
    },
    settings() {
      const names = [...new Set(data.methods.flatMap(({ settings }) => Object.keys(settings)))].sort();
      const text = (value) => {
        if (value === null) return "–";
        return value === undefined || typeof value === "string" ? value : JSON.stringify(value);
      };
      const rows = data.methods.map(({ name, settings }, index) => ({
        method: name, index,
        ...Object.fromEntries(names.map((n) => [`set ${n}`, text(settings[n])])),
      }));
      return { columns: [METHOD, ...names.map((n) => column(`set ${n}`, n, false))], rows };
    },
  };

  /** The table as it stands: hidden methods left out, sorted. */
  function current() {
    const table = TABLES[state.values.rows](state.values);
    const hidden = state.hidden();
    table.rows = table.rows.filter(({ index }) => !hidden.has(index));
    const down = state.values.sort.startsWith("-");
    const by = table.columns.find(({ name }) => name === state.values.sort.slice(down ? 1 : 0));
    if (by) {
      const compare = by.numeric
        ? (a, b) => a - b
        : new Intl.Collator(undefined, { numeric: true }).compare;
      table.rows.sort((a, b) => {
        const [one, other] = [a[by.name], b[by.name]];
        // What has no value comes last either way.
        if (one == null || other == null) return (one == null) - (other == null);
        return (down ? -1 : 1) * compare(one, other);
      });
    }
    return { ...table, by, down };
  }

  let drawnFor = "";

  function draw(values) {
    const { rows: kind, metric, baseline, sort } = values;
    const now = JSON.stringify([kind, metric, baseline, sort, values.hide]);
    if (now === drawnFor) return;
    drawnFor = now;
    const { columns, rows, note, by, down } = current();
    for (const name of ["table-metric-label", "table-baseline-label"]) {
      byId(name).hidden = kind !== "methods";
    }
    byId("table-note").textContent = note ?? "";
    const focused = document.activeElement?.dataset?.column;
    const heads = columns.map(({ name, title, numeric }) => {
      const order = by?.name !== name ? "none" : down ? "descending" : "ascending";
      const mark = { none: "", ascending: " ▲", descending: " ▼" }[order];
      const sortBy = () => state.set({ sort: order === "ascending" ? `-${name}` : name });
      return element("th", { scope: "col", "aria-sort": order, class: numeric ? "number" : null },
        element("button", { "data-column": name, onclick: sortBy }, title,
          element("span", { "aria-hidden": "true" }, mark)));
    });
    const cell = (row, { name, numeric }) => {
      const value = row[name];
      if (name === "method") return element("td", {}, swatch(row.index), " ", value);
      if (!numeric) return element("td", {}, value ?? "");
      const whole = name === "spp" || name === "scenes";
      return element("td", { class: "number" }, whole ? String(value) : number(value));
    };
    byId("table").replaceChildren(
      element("thead", {}, element("tr", {}, ...heads)),
      element("tbody", {}, ...rows.map((row) =>
        element("tr", {}, ...columns.map((one) => cell(row, one))))),
    );
    // The headers are new ones: whoever sorts by keyboard stays where they are.
    if (focused) document.querySelector(`[data-column="${CSS.escape(focused)}"]`)?.focus();
  }

  /** The table as CSV (RFC 4180), numbers in full. */
  function csv() {
    const { columns, rows } = current();
    const quote = (value) => {
      const text = value === null || value === undefined ? "" : String(value);
      return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
    };
    const lines = [columns.map(({ title }) => title), ...rows.map((row) => columns.map(({ name }) => row[name]))];
    return lines.map((line) => `${line.map(quote).join(",")}\r\n`).join("");
  }

  function download() {
    const url = URL.createObjectURL(new Blob([csv()], { type: "text/csv;charset=utf-8" }));
    element("a", { href: url, download: `${state.values.rows}.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  }

  return { draw, download };
})();
