"""Storm, asked by its Python package, whose interface changed with version 2."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import pytest

PRECISION = 1e-6
"""Storm's stated default, relative to the value; a bound of the error with sound methods only."""

COSTS = 'R{"cost"}min=? [F "attractor"]'


def package():
    return pytest.importorskip("stormpy", reason="Storm is not installed")


def newer() -> bool:
    return hasattr(package(), "environments")


def read(path, exact=False):
    """Storm's model of a DRN file."""
    stormpy = package()
    if not exact:
        return stormpy.build_model_from_drn(str(path))
    if not newer():
        pytest.skip("this version of stormpy reads DRN files as doubles only")
    return stormpy.build_model_from_drn[stormpy.Rational](str(path))


def built(program: Path, exact=False):
    """Storm's model of a file in the language of PRISM, with its labels and rewards."""
    stormpy = package()
    parsed = stormpy.parse_prism_program(str(program))
    options = stormpy.BuilderOptions()
    options.set_build_all_labels()
    options.set_build_all_reward_models()
    if newer():
        build = stormpy.build_model[stormpy.Rational] if exact else stormpy.build_model
        return build(parsed, options=options)
    kind = "exact_" if exact else ""
    return getattr(stormpy, f"build_sparse_{kind}model_with_options")(parsed, options)


def written(model, path) -> None:
    """Let Storm write its model as DRN."""
    stormpy = package()
    if newer():
        import stormpy.io
    export = stormpy.io.export_to_drn if newer() else stormpy.export_to_drn
    export(model, str(path))


def answer(model, question, exact=False):
    """The value of every state, by sound methods, or exact for an exact model."""
    stormpy = package()
    asked = stormpy.parse_properties(question)[0]
    if newer():
        found = stormpy.model_checking(model, asked)
    else:
        environment = stormpy.Environment()
        environment.solver_environment.set_force_sound(True)
        found = stormpy.model_checking(model, asked, environment=environment)
    values = found.get_value_vector() if hasattr(found, "get_value_vector") else found.get_values()
    if not exact:
        return [float(v) for v in values]
    endless = "inf" if newer() else "100000000000"  # version 1 has no infinity of fractions
    return [math.inf if str(v) == endless else Fraction(str(v)) for v in values]
