"""Why cells cannot be stabilized, and what would help."""

from lmdsl.explanation.causes import Explanation, explain, phase_one
from lmdsl.explanation.lost_mass import PhaseOne

__all__ = ["Explanation", "PhaseOne", "explain", "phase_one"]
