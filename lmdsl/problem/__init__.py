"""What a user declares: one model per key of a problem file."""

from lmdsl.problem.axes import Axis
from lmdsl.problem.controls import ControlRange, ControlValues
from lmdsl.problem.local_control import ConstantControl, LinearFeedback, LqrFeedback
from lmdsl.problem.noise import NoiseNormal, NoiseValues
from lmdsl.problem.problem import Problem, json_schema, load
from lmdsl.problem.sampling import Grid, Random, Sobol
from lmdsl.problem.sets import Attractor, Avoid, Measure

__all__ = [
    "Attractor", "Avoid", "Axis", "ConstantControl", "ControlRange", "ControlValues", "Grid",
    "LinearFeedback", "LqrFeedback", "Measure", "NoiseNormal", "NoiseValues", "Problem", "Random",
    "Sobol", "json_schema", "load",
]  # fmt: skip
