"""What a user declares: one model per key of a problem file."""

from typing import Any

from lmdsl.problem.axes import Axis
from lmdsl.problem.controls import ControlRange, ControlValues
from lmdsl.problem.local_control import ConstantControl, LinearFeedback, LqrFeedback
from lmdsl.problem.noise import NoiseNormal, NoiseValues
from lmdsl.problem.problem import Problem, load
from lmdsl.problem.sampling import Grid, Random, Sobol
from lmdsl.problem.sets import Attractor, Avoid, Measure

__all__ = [
    "Attractor", "Avoid", "Axis", "ConstantControl", "ControlRange", "ControlValues", "Grid",
    "LinearFeedback", "LqrFeedback", "Measure", "NoiseNormal", "NoiseValues", "Problem", "Random",
    "Sobol", "json_schema", "load",
]  # fmt: skip


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the problem file, made from the models themselves."""
    schema = Problem.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "lmdsl problem file"
    return schema
