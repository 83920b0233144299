// Draws what is known of the cells, by plotly.js.

const DASHES = ["solid", "dash", "dot", "dashdot", "longdash", "longdashdot"];
// Palettes that are lighter the larger a value is, so that they are read without colour too.
const PALETTES = { value: "Viridis", lower: "Viridis", above: "Viridis", below: "Viridis" };
const SIDE = 36;  // marks of a hatch along an axis, at most

function theme() {
  const style = getComputedStyle(document.documentElement);
  const of = (name) => style.getPropertyValue(name).trim();
  return { ink: of("--ink"), faint: of("--faint"), paper: of("--paper"), panel: of("--panel"),
    line: of("--line"), link: of("--link"), lines: [of("--ink"), of("--link"), of("--bad"),
      of("--good"), of("--warn"), of("--faint")] };
}

function layout(more) {
  const t = theme();
  const axis = { color: t.ink, gridcolor: t.line, zerolinecolor: t.line, linecolor: t.faint,
    ticks: "outside", tickcolor: t.faint, automargin: true };
  const found = { paper_bgcolor: t.paper, plot_bgcolor: t.paper, font: { color: t.ink, size: 13 },
    margin: { l: 55, r: 12, t: 34, b: 45 }, hovermode: "closest", showlegend: false,
    dragmode: matchMedia("(pointer: fine)").matches ? "zoom" : false, ...more };
  for (const key of Object.keys(found)) {
    if (/^[xy]axis\d*$/.test(key)) found[key] = { ...axis, ...found[key] };
  }
  return found;
}

