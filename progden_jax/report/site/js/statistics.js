"use strict";

/* Results by scene, samples and method, and their means over scenes. */
progden.results = (() => {
  const { data } = progden;
  const key = (scene, spp, method) => `${scene} ${spp} ${method}`;
  const rows = new Map(data.rows.map((row) => [key(row.scene, row.spp, row.method), row]));
  const spps = [...new Set(data.rows.map((row) => row.spp))].sort((a, b) => a - b);

  const row = (scene, spp, method) => rows.get(key(scene, spp, method));
  const value = (scene, spp, method, metric) => row(scene, spp, method)?.values[metric] ?? null;
  const sppsOf = (scene) =>
    spps.filter((spp) => data.methods.some((_, method) => row(scene, spp, method)));

  /** The reference's picture for a scene at this many samples, or null. */
  function reference(scene, spp) {
    for (let method = 0; method < data.methods.length; method++) {
      const found = row(scene, spp, method)?.pictures.reference;
      if (found) return found;
    }
    return null;
  }

  /**
   * The geometric mean over scenes, with the t interval of the mean logarithm; with a baseline, of
   * the ratio to that, scene by scene. Null where nothing positive is there; `low` and `high` are null
   * for one scene.
   */
  function mean(spp, method, metric, baseline = null) {
    const logs = [];
    for (let scene = 0; scene < data.scenes.length; scene++) {
      const top = value(scene, spp, method, metric);
      const bottom = baseline === null ? 1 : value(scene, spp, baseline, metric);
      if (top > 0 && bottom > 0) logs.push(Math.log(top / bottom));
    }
    if (!logs.length) return null;
    const count = logs.length;
    const middle = logs.reduce((sum, log) => sum + log, 0) / count;
    const found = { value: Math.exp(middle), low: null, high: null, count };
    if (count > 1) {
      const squares = logs.reduce((sum, log) => sum + (log - middle) ** 2, 0);
      const half = data.quantiles[count - 2] * Math.sqrt(squares / (count - 1) / count);
      found.low = Math.exp(middle - half);
      found.high = Math.exp(middle + half);
    }
    return found;
  }

  return { row, value, spps, sppsOf, reference, mean };
})();
