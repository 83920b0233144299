"use strict";
// Follows the map that a page holds, under the table of controls: no pictures here, no document.

const EDGE = 1e-9, MOST_TURNS = 2 ** 20, MOST_PARTS = 1000;
const FLAT = 0.001, MOST_DRAWN = 32;  // of an axis: how far lines may be from an arc; its lines
const PATIENCE = 600;  // milliseconds for a run, or for the samples of a cell
const ATTRACTOR = 0, STABILIZED = 1, AVOID = 5;

const OPERATIONS = {
  "+": (a, b) => a + b, "-": (a, b) => a - b, "*": (a, b) => a * b, "/": (a, b) => a / b,
  "**": (a, b) => (b === 2 ? a * a : Math.pow(a, b)), negative: (a) => -a,
  where: (c, a, b) => (c ? a : b), sin: Math.sin, cos: Math.cos, tan: Math.tan, asin: Math.asin,
  acos: Math.acos, atan: Math.atan, sinh: Math.sinh, cosh: Math.cosh, tanh: Math.tanh,
  exp: Math.exp, log: Math.log, sqrt: Math.sqrt, abs: Math.abs, sign: Math.sign,
  floor: Math.floor, ceil: Math.ceil, atan2: Math.atan2, min: (a, b) => Math.min(a, b),
  max: (a, b) => Math.max(a, b),
  mod: (a, b) => { const r = a % b; return r !== 0 && r < 0 !== b < 0 ? r + b : r; },
  "<": (a, b) => +(a < b), "<=": (a, b) => +(a <= b), ">": (a, b) => +(a > b),
  ">=": (a, b) => +(a >= b), "==": (a, b) => +(a === b), "!=": (a, b) => +(a !== b),
  and: (a, b) => +(a && b ? 1 : 0), or: (a, b) => +(a || b ? 1 : 0), not: (a) => +!a,
};

