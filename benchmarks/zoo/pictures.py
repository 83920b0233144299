"""The pictures of the zoo: two panels a system, in few colours, below 60 kB."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import lmdsl as lm
from benchmarks.zoo import ROOT, Entry, problem

FOLDER = ROOT / "docs/images/zoo"
PANELS = ["cost", "trajectories"]


def draw(name: str, entry: Entry) -> int:
    """Draw the system as its problem file declares it; return the bytes of the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    figure = Figure(figsize=(9.2, 4), dpi=85, layout="constrained")
    FigureCanvasAgg(figure)
    result = lm.solve(problem(entry))
    for k, panel in enumerate(entry.get("panels", PANELS)):
        _panel(panel, result, figure.add_subplot(1, 2, k + 1), entry)
    content = BytesIO()
    figure.savefig(content, format="png")
    # Of all palettes this one keeps what is small and bright, such as a small attractor.
    exact = Image.open(content).convert("RGB")
    few = exact.quantize(160, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    FOLDER.mkdir(parents=True, exist_ok=True)
    path = FOLDER / f"{name}.png"
    few.save(path, optimize=True)
    return path.stat().st_size


def _panel(panel: str, result: lm.Result, ax: Any, entry: Entry) -> None:
    shown = {key: entry[key] for key in ("axes", "at") if key in entry}
    if panel == "trajectories":
        lm.plotting.trajectories(result, ax, starts=entry.get("starts", 12), **shown)
    elif panel.startswith("control"):
        lm.plotting.control(result, panel.partition(" ")[2] or None, ax, **shown)
    elif panel == "portrait":
        lm.plotting.portrait(result, ax=ax, **shown)
    else:
        {"cost": lm.plotting.cost, "measure": lm.plotting.measure}[panel](result, ax, **shown)
