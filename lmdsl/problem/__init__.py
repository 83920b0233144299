"""What a user declares: one model per key of a problem file."""

import os
from typing import Any, TypeVar, overload

from lmdsl.common import inputs
from lmdsl.common.types import FilePath
from lmdsl.errors import BadInput, shown
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
    "Sobol", "given", "json_schema", "load",
]  # fmt: skip

Compiled = TypeVar("Compiled")


@overload
def given(problem: Problem | FilePath) -> Problem: ...


@overload
def given(
    problem: Problem | Compiled | FilePath, compiled: type[Compiled]
) -> Problem | Compiled: ...


def given(problem: Any, compiled: Any = None) -> Any:
    """Return the problem that an argument stands for: it may be the path of a problem file.

    Where a class of compiled problems is named, one of these is returned as it is.
    """
    if isinstance(problem, str | os.PathLike):
        if inputs.path(problem, "problem").is_dir():
            message = "is a directory; of a saved result take lm.Result.load(path).problem"
            raise BadInput(f"{shown(os.fspath(problem), 200)} {message}", "problem")
        return load(problem)
    kinds = (Problem,) if compiled is None else (Problem, compiled)
    wanted = "a Problem or the path of a problem file"
    inputs.kind(problem, kinds, "problem", wanted + ", or a compiled LP" * (len(kinds) - 1))
    return problem


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the problem file, made from the models themselves."""
    schema = Problem.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "lmdsl problem file"
    return schema