// No button that sends anything anywhere.
const CONFIG = { responsive: true, displaylogo: false,
  displayModeBar: matchMedia("(pointer: fine)").matches ? "hover" : false,
  modeBarButtons: [["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]] };

function headed(text) {
  return { text, x: 0, xref: "paper", xanchor: "left", font: { size: 15 } };
}

function plot(id, traces, shape) {
  const place = document.getElementById(id);
  return place ? Plotly.react(place, traces, layout(shape), CONFIG) : null;
}

function short(x) {
  if (x === null || x === undefined || Number.isNaN(x)) return "none";
  if (!Number.isFinite(x)) return x > 0 ? "∞" : "−∞";
  return String(Number(x.toPrecision(6))).replace("-", "\u2212");
}

function grey(light) {
  const dark = matchMedia("(prefers-color-scheme: dark)").matches
    && !matchMedia("print").matches;
  const level = Math.round(255 * (dark ? 0.12 + 0.55 * (1 - light) : light));
  return `rgb(${level},${level},${level})`;
}

function regionTraces(slice) {
  const codes = [1, ...slice.said.regions.map((region) => region.code)];
  const t = theme(), n = codes.length;
  const colours = [t.panel, ...slice.said.regions.map((region) => grey(region.light))];
  const scale = colours.flatMap((colour, k) => [[k / n, colour], [(k + 1) / n, colour]]);
  const place = new Map(codes.map((code, k) => [code, k]));
  const z = slice.statuses(STABILIZED).map((row) => row.map((code) => place.get(code) || 0));
  const y = slice.flat ? "y2" : "y";
  const traces = [{ type: "heatmap", x: slice.x(), y: slice.y(), z, yaxis: y, zmin: -0.5,
    zmax: n - 0.5, colorscale: scale, showscale: false, hoverinfo: "none" }];
  for (const region of slice.said.regions.filter(({ mark }) => mark)) {
    const marks = hatch(slice, codes.indexOf(region.code), z);
    const ink = region.light < 0.5 ? t.paper : t.faint;
    traces.push({ type: "scatter", mode: "markers", x: marks.map((p) => p[0]), yaxis: y,
      y: marks.map((p) => p[1]), hoverinfo: "skip", marker: { symbol: region.mark, color: ink, size: region.mark === "circle" ? 2.5 : 6,
        line: { width: 1, color: ink } } });
  }
  return traces;
}

function hatch(slice, wanted, z) {
  const x = slice.x(), y = slice.y(), found = [], wide = z[0].length, high = z.length;
  const across = Math.min(SIDE, wide), up = slice.flat ? 12 : Math.min(SIDE, high);
  for (let a = 0; a < across; a++) {
    for (let b = 0; b < up; b++) {
      const i = Math.floor(((a + 0.5) / across) * wide);
      const j = slice.flat ? 0 : Math.floor(((b + 0.5) / up) * high);
      if (z[j][i] !== wanted) continue;
      const v = slice.flat ? (b + 0.5) / up : (y[j] + y[j + 1]) / 2;
      found.push([(x[i] + x[i + 1]) / 2, v]);
    }
  }
  return found;
}

function outlineTraces(slice) {
  const x = slice.x(), y = slice.y(), lines = [[], []], t = theme();
  const inside = slice.statuses(ATTRACTOR);
  const at = (i, j) => !!inside[j] && inside[j][i] === ATTRACTOR;
  const push = (a, b, c, d) => { lines[0].push(a, c, null); lines[1].push(b, d, null); };
  for (let j = 0; j <= inside.length; j++) {
    for (let i = 0; i <= inside[0].length; i++) {
      if (j < inside.length && at(i, j) !== at(i - 1, j)) push(x[i], y[j], x[i], y[j + 1]);
      if (i < inside[0].length && at(i, j) !== at(i, j - 1)) push(x[i], y[j], x[i + 1], y[j]);
    }
  }
  const same = { type: "scatter", mode: "lines", x: lines[0], y: lines[1], hoverinfo: "skip",
    yaxis: slice.flat ? "y2" : "y" };
  return [{ ...same, line: { color: t.paper, width: 4.5 } },
    { ...same, line: { color: t.ink, width: 2 } }];
}

function valueTraces(slice, layer, values) {
  const t = theme();
  const raw = slice.values(values);
  if (slice.flat) {
    const x = slice.x(), centres = x.slice(1).map((b, i) => (b + x[i]) / 2);
    return [{ type: "scatter", mode: "lines", x: centres, y: raw[0], hoverinfo: "skip",
      line: { shape: "hvh", color: t.ink, width: 2 } }];
  }
  const known = values.filter((v) => Number.isFinite(v) && (!layer.log || v > 0));
  let low = Infinity, high = -Infinity;
  for (const v of known) { low = Math.min(low, v); high = Math.max(high, v); }
  if (!known.length) return [];
  const bar = { thickness: 14, outlinewidth: 0, tickcolor: t.ink, len: 1,
    title: { text: layer.log ? "log scale" : "", side: "right" } };
  let z = raw, ends = [low, high];
  if (layer.share) ends = [0, 1];
  if (layer.log) {
    low = Math.max(low, high * 1e-8);
    z = raw.map((row) => row.map((v) => (Number.isFinite(v) ? Math.log10(Math.max(v, low)) : v)));
    ends = [Math.log10(low), Math.log10(high)];
    bar.tickvals = [];
    for (let e = Math.ceil(ends[0]); e <= ends[1]; e++) bar.tickvals.push(e);
    if (bar.tickvals.length < 2) bar.tickvals = [ends[0], (ends[0] + ends[1]) / 2, ends[1]];
    bar.ticktext = bar.tickvals.map((e) => short(Number((10 ** e).toPrecision(3))));
  }
  return [{ type: "heatmap", x: slice.x(), y: slice.y(), z, hoverinfo: "none", zmin: ends[0],
    zmax: ends[1] > ends[0] ? ends[1] : ends[0] + 1, colorbar: bar,
    colorscale: PALETTES[layer.key] || "Cividis" }];
}

function runTraces(slice, runs, smooth) {
  if (slice.flat) return [];
  const t = theme(), found = [];
  for (const run of runs) {
    const { axes } = slice.view, of = (x) => axes.map((k) => x[k]);
    const [x, y] = lineOf(run.drawn.map(of), axes.map((k) => slice.cells.axes[k]));
    const good = run.outcome === "reached A";
    const same = { type: "scatter", x, y, hoverinfo: "skip" };
    found.push({ ...same, mode: "lines", line: { color: t.paper, width: smooth ? 4.5 : 3 } });
    found.push({ ...same, mode: "lines", line: { color: t.ink, width: smooth ? 2 : 0.9,
      dash: good || !run.outcome ? "solid" : "dot" } });
    if (!smooth) {
      const at = run.states.map(of);
      found.push({ ...same, x: at.map((s) => s[0]), y: at.map((s) => s[1]), mode: "markers",
        marker: { size: 5, color: t.ink, line: { color: t.paper, width: 1 } } });
    }
    const ends = [run.states[0], run.states[run.states.length - 1]];
    found.push({ type: "scatter", mode: "markers", hoverinfo: "skip",
      x: ends.map((s) => s[slice.view.axes[0]]), y: ends.map((s) => s[slice.view.axes[1]]),
      marker: { size: [11, 7], symbol: ["circle-open", good ? "circle" : run.outcome
        ? "x" : "circle-open-dot"], color: t.ink, line: { width: 2, color: t.ink } } });
  }
  return found;
}

// What does not change while cells are pointed at and runs are added.
function groundTraces(slice, layer, values) {
  return [...regionTraces(slice), ...valueTraces(slice, layer, values), ...outlineTraces(slice)];
}

function drawMap(slice, layer, ground, runs, smooth) {
  const [a, b] = slice.view.axes, axes = slice.cells.axes;
  const how = slice.view.gather ? `, ${slice.view.gather} over the other axes` : "";
  const shape = { title: headed(layer.title + how),
    xaxis: { title: { text: axes[a].name }, range: [axes[a].low, axes[a].high], showgrid: false,
      zeroline: false }, uirevision: slice.view.axes.join() };
  if (slice.flat) {
    shape.yaxis = { title: { text: layer.title }, overlaying: "y2", tickmode: "auto",
      type: layer.log ? "log" : "linear", rangemode: "tozero" };
    shape.yaxis2 = { range: [0, 1], visible: false, fixedrange: true };
  } else {
    shape.yaxis = { title: { text: axes[b].name }, range: [axes[b].low, axes[b].high],
      showgrid: false, zeroline: false };
  }
  return plot("map", [...ground, ...runTraces(slice, runs, smooth)], shape);
}

// Marks over the map that come and go quickly: a cell, where its samples go, a moving dot.
class Overlay {
  constructor(map) {
    this.map = map;
    this.svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    this.svg.setAttribute("class", "over");
    this.svg.setAttribute("aria-hidden", "true");
  }

  // Puts the marks anew: `marks` are [kind, x, y, size] in the units of the axes.
  put(marks, flat) {
    const area = this.map.querySelector(".nsewdrag"), { xaxis, yaxis } = this.map.layout;
    if (!area) return;
    const box = area.getBoundingClientRect(), own = this.map.getBoundingClientRect();
    if (this.svg.parentNode !== this.map) this.map.append(this.svg);
    Object.assign(this.svg.style, { left: `${box.left - own.left}px`,
      top: `${box.top - own.top}px`, width: `${box.width}px`, height: `${box.height}px` });
    const across = (x) => (x - xaxis.range[0]) / (xaxis.range[1] - xaxis.range[0]) * box.width;
    const ends = flat ? [0, 1] : yaxis.range;
    const up = (y) => (1 - (y - ends[0]) / (ends[1] - ends[0])) * box.height;
    const shapes = { diamond: "M0-1L1 0L0 1L-1 0Z" };
    this.svg.replaceChildren(...marks.map(([kind, x, y, size]) => {
      const of = (tag) => document.createElementNS("http://www.w3.org/2000/svg", tag);
      const mark = of(kind === "diamond" ? "path" : kind === "dot" ? "circle" : "rect");
      mark.setAttribute("class", kind);
      if (kind.startsWith("cell")) {
        const [left, right, low, high] = [across(x[0]), across(x[1]), up(y[0]), up(y[1])];
        Object.entries({ x: left, y: high, width: Math.max(right - left, 2),
          height: Math.max(low - high, 2) }).forEach(([k, v]) => mark.setAttribute(k, v));
      } else if (kind === "dot") {
        Object.entries({ cx: across(x), cy: up(y), r: size })
          .forEach(([k, v]) => mark.setAttribute(k, v));
      } else {
        mark.setAttribute("d", shapes[kind]);
        mark.setAttribute("transform", `translate(${across(x)} ${up(y)}) scale(${size})`);
      }
      return mark;
    }));
  }
}

function pickedMarks(slice, picked) {
  if (!picked) return [];
  const [a, b] = slice.view.axes, box = slice.cells.axes, i = picked.index;
  const side = (k) => [box[k].low + i[k] * box[k].width, box[k].low + (i[k] + 1) * box[k].width];
  const up = slice.flat ? [0, 1] : side(b);
  return [["cell casing", side(a), up], ["cell", side(a), up],
    ...picked.samples.filter((s) => s.x && s.x.every(Number.isFinite)).map((s) =>
      ["diamond", s.x[a], slice.flat ? 0.5 : s.x[b], 4 + 5 * Math.sqrt(s.share)])];
}

// What the hatches and outlines mean.
function drawLegend(regions) {
  const list = document.getElementById("legend"), marks = {
    "line-ne-open": "M3 13L13 3", "line-nw-open": "M3 3L13 13", circle: "M7 8h2M8 7v2",
    "x-thin-open": "M3 3L13 13M3 13L13 3", "line-ew-open": "M3 8h10" };
  list.replaceChildren();
  for (const region of regions) {
    const item = document.createElement("li"), name = "http://www.w3.org/2000/svg";
    const svg = document.createElementNS(name, "svg"), box = document.createElementNS(name, "rect");
    const mark = document.createElementNS(name, "path"), t = theme();
    Object.entries({ width: 16, height: 16, "aria-hidden": "true" })
      .forEach(([key, value]) => svg.setAttribute(key, value));
    Object.entries({ x: 1, y: 1, width: 14, height: 14, fill: grey(region.light),
      stroke: region.code === ATTRACTOR ? t.ink : t.faint,
      "stroke-width": region.code === ATTRACTOR ? 2 : 1 })
      .forEach(([key, value]) => box.setAttribute(key, value));
    mark.setAttribute("d", marks[region.mark] || "");
    mark.setAttribute("stroke", t.faint);
    svg.append(box, mark);
    item.append(svg, `${region.name} (${region.cells.toLocaleString("en")} cells)`);
    list.append(item);
  }
}
