// What the reader does: layers, axes, slices, cells and runs.

const MOST_STEPS = 2000;

async function begin() {
  const data = JSON.parse(document.getElementById("data").textContent);
  const said = data.cells;
  const held = { status: await unpacked(said.status), index: await unpacked(said.index),
    vectors: await unpacked(said.vectors) };
  const layers = await Promise.all(said.layers.map((layer) => unpacked(layer.values)));
  let offsets = null, nodes = null;
  if (data.samples) {
    offsets = await unpacked(data.samples.offsets);
    nodes = await unpacked(data.samples.nodes);
  }
  if (data.rows) {
    const rows = {};
    for (const key of ["pointer", "target", "share", "cost"]) {
      rows[key] = await unpacked(data.rows[key]);
    }
    rows.position = new Int32Array(held.status.length).fill(-1);
    held.status.reduce((n, code, i) => (code === STABILIZED ? (rows.position[i] = n, n + 1) : n), 0);
    held.rows = rows;
  }
  new Page(data, held, layers, offsets, nodes).start();
}

class Page {
  constructor(data, held, layers, offsets, nodes) {
    Object.assign(this, { data, held, layers, offsets, nodes });
    this.said = data.cells;
    this.follower = new Follower(data, held);
    this.cells = this.follower.cells;
    this.layer = 0;
    this.runs = [];
    this.picked = null;
    this.over = new Overlay(document.getElementById("map"));
    this.seed = 1;
    this.smooth = data.map !== null && data.map.kind === "ode";
    const d = this.cells.axes.length;
    this.view = { axes: d === 1 ? [0] : [0, 1], at: this.middle(), gather: "" };
  }

  // The cell at the middle of the attractor, or of the box: slices pass through it.
  middle() {
    if (this.said.whole) {
      const found = [];
      this.held.status.forEach((code, i) => { if (code === ATTRACTOR) found.push(i); });
      const all = found.map((cell) => this.cells.index(cell));
      const mean = this.cells.axes.map((_, k) => all.reduce((s, i) => s + i[k], 0) / all.length);
      const away = (index) => index.reduce((s, i, k) => s + Math.abs(i - mean[k]), 0);
      if (all.length) return all.reduce((best, i) => (away(i) < away(best) ? i : best));
    }
    return this.cells.axes.map((axis) => axis.cells >> 1);
  }

  start() {
    this.build();
    drawLegend(this.said.regions);
    const asked = new URLSearchParams(location.hash.slice(1)).get("start");
    if (this.follower.able) {
      for (const x of this.data.starts || []) this.follow(x, false);
      const x = asked && asked.split(",").map(Number);
      if (x && x.length === this.cells.axes.length && x.every(Number.isFinite)) {
        this.runs = [];
        this.follow(x, false);
      }
    }
    this.draw().then(() => this.listen());
    drawLoop(this.data.loop, this.data.survival);
    const again = () => {
      this.draw();
      drawLegend(this.said.regions);
      drawLoop(this.data.loop, this.data.survival);
    };
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
    matchMedia("print").addEventListener("change", again);
    document.documentElement.dataset.ready = "yes";
  }

  slice() {
    return new Slice(this.said, this.cells, this.held, this.view);
  }

  async draw() {
    const layer = this.said.layers[this.layer], slice = this.slice();
    const key = JSON.stringify([this.layer, this.view, theme().paper]);
    if (key !== this.grounded) this.ground = groundTraces(slice, layer, this.layers[this.layer]);
    this.grounded = key;
    await drawMap(slice, layer, this.ground, this.runs, this.smooth);
    this.mark();
    const last = this.runs[this.runs.length - 1];
    document.getElementById("time").style.display = last ? "" : "none";
    if (last) await drawTime(last, this.follower.names, this.follower.controls, this.cells.axes);
  }

  mark(dot) {
    this.over.put([...pickedMarks(this.slice(), this.picked), ...(dot ? [dot] : [])],
      this.view.axes.length === 1);
  }

  // Controls -----------------------------------------------------------------------------------

