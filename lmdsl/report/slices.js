// The slice of the grid that is drawn: one or two axes, the others held at an index.
class Slice {
  constructor(said, cells, held, view) {
    Object.assign(this, { said, cells, held, view });
    this.flat = view.axes.length === 1;
    this.sizes = [said.drawn[view.axes[0]], this.flat ? 1 : said.drawn[view.axes[1]]];
    this.strides = said.drawn.map((_, k) => said.drawn.slice(k + 1).reduce((n, m) => n * m, 1));
  }

  edges(k) {
    const axis = this.cells.axes[k], step = this.said.step, found = [];
    for (let j = 0; j < this.said.drawn[k]; j++) found.push(axis.low + j * step * axis.width);
    return [...found, axis.high];
  }

  // The position of a cell, by its index, among the drawn ones.
  drawn(index) {
    return index.reduce((sum, n, k) => sum
      + Math.min(Math.floor(n / this.said.step), this.said.drawn[k] - 1) * this.strides[k], 0);
  }

  status(index) {
    return this.held.status[this.said.whole ? this.cells.flat(index) : this.drawn(index)];
  }

  // A value for each drawn cell, rows from below; `of` knows its position and that of its cell.
  map(of) {
    const { step } = this.said, [a, b] = this.view.axes, rows = [], held = [...this.view.at];
    const first = (k) => Math.min(step >> 1, this.cells.axes[k].cells - 1);
    held[a] = first(a);
    if (!this.flat) held[b] = first(b);
    const cell = this.cells.flat(held), place = this.drawn(held);
    for (let j = 0; j < this.sizes[1]; j++) {
      const row = new Array(this.sizes[0]);
      const up = this.flat ? [0, 0] : [j * this.strides[b], j * step * this.cells.strides[b]];
      for (let i = 0; i < row.length; i++) {
        row[i] = of(place + up[0] + i * this.strides[a],
          cell + up[1] + i * step * this.cells.strides[a]);
      }
      rows.push(row);
    }
    return rows;
  }

  // Visits every drawn cell: its place on the axes shown, its position, and that of its cell.
  each(of) {
    const { step, drawn } = this.said, [a, b] = this.view.axes, d = drawn.length;
    const first = this.cells.axes.map((axis) => Math.min(step >> 1, axis.cells - 1));
    const index = drawn.map(() => 0);
    let cell = this.cells.flat(first);
    for (let place = 0, n = this.strides[0] * drawn[0]; place < n; place++) {
      of(index[a], this.flat ? 0 : index[b], place, cell);
      for (let k = d - 1; k >= 0; k--) {
        cell += step * this.cells.strides[k];
        if (++index[k] < drawn[k]) break;
        cell -= index[k] * step * this.cells.strides[k];
        index[k] = 0;
      }
    }
  }

  // Values over the axes that are not shown, put together: the largest, or the mean.
  gathered(values) {
    const empty = () => Array.from({ length: this.sizes[1] }, () => Array(this.sizes[0]).fill(NaN));
    const rows = empty(), count = empty(), largest = this.view.gather === "largest";
    this.each((i, j, place) => {
      const v = values[place];
      if (!Number.isFinite(v)) return;
      const old = rows[j][i], none = Number.isNaN(old);
      rows[j][i] = none ? v : largest ? Math.max(old, v) : old + v;
      count[j][i] = none ? 1 : count[j][i] + 1;
    });
    return largest ? rows : rows.map((row, j) => row.map((v, i) => v / count[j][i]));
  }

  // Of statuses: where any cell is the attractor, or stabilized; else what most cells are.
  shadow(wanted) {
    const { status } = this.held, { whole } = this.said;
    const counts = Array.from({ length: this.sizes[1] }, () =>
      Array.from({ length: this.sizes[0] }, () => new Uint32Array(8)));
    this.each((i, j, place, cell) => { counts[j][i][status[whole ? cell : place]]++; });
    return counts.map((row) => row.map((n) => {
      if (n[wanted]) return wanted;
      return n.reduce((best, m, code) => (m > n[best] ? code : best), n.length - 1);
    }));
  }

  statuses(wanted) {
    const { status } = this.held;
    if (this.view.gather) return this.shadow(wanted);
    return this.said.whole ? this.map((_, cell) => status[cell]) : this.map((at) => status[at]);
  }

  values(values) {
    return this.view.gather ? this.gathered(values) : this.map((at) => values[at]);
  }

  x() { return this.edges(this.view.axes[0]); }
  y() { return this.flat ? [0, 1] : this.edges(this.view.axes[1]); }
}
