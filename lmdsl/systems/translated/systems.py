"""What a translation becomes: a system of formulas, or one of the function it was."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.errors import BadInput, MissingDependency
from lmdsl.formulas.language import parse
from lmdsl.systems.base import MapSystem, OdeSystem, System
from lmdsl.systems.function import FunctionSystem
from lmdsl.systems.translated.terms import Untranslatable


def needed(package: str) -> Any:
    """Import an optional package.

    Raises
    ------
    MissingDependency
        It is not installed.
    """
    from importlib import import_module

    try:
        return import_module(package)
    except ImportError:
        raise MissingDependency(
            f"from_{package} needs the package {package}; pip install 'lmdsl[{package}]'"
        ) from None


def of_formulas(
    formulas: Mapping[str, str], parameters: Mapping[str, float], time: Mapping[str, Any]
) -> System:
    """Return a map, or a differential equation where a time says so."""
    if time:
        return OdeSystem(derivative=dict(formulas), parameters=dict(parameters), **time)
    return MapSystem(next=dict(formulas), parameters=dict(parameters))


def of_time(step: float | None, substeps: Any) -> dict[str, Any]:
    """Return the keys of a differential equation that are given."""
    given = {"step": step, "substeps": substeps}
    if step is None and substeps is not None:
        raise BadInput("a map has no substeps; give the step of a differential equation", "step")
    return {key: value for key, value in given.items() if value is not None}


def require_size(formulas: Mapping[str, str], names: Sequence[str]) -> None:
    """Refuse formulas that are longer or nest deeper than the language allows.

    Raises
    ------
    Untranslatable
        One is.
    """
    for text in formulas.values():
        try:
            parse(text, names)
        except BadInput as error:
            raise Untranslatable(f"formulas that it refuses ({error})") from None


def of_function(
    field: Callable[..., Mapping[str, Any]],
    states: Sequence[str],
    parameters: Mapping[str, float],
    time: Mapping[str, Any],
    why: str,
) -> System:
    """Return a system that calls a function of arrays by name, and say why it has to."""
    warnings.warn(
        f"formulas have no place for {why}: the function is called as it is, so the problem is "
        "solved as usual, but cannot be written to a file, and nothing can be enclosed",
        UserWarning,
        stacklevel=3,
    )
    step, substeps = time.get("step"), time.get("substeps", 1)
    if step is None:
        return FunctionSystem(next=field, parameters=dict(parameters))
    if not isinstance(substeps, int):
        raise BadInput(f"a function needs a number of substeps, not {substeps!r}", "substeps")
    OdeSystem(derivative={}, step=step, substeps=substeps)  # refuses what is no time
    return FunctionSystem(
        next=RungeKuttaOfFunction(field, tuple(states), step, substeps),
        parameters=dict(parameters),
    )


class RungeKuttaOfFunction:
    """The classical Runge-Kutta step of a derivative that is a function of arrays by name."""

    def __init__(
        self,
        field: Callable[..., Mapping[str, Any]],
        states: tuple[str, ...],
        step: float,
        substeps: int,
    ) -> None:
        self.field, self.states = field, states
        self.h, self.substeps = step / substeps, substeps

    def __call__(self, **values: Any) -> dict[str, Any]:
        """Return the states after the step."""
        h, x = self.h, self._of(values)
        for _ in range(self.substeps):
            k1 = self._slope(values, x)
            k2 = self._slope(values, [a + h / 2 * k for a, k in zip(x, k1, strict=True)])
            k3 = self._slope(values, [a + h / 2 * k for a, k in zip(x, k2, strict=True)])
            k4 = self._slope(values, [a + h * k for a, k in zip(x, k3, strict=True)])
            x = [
                a + h / 6 * (k + 2 * m + 2 * n + o)
                for a, k, m, n, o in zip(x, k1, k2, k3, k4, strict=True)
            ]
        return dict(zip(self.states, x, strict=True))

    def _of(self, values: Mapping[str, Any]) -> list[Floats]:
        return [np.asarray(values[name], dtype=np.float64) for name in self.states]

    def _slope(self, values: Mapping[str, Any], x: Sequence[Floats]) -> list[Floats]:
        return self._of(self.field(**{**values, **dict(zip(self.states, x, strict=True))}))