  build() {
    const bar = document.getElementById("controls"), { axes } = this.cells;
    bar.replaceChildren();
    bar.append(this.choice("show", this.said.layers.map((layer) => layer.title), this.layer,
      (k) => { this.layer = k; this.draw(); }));
    if (axes.length > 2) {
      ["across", "up"].forEach((word, n) => {
        bar.append(this.choice(word, axes.map((axis) => axis.name), this.view.axes[n], (k) => {
          if (this.view.axes[1 - n] === k) this.view.axes[1 - n] = this.view.axes[n];
          this.view.axes[n] = k;
          this.build();
          this.draw();
        }));
      });
    }
    if (axes.length > 2) {
      bar.append(this.choice("others", ["slice", "largest", "mean"],
        ["", "largest", "mean"].indexOf(this.view.gather), (k) => {
          this.view.gather = ["", "largest", "mean"][k];
          this.draw();
        }));
    }
    axes.forEach((axis, k) => { if (!this.view.axes.includes(k)) bar.append(this.slider(axis, k)); });
    if (!this.follower.able) return;
    bar.append(this.button("random start", () => this.watch(this.somewhere())),
      this.button("play", () => this.play()),
      this.button("clear runs", () => { this.runs = []; this.say("run", ""); this.draw(); }));
  }

  choice(word, options, chosen, then) {
    const label = document.createElement("label"), select = document.createElement("select");
    options.forEach((text, k) => select.add(new Option(text, k, false, k === chosen)));
    select.addEventListener("change", () => then(Number(select.value)));
    label.append(word, select);
    return label;
  }

  slider(axis, k) {
    const label = document.createElement("label"), range = document.createElement("input");
    const output = document.createElement("output");
    const show = () => {
      const x = axis.low + (this.view.at[k] + 0.5) * axis.width;
      output.value = this.said.numbered ? String(this.view.at[k]) : short(Number(x.toPrecision(4)));
    };
    Object.assign(range, { type: "range", min: 0, max: axis.cells - 1, step: 1 });
    range.value = this.view.at[k];
    range.addEventListener("input", () => {
      this.view.at[k] = Number(range.value);
      show();
      this.draw();
    });
    show();
    label.append(axis.name, range, output);
    return label;
  }

  button(word, then) {
    const found = document.createElement("button");
    found.type = "button";
    found.textContent = word;
    found.addEventListener("click", then);
    return found;
  }

  // Cells and runs -----------------------------------------------------------------------------

  listen() {
    const map = document.getElementById("map");
    map.on("plotly_hover", (event) => this.point(this.at(event)));
    map.on("plotly_afterplot", () => this.mark());
    map.on("plotly_click", (event) => {
      const x = this.at(event);
      this.point(x);
      this.watch(x);
    });
    map.addEventListener("keydown", (event) => this.press(event));
  }

  // Arrows go from cell to cell, Enter starts a run in the middle of one.
  press(event) {
    const [a, b] = this.view.axes, turn = { ArrowLeft: [a, -1], ArrowRight: [a, 1],
      ArrowDown: [b, -1], ArrowUp: [b, 1] }[event.key];
    const index = this.picked ? [...this.picked.index] : [...this.view.at];
    if (event.key === "Enter") this.watch(this.cells.centre(this.cells.flat(index)));
    else if (turn && turn[0] !== undefined) {
      const [k, by] = turn, n = this.cells.axes[k].cells, step = by * this.said.step;
      index[k] = this.cells.axes[k].periodic ? (index[k] + step + n) % n
        : Math.min(Math.max(index[k] + step, 0), n - 1);
      this.point(this.cells.centre(this.cells.flat(index)));
    } else return;
    event.preventDefault();
  }

  // Follows a run from there, and moves a dot along it unless the reader wants no motion.
  watch(x) {
    if (!this.follower.able) return;
    this.follow(x, true);
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.play();
  }

  // The state under a pointer: where it is exactly, the other axes as they are held.
  at(event) {
    const map = document.getElementById("map"), [a, b] = this.view.axes;
    const x = this.cells.centre(this.cells.flat(this.view.at)), { event: raw } = event;
    const area = map.querySelector(".nsewdrag").getBoundingClientRect();
    const source = raw && raw.clientX !== undefined ? raw : null, point = event.points[0];
    const across = (axis, t) => axis.range[0] + t * (axis.range[1] - axis.range[0]);
    x[a] = source ? across(map.layout.xaxis, (source.clientX - area.left) / area.width) : point.x;
    if (b !== undefined) {
      x[b] = source ? across(map.layout.yaxis, (area.bottom - source.clientY) / area.height)
        : point.y;
    }
    return x;
  }

