"""Pictures of a problem and its result; matplotlib is imported when something is drawn."""

from lmdsl.plotting.brackets import bracket
from lmdsl.plotting.closed_loop import trajectories
from lmdsl.plotting.page import figure
from lmdsl.plotting.plots import causes, control, cost, measure, portrait
from lmdsl.plotting.proofs import proof
from lmdsl.plotting.studies import study

__all__ = [
    "bracket", "causes", "control", "cost", "figure", "measure", "portrait", "proof",
    "study", "trajectories",
]  # fmt: skip
