// Curves: a run over its steps, the spectrum of the closed loop, how fast mass enters A.

function drawTime(run, names, controls) {
  const t = theme(), traces = [], n = run.controls.length;
  const steps = Array.from({ length: n + 1 }, (_, k) => k);
  const styled = (k) => ({ color: t.lines[k % t.lines.length], dash: DASHES[k % DASHES.length] });
  names.forEach((name, k) => traces.push({ type: "scatter", mode: n > 80 ? "lines" : "lines+markers",
    x: steps, y: run.states.map((x) => x[k]), name, line: styled(k), marker: { size: 4 } }));
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