  point(x) {
    const cell = this.cells.cell(this.cells.state(x, true));
    if (cell < 0 || (this.picked && this.picked.cell === cell)) return;
    const index = this.cells.index(cell), slice = this.slice();
    const status = slice.status(index), control = this.said.whole ? this.follower.control(cell) : null;
    let samples = [];
    if (this.said.whole && status === STABILIZED && (this.data.rows || this.offsets)) {
      samples = this.follower.samples(cell, this.offsets, this.nodes);
    }
    this.picked = { cell, index, samples };
    this.tell(index, status, control, samples, slice.drawn(index));
    this.mark();
  }

  tell(index, status, control, samples, drawn) {
    const region = this.said.regions.find(({ code }) => code === status), rows = [];
    rows.push(["cell", `[${index.join(", ")}]`]);
    this.cells.axes.forEach((axis, k) => {
      const low = axis.low + index[k] * axis.width;
      rows.push([axis.name, this.said.numbered ? String(index[k])
        : `${short(low)} to ${short(low + axis.width)}`]);
    });
    rows.push(["is", status === STABILIZED ? "stabilized" : region ? region.name : "not known"]);
    if (control) this.follower.controls.forEach((name, k) => rows.push([name, short(control[k])]));
    if (status === STABILIZED) {
      this.said.layers.forEach((layer, k) => {
        if (!layer.level) rows.push([layer.title, short(this.layers[k][drawn])]);
      });
    }
    if (samples.length) rows.push(...this.destinations(samples));
    this.list("cell", rows);
  }

  // Where samples go: the cells that take most, and what becomes of the rest.
  destinations(samples) {
    const share = new Map();
    for (const { cell, share: s } of samples) share.set(cell, (share.get(cell) || 0) + s);
    const sorted = [...share].sort((a, b) => b[1] - a[1]), rows = [];
    const word = (cell) => {
      if (cell < 0) return this.data.map ? "outside the box" : "the end";
      if (this.held.status[cell] === ATTRACTOR) return "A";
      return `[${this.cells.index(cell).join(", ")}]`;
    };
    const sums = new Map();
    for (const [cell, s] of sorted) sums.set(word(cell), (sums.get(word(cell)) || 0) + s);
    const most = [...sums].sort((a, b) => b[1] - a[1]);
    for (const [name, s] of most.slice(0, 6)) rows.push(["goes to", `${name}: ${short(100 * s)} %`]);
    if (most.length > 6) rows.push(["and to", `${most.length - 6} more cells`]);
    return rows;
  }

  list(id, rows) {
    const list = document.createElement("dl");
    for (const [name, value] of rows) {
      const term = document.createElement("dt"), said = document.createElement("dd");
      term.textContent = name;
      said.textContent = value;
      list.append(term, said);
    }
    document.getElementById(id).replaceChildren(list);
  }

  say(id, words) {
    document.getElementById(id).textContent = words;
  }

  // A start in a random stabilized cell.
  somewhere() {
    const random = dice(this.seed++ * 7919), count = this.held.status.length;
    for (let n = 0; n < 10000; n++) {
      const cell = Math.floor(random() * count);
      if (this.held.status[cell] !== STABILIZED) continue;
      return this.cells.place(this.cells.index(cell), this.cells.axes.map(() => random()));
    }
    return this.cells.centre(0);
  }

  follow(x, draw) {
    const run = this.follower.run(x, MOST_STEPS, this.seed++);
    this.runs = [...this.runs.slice(-11), run];
    const cost = run.outcome === "reached A" ? `; cost ${short(run.cost)}` : "";
    const n = run.controls.length;
    const became = run.outcome === null ? "still going" : run.outcome;
    this.list("run", [["run from", x.map((v) => short(Number(v.toPrecision(4)))).join(", ")],
      ["it", `${became} after ${n} step${n === 1 ? "" : "s"}${cost}`]]);
    if (draw) this.draw();
  }

  // Moves a dot along the last run.
  play() {
    const run = this.runs[this.runs.length - 1], [a, b] = this.view.axes;
    clearInterval(this.playing);
    if (!run) return;
    const total = run.times.at(-1);
    const frames = this.smooth ? Math.ceil(Math.min(12 * total, 400)) : total;
    const pause = Math.max(16, Math.min(250, 6000 / (frames + 1)));
    let n = 0, i = 0;
    this.playing = setInterval(() => {
      while (i + 1 < run.times.length && run.times[i + 1] * frames <= total * n + 1e-9) i++;
      const x = n++ <= frames ? run.drawn[i] : null;
      if (!x) clearInterval(this.playing);
      this.mark(x && ["dot", x[a], b === undefined ? 0.5 : x[b], 7]);
    }, pause);
  }
}

begin();
