"""What a translation becomes: a system of formulas, or one of the function it was."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from lmdsl.common import optional
from lmdsl.common.types import Floats
from lmdsl.errors import BadInput
from lmdsl.formulas.language import parse
from lmdsl.systems.base import MapSystem, OdeSystem, System
from lmdsl.systems.function import FunctionSystem
from lmdsl.systems.runge_kutta import rk4
from lmdsl.systems.translated.terms import Untranslatable


class Images(NamedTuple):
    """The images of states as another tool has them, in two ways.

    Attributes
    ----------
    states
        Their names.
    names
        What formulas may name.
    write
        Return a formula for each state; Untranslatable where the language lacks something.
    call
        Return the same as a function of arrays by name.
    """

    states: Sequence[str]
    names: Sequence[str]
    write: Callable[[], Sequence[str]]
    call: Callable[[], Callable[..., Mapping[str, Any]]]


def comes_from(package: str, value: Any) -> bool:
    """Return whether a value is of a class of a package, without importing it."""
    return any((each.__module__ or "").partition(".")[0] == package for each in type(value).__mro__)


def needed(package: str) -> Any:
    """Import an optional package.

    Raises
    ------
    MissingDependency
        It is not installed.
    """
    return optional.needed(package, f"from_{package}", package)


def system_of(
    images: Images, parameters: dict[str, float], step: float | None, substeps: Any
) -> System:
    """Return a system of formulas; where these say too little, warn, and return one of a function.

    A map; with ``step`` the images are derivatives.
    """
    if step is None and substeps is not None:
        raise BadInput("a map has no substeps; give the step of a differential equation", "step")
    given = {"step": step, "substeps": substeps}
    time = {key: value for key, value in given.items() if value is not None}
    try:
        formulas = dict(zip(images.states, images.write(), strict=True))
        require_size(formulas, images.names)
    except Untranslatable as why:
        return _of_function(images.call(), images.states, parameters, time, str(why))
    if time:
        return OdeSystem(derivative=formulas, parameters=parameters, **time)
    return MapSystem(next=formulas, parameters=parameters)


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


def _of_function(
    field: Callable[..., Mapping[str, Any]],
    states: Sequence[str],
    parameters: dict[str, float],
    time: Mapping[str, Any],
    why: str,
) -> System:
    """Return a system that calls a function of arrays by name, and say why it has to."""
    warnings.warn(
        f"formulas have no place for {why}: the function is called as it is, so the problem is "
        "solved as usual, but cannot be written to a file, and nothing can be enclosed",
        UserWarning,
        stacklevel=4,
    )
    step, substeps = time.get("step"), time.get("substeps", 1)
    if step is None:
        return FunctionSystem(next=field, parameters=parameters)
    if not isinstance(substeps, int):
        raise BadInput(f"a function needs a number of substeps, not {substeps!r}", "substeps")
    OdeSystem(derivative={}, step=step, substeps=substeps)  # refuses what is no time
    method = RungeKuttaOfFunction(field, tuple(states), step, substeps)
    return FunctionSystem(next=method, parameters=parameters)


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

        def slope(x: Sequence[Floats]) -> tuple[Floats, ...]:
            return self._of(self.field(**{**values, **dict(zip(self.states, x, strict=True))}))

        for substep in rk4(slope, self._of(values), self.h, self.substeps):
            end = substep.end
        return dict(zip(self.states, end, strict=True))

    def _of(self, values: Mapping[str, Any]) -> tuple[Floats, ...]:
        return tuple(np.asarray(values[name], dtype=np.float64) for name in self.states)