async function unpacked(held) {
  const bytes = Uint8Array.from(atob(held.data), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const kinds = { u1: Uint8Array, u2: Uint16Array, i4: Int32Array, f4: Float32Array,
    f8: Float64Array };
  return new kinds[held.kind](buffer);
}

// The point at t of the cubic Hermite arc from a to b, whose slopes there are m and n.
function hermite(a, b, m, n, t) {
  const r = 1 - t;
  return a.map((v, k) => {
    const rise = b[k] - v;
    return r * v + t * b[k] + t * r * (r * (m[k] - rise) - t * (n[k] - rise));
  });
}

// A source of random numbers that a seed repeats (mulberry32).
function dice(seed) {
  let a = seed >>> 0;
  return () => {
    a = (a + 0x6d2b79f5) >>> 0;
    let t = Math.imul(a ^ (a >>> 15), 1 | a);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

function compiled(program) {
  const slots = program.slots.map((value) => (value === null ? NaN : Number(value)));
  const inputs = Object.entries(program.inputs);
  const code = program.code.map(([name, operands, target]) =>
    [OPERATIONS[name], operands, target]);
  return (values) => {
    for (const [name, slot] of inputs) slots[slot] = values[name];
    for (const [f, o, target] of code) {
      slots[target] = o.length === 1 ? f(slots[o[0]])
        : o.length === 2 ? f(slots[o[0]], slots[o[1]]) : f(slots[o[0]], slots[o[1]], slots[o[2]]);
    }
    return program.outputs.map((slot) => slots[slot]);
  };
}

class Cells {
  constructor(said) {
    this.axes = said.axes;
    this.clip = said.clip;
    this.strides = said.axes.map((_, k) =>
      said.axes.slice(k + 1).reduce((n, axis) => n * axis.cells, 1));
    this.count = said.axes.reduce((n, axis) => n * axis.cells, 1);
  }

  // The state that an image becomes: wrapped, and with `clip` moved into the box.
  state(image, clip) {
    return image.map((x, k) => {
      const { low, high, periodic } = this.axes[k];
      if (!periodic) {
        return clip && Number.isFinite(x) ? Math.min(Math.max(x, low), high) : x;
      }
      if (x >= low && x <= high) return x;
      const span = high - low, turns = Math.floor((x - low) / span);
      if (!(Math.abs(turns) <= MOST_TURNS)) return NaN;
      return Math.min(low + Math.min(Math.max(x - low - turns * span, 0), span), high);
    });
  }

  // The cell of a state, -1 outside.
  cell(x) {
    let found = 0;
    for (let k = 0; k < x.length; k++) {
      const { low, high, width, cells, periodic } = this.axes[k];
      if (!Number.isFinite(x[k])) return -1;
      const t = (x[k] - low) / width;
      let i = Math.floor(t + EDGE);
      if (periodic) {
        if (i >= cells) i = 0;
      } else if (i >= cells && (t - cells <= EDGE || x[k] <= high)) {
        i = cells - 1;
      }
      if (i < 0 || i >= cells) return -1;
      found += i * this.strides[k];
    }
    return found;
  }

  index(cell) {
    return this.axes.map((axis, k) => Math.floor(cell / this.strides[k]) % axis.cells);
  }

  flat(index) {
    return index.reduce((sum, i, k) => sum + i * this.strides[k], 0);
  }

  place(index, offset) {
    return this.axes.map((axis, k) =>
      offset[k] === 1 && index[k] === axis.cells - 1 ? axis.high
        : axis.low + (index[k] + offset[k]) * axis.width);
  }

  centre(cell) {
    return this.place(this.index(cell), this.axes.map(() => 0.5));
  }
}

class Follower {
  // `arrays`: status, index (0: none, else one more than the index of the vector), vectors.
  constructor(data, arrays) {
    this.cells = new Cells(data.cells);
    this.names = data.cells.axes.map((axis) => axis.name);
    this.controls = data.cells.controls;
    this.arrays = arrays;
    this.map = data.map;
    this.able = data.cells.whole && data.starts !== null
      && (data.map !== null || data.rows !== null);
    if (data.map !== null) {
      this.program = compiled(data.map.program);
      this.stage = data.map.stage && compiled(data.map.stage);
      this.terminal = data.map.terminal && compiled(data.map.terminal);
    }
  }

  control(cell) {
    const p = this.controls.length, i = cell < 0 ? -1 : this.arrays.index[cell] - 1;
    return i < 0 ? null : Array.from(this.arrays.vectors.subarray(i * p, i * p + p));
  }

  named(x, u, w) {
    const values = Object.create(null);  // a state may be called __proto__
    this.names.forEach((name, k) => { values[name] = x[k]; });
    this.controls.forEach((name, k) => { values[name] = u[k]; });
    this.map.noise.forEach(({ name }, k) => { values[name] = w[k]; });
    return values;
  }

  draw(random) {
    return this.map.noise.map((noise) => {
      if (noise.normal !== undefined) {
        const r = Math.sqrt(-2 * Math.log(1 - random()));
        return noise.normal * r * Math.cos(2 * Math.PI * random());
      }
      if (noise.uniform) {
        return noise.uniform[0] + (noise.uniform[1] - noise.uniform[0]) * random();
      }
      let left = random() * noise.weights.reduce((a, b) => a + b, 0);
      const k = noise.weights.findIndex((weight) => (left -= weight) < 0);
      return noise.values[k < 0 ? noise.values.length - 1 : k];
    });
  }

  // One step: { x, cell, cost, way, when }, the states drawn until then, and at what part of it.
  step(x, u, w, drawn = false) {
    const values = this.named(x, u, w);
    const cost = this.stage ? this.stage(values)[0] : 0;
    if (this.map.kind === "map") {
      const state = this.cells.state(this.program(values), this.cells.clip);
      return { x: state, cell: this.cells.cell(state), cost, way: [state], when: [1] };
    }
    const moved = this.integrated(x, values, drawn);
    if (this.map.integrals) moved.cost = moved.integral;
    else moved.cost = cost;
    return moved;
  }

  // A sampling time of an equation: classical Runge-Kutta steps, and the first event on their way.
  integrated(x, values, drawn) {
    const { h, substeps, integrals, path, absorb } = this.map, d = x.length;
    const held = Object.assign(Object.create(null), values);
    const slope = (at) => {
      this.names.forEach((name, k) => { held[name] = at[k]; });
      return this.program(held);
    };
    const along = (at, by, k) => at.map((v, j) => v + by * k[j]);
    let at = [...x, ...new Array(integrals).fill(0)], k1 = slope(at);
    const states = [at], slopes = [k1.map((v) => h * v)];
    for (let n = 0; n < substeps; n++) {
      const k2 = slope(along(at, h / 2, k1)), k3 = slope(along(at, h / 2, k2));
      const k4 = slope(along(at, h, k3));
      at = at.map((v, j) => v + (h / 6) * (k1[j] + 2 * k2[j] + 2 * k3[j] + k4[j]));
      k1 = slope(at);
      states.push(at);
      slopes.push(k1.map((v) => h * v));
    }
    const met = path ? this.met(states, slopes, absorb) : null;
    const end = met ? met.x : this.cells.state(at.slice(0, d), this.cells.clip);
    const before = drawn ? this.arcs(states, slopes, met) : { way: [], when: [] };
    const when = [...before.when, met ? (met.arc + met.t) / substeps : 1];
    return { x: end, cell: met ? met.cell : this.cells.cell(end), way: [...before.way, end], when,
      integral: (met ? met.full : at)[d] };
  }

  // What is drawn of a step before its end: points on its arcs, the more the more they bend.
  arcs(states, slopes, met) {
    const { axes, clip } = this.cells, count = states.length - 1, way = [], when = [];
    for (let arc = 0; arc < count && (!met || arc <= met.arc); arc++) {
      const of = [states[arc], states[arc + 1], slopes[arc], slopes[arc + 1]];
      const bends = axes.map(({ low, high }, k) => {
        const rise = of[1][k] - of[0][k];
        return Math.max(Math.abs(of[2][k] - rise), Math.abs(of[3][k] - rise)) / (high - low);
      });
      const until = met && arc === met.arc ? met.t : 1;
      const lines = until * Math.sqrt((0.75 * Math.max(...bends)) / FLAT);
      const n = Math.max(1, Math.min(MOST_DRAWN, Math.ceil(lines) || 1));
      for (let j = 1; j <= n; j++) {
        const t = (until * j) / n, full = t === 1 ? of[1] : hermite(...of, t);
        way.push(this.cells.state(full.slice(0, axes.length), clip));
        when.push((arc + t) / count);
      }
    }
    return { way: way.slice(0, -1), when: when.slice(0, -1) };
  }

  // The first event on the cubic Hermite arcs between knots, looked for at equal parts; or null.
  met(states, slopes, absorb) {
    const d = this.names.length;
    let fast = 0;
    for (const slope of slopes) {
      for (let k = 0; k < d; k++) {
        fast = Math.max(fast, Math.abs(slope[k]) / this.cells.axes[k].width);
      }
    }
    const parts = Math.max(1, Math.min(MOST_PARTS, Math.ceil(2 * fast) || 1));
    for (let arc = 0; arc + 1 < states.length; arc++) {
      const [a, b, m, n] = [states[arc], states[arc + 1], slopes[arc], slopes[arc + 1]];
      for (let j = 1; j <= parts; j++) {
        const t = j / parts;
        if (j === parts && arc + 2 === states.length) return null;  // the image itself
        const full = j === parts ? b : hermite(a, b, m, n, t);
        const x = this.cells.state(full.slice(0, d), false), cell = this.cells.cell(x);
        if (cell < 0 && !this.cells.clip) return { x, cell, full, arc, t };
        const status = cell < 0 ? STABILIZED : this.arrays.status[cell];
        if (status === AVOID || (status === ATTRACTOR && absorb)) return { x, cell, full, arc, t };
      }
    }
    return null;
  }

  // By the rows of the finite model: the next cell, -1 where the run ends.
  drawn(cell, random) {
    const { pointer, target, share, position } = this.arrays.rows, row = position[cell];
    let left = random(), e = pointer[row];
    while (e < pointer[row + 1] - 1 && (left -= share[e]) >= 0) e++;
    return target[e];
  }

  ending(cell) {
    if (cell < 0) return this.map ? "left the box" : "ended";
    const status = this.arrays.status[cell];
    if (status === ATTRACTOR) return "reached A";
    if (status === AVOID) return "entered what is to be avoided";
    return status === STABILIZED ? null : "entered a cell without a control law";
  }

  // A closed-loop run: states by step, all that is drawn and when, controls, cost, and its outcome.
  run(start, steps, seed) {
    const random = dice(seed), weight = this.map
      ? this.map.gamma * (this.map.discount || 1) : 1;
    let x = this.cells.state(start, this.cells.clip), cell = this.cells.cell(x);
    const run = { states: [x], drawn: [x], times: [0], controls: [], cost: 0,
      outcome: this.ending(cell) };
    const until = Date.now() + PATIENCE;
    let power = 1;
    while (run.outcome === null && run.controls.length < steps && Date.now() < until) {
      const u = this.control(cell);
      if (u === null) { run.outcome = "entered a cell without a control law"; break; }
      const n = run.controls.push(u);
      if (this.map) {
        const moved = this.step(x, u, this.draw(random), true);
        ({ x, cell } = moved);
        run.cost += power * moved.cost;
        run.drawn.push(...moved.way);
        run.times.push(...moved.when.map((part) => n - 1 + part));
      } else {
        run.cost += this.arrays.rows.cost[this.arrays.rows.position[cell]];
        cell = this.drawn(cell, random);
        if (cell >= 0) x = this.cells.centre(cell);
        run.drawn.push(x);
        run.times.push(n);
      }
      power *= weight;
      run.states.push(x);
      run.outcome = this.ending(cell);
    }
    if (run.outcome === "reached A" && run.controls.length && this.terminal) {
      run.cost += power * this.terminal(this.named(x, [], this.map.noise.map(() => 0)))[0];
    }
    return run;
  }

  // Where the samples of a cell go, those that there is time for: [{ x, cell, share }].
  samples(cell, offsets, nodes) {
    const u = this.control(cell), found = [];
    if (u === null) return found;
    if (!this.map) {
      const { pointer, target, share, position } = this.arrays.rows, row = position[cell];
      for (let e = pointer[row]; e < pointer[row + 1]; e++) {
        const to = target[e];
        found.push({ x: to < 0 ? null : this.cells.centre(to), cell: to, share: share[e] });
      }
      return found;
    }
    const d = this.names.length, q = this.map.noise.length, index = this.cells.index(cell);
    const many = q ? nodes.length / q : 1, count = offsets.length / d;
    const until = Date.now() + PATIENCE;
    for (let i = 0; i < count && Date.now() < until; i++) {
      const x = this.cells.place(index, offsets.subarray(i * d, i * d + d));
      for (let j = 0; j < many; j++) {
        const moved = this.step(x, u, Array.from(nodes.subarray(j * q, j * q + q)));
        found.push({ x: moved.x, cell: moved.cell });
      }
    }
    for (const sample of found) sample.share = 1 / found.length;
    return found;
  }
}

if (typeof module !== "undefined") module.exports = { Cells, Follower, compiled, unpacked, dice };
