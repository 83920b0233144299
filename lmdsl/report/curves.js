// Curves: a run over its steps, the spectrum of the closed loop, how fast mass enters A.

// Lines between successive points, of each coordinate in turn. Where one goes over the seam of a
// periodic axis it goes to one edge and begins again at the other. `axes` are those of the
// coordinates, null where there is none.
function lineOf(points, axes) {
  const found = axes.map(() => []);
  const put = (point) => found.forEach((line, i) => line.push(point ? point[i] : null));
  points.forEach((b, n) => {
    if (n) seams(points[n - 1], b, axes).forEach(put);
    put(b);
  });
  return found;
}

// What stands between two points: of every seam its one edge, null and its other edge.
function seams(a, b, axes) {
  const round = axes.map((axis) => (axis && axis.periodic ? axis.high - axis.low : Infinity));
  const turns = round.map((span, i) => Math.round((b[i] - a[i]) / span) || 0), found = [];
  const step = a.map((v, i) => b[i] - v - (turns[i] ? turns[i] * round[i] : 0));
  const shift = a.map(() => 0);
  const met = axes.map((axis, i) => ({ i, edge: axis && (turns[i] < 0 ? axis.high : axis.low) }))
    .filter(({ i }) => turns[i])
    .map(({ i, edge }) => ({ i, edge, t: step[i] ? (edge - a[i]) / step[i] : 0 }))
    .sort((one, other) => one.t - other.t);
  for (const { i, edge, t } of met) {
    const at = (x) => a.map((v, k) => (k === i ? x : v + t * step[k] + shift[k]));
    shift[i] = turns[i] * round[i];
    found.push(at(edge), null, at(edge + shift[i]));
  }
  return found;
}

function drawTime(run, names, controls, axes) {
  const t = theme(), traces = [], n = run.controls.length, few = n <= 80;
  const steps = Array.from({ length: n + 1 }, (_, k) => k);
  const styled = (k) => ({ color: t.lines[k % t.lines.length], dash: DASHES[k % DASHES.length] });
  names.forEach((name, k) => {
    const [x, y] = lineOf(run.drawn.map((state, i) => [run.times[i], state[k]]), [null, axes[k]]);
    const same = { type: "scatter", name, legendgroup: `state ${k}` };
    traces.push({ ...same, mode: "lines", x, y, line: styled(k) });
    if (few) {
      const end = run.times.at(-1);
      traces.push({ ...same, mode: "markers", x: run.states.map((_, i) => Math.min(i, end)),
        y: run.states.map((state) => state[k]), showlegend: false,
        marker: { size: 4, color: styled(k).color } });
    }
  });
  controls.forEach((name, k) => traces.push({ type: "scatter", mode: "lines", x: steps,
    y: [...run.controls.map((u) => u[k]), n ? run.controls[n - 1][k] : null], name, yaxis: "y2",
    line: { shape: "hv", ...styled(k + names.length) } }));
  const shape = { showlegend: true, legend: { orientation: "h", y: 1.02, yanchor: "bottom" },
    xaxis: { title: { text: "step" }, rangemode: "tozero", anchor: controls.length ? "y2" : "y" },
    yaxis: { title: { text: "states" }, domain: controls.length ? [0.42, 1] : [0, 1] },
    margin: { l: 60, r: 12, t: 40, b: 45 } };
  if (controls.length) shape.yaxis2 = { title: { text: "controls" }, domain: [0, 0.34] };
  return plot("time", traces, shape);
}

function drawLoop(loop, survival) {
  const t = theme();
  if (!loop) return;
  const turn = Array.from({ length: 181 }, (_, k) => (k * Math.PI) / 90);
  const circle = (r, style) => ({ type: "scatter", mode: "lines", hoverinfo: "skip",
    x: turn.map((a) => r * Math.cos(a)), y: turn.map((a) => r * Math.sin(a)), line: style });
  const traces = [circle(1, { color: t.ink, width: 1.2 })];
  if (loop.contraction !== null) {
    traces.push(circle(loop.contraction / loop.growth, { color: t.faint, width: 1, dash: "dash" }));
  }
  traces.push({ type: "scatter", mode: "markers", x: loop.eigenvalues.map((z) => z[0]),
    y: loop.eigenvalues.map((z) => z[1]), marker: { size: 8, color: t.link,
      line: { color: t.ink, width: 1 } }, hovertemplate: "%{x:.4f} + %{y:.4f} i<extra></extra>" });
  plot("spectrum", traces, { title: headed("eigenvalues; dashed: proved bound"), xaxis: { range: [-1.1, 1.1], title: { text: "real part" } },
  yaxis: { range: [-1.1, 1.1], scaleanchor: "x", title: { text: "imaginary part" } } });
  const every = loop.steps.every((step, k) => step === k), shape = every ? "hv" : "linear";
  const curves = [{ type: "scatter", mode: "lines", x: loop.steps, y: loop.left,
    name: "finite model", line: { shape, color: t.ink, width: 2.2 } }];
  if (survival) {
    curves.push({ type: "scatter", mode: "lines", x: survival.steps, y: survival.left,
      name: "simulated runs", line: { shape: "hv", color: t.link, width: 2, dash: "dash" } });
  }
  plot("decay", curves, { title: headed("share not yet in A"),
    showlegend: true, legend: { x: 1, y: 1, xanchor: "right" },
    xaxis: { title: { text: "steps" }, rangemode: "tozero" },
    yaxis: { type: "log", exponentformat: "power", title: { text: "share" } } });
}

if (typeof module !== "undefined") module.exports = { lineOf };
