"""Pictures of a problem and its result; matplotlib is imported when something is drawn."""

from lmdsl.plotting.motion import portrait, trajectories
from lmdsl.plotting.pages.animation import Film, animate
from lmdsl.plotting.pages.page import figure
from lmdsl.plotting.pages.panels import projections, slices
from lmdsl.plotting.pages.studies import study
from lmdsl.plotting.plots import causes, control, cost, coverage, measure
from lmdsl.plotting.proved.brackets import bracket
from lmdsl.plotting.proved.proofs import proof

__all__ = [
    "Film", "animate", "bracket", "causes", "control", "cost", "coverage", "figure", "measure",
    "portrait", "projections", "proof", "slices", "study", "trajectories",
]  # fmt: skip
