// Charts, drawn on a canvas that remembers.

import assert from "node:assert/strict";
import { test } from "node:test";

import { drawChart } from "../../src/echospline/page/static/chart.js";

/** What a chart draws. @param {any} lines */
function drawn(lines) {
  /** @type {{ dots: number, words: [string, number][] }} */
  const seen = { dots: 0, words: [] };
  const context = new Proxy(/** @type {any} */ ({}), {
    get: (kept, name) => (name in kept ? kept[name] : (/** @type {any[]} */ ...given) => {
      if (name === "arc") ++seen.dots;
      if (name === "fillText") seen.words.push([given[0], given[1]]);
      return name === "measureText" ? { width: 6 * String(given[0]).length } : undefined;
    }),
  });
  Object.assign(globalThis, { devicePixelRatio: 1 });
  drawChart(/** @type {any} */ ({ clientWidth: 400, clientHeight: 200, getContext: () => context }), { lines, xLabel: "attempt", yLabel: "", counted: true }, "dark");
  return seen;
}

test("who made one attempt is seen in the chart of a class", () => {
  assert.equal(drawn([{ label: "", colour: "#fff", x: [1], y: [0] }, { label: "median", colour: "#fff", x: [1, 2], y: [0, 1] }]).dots, 1);
});

test("lines without a name take no room of the legend, however many they are", () => {
  const nameless = Array.from({ length: 40 }, () => ({ label: "", colour: "#fff", x: [1, 2], y: [0, 1] })), named = { label: "median", colour: "#fff", x: [1, 2], y: [0, 1] };
  const place = (/** @type {any} */ lines) => drawn(lines).words.find(([text]) => text === "median")?.[1];
  assert.equal(place([...nameless, named]), place([named]));
});
