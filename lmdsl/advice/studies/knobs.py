"""What a study turns, and the variants of a problem that this makes."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from lmdsl import backends
from lmdsl.advice.studies.record import StudyRow
from lmdsl.common import inputs
from lmdsl.errors import BadInput, shown
from lmdsl.explanation.remedies import with_cells
from lmdsl.problem.problem import Problem
from lmdsl.problem.whole.changing import with_samples, with_step
from lmdsl.systems import MatrixSystem

KNOBS = ("step", "samples", "cells", "gamma", "backend")  # the last changes fastest
MOST = 10_000  # number of variants above which a study is refused


class Variation(NamedTuple):
    """One variant that is asked for.

    Attributes
    ----------
    cells
        Of each axis.
    samples
        Sample points of each axis of a grid, else of a cell (its corners apart).
    step
        Sampling time; None of a map.
    gamma, backend
        As for a solve.
    """

    cells: dict[str, int]
    samples: int | None
    step: float | None
    gamma: float
    backend: str

    def is_of(self, row: StudyRow) -> bool:
        """Return whether a row is one of this variant."""
        return all(getattr(row, name) == value for name, value in self._asdict().items())

    def of(self, problem: Problem) -> Problem:
        """Return the problem in this variant, but for gamma.

        BadInput: there is no such problem, as the step of a map.
        """
        own = own_values(problem)
        if self.step != own.step and self.step is not None:
            problem = with_step(problem, self.step)
        if self.samples != own.samples and self.samples is not None:
            problem = with_samples(problem, self.samples)
        if self.cells != own.cells:
            if problem.attractor.cells:
                raise BadInput(
                    "it names cells by index, and their number changes; write boxes or points",
                    "attractor.cells",
                )
            problem = with_cells(problem, self.cells)
        return problem


def own_values(problem: Problem) -> Variation:
    """Return the values that a problem has itself."""
    sampling: Any = problem.sampling
    samples = sampling.per_axis if sampling.kind == "grid" else sampling.points
    return Variation(
        {name: axis.cells for name, axis in problem.state_box.items()},
        samples if isinstance(samples, int) else None,
        getattr(problem.system, "step", None),
        problem.gamma,
        backends.DEFAULT,
    )


def variants(problem: Problem, given: Mapping[str, Any]) -> list[Variation]:
    """Return all variants, those that share a compiled model one after the other.

    ``given`` holds a list for every knob that is turned, under its name or in the plural; None
    where it is not.
    """
    own = own_values(problem)
    values: dict[str, list[Any]] = {name: [getattr(own, name)] for name in KNOBS}
    for key, read in (
        ("step", _positive),
        ("samples", _whole),
        ("cells", lambda value, where: _cells(problem, value, where)),
        ("gamma", _positive),
        ("backends", _backend),
    ):
        if given.get(key) is not None:
            name = "backend" if key == "backends" else key
            values[name] = list(_unique(given[key], key, read))
    if isinstance(problem.system, MatrixSystem):
        for key in ("cells", "samples", "step"):
            if given.get(key) is not None:
                raise BadInput("a finite model has its states; leave it out", key)
    if given.get("step") is not None and own.step is None:
        raise BadInput("a map has no step; leave it out", "step")
    found = [Variation(**dict(zip(KNOBS, each, strict=True)))
             for each in itertools.product(*(values[name] for name in KNOBS))]  # fmt: skip
    if len(found) > MOST:
        raise BadInput(f"these are {len(found):,} variants; {MOST:,} at most", "study")
    return found


def _unique(values: Any, key: str, read: Any) -> Iterator[Any]:
    if isinstance(values, str | Mapping) or not isinstance(values, Sequence):
        raise BadInput(f"{shown(values)} is not a list of values", key)
    if not len(values):
        raise BadInput("no value is named; name at least one, or leave it out", key)
    seen: list[Any] = []
    for i, value in enumerate(values):
        found = read(value, f"{key}[{i}]")
        if found not in seen:
            seen.append(found)
            yield found


def _positive(value: Any, where: str) -> float:
    if not inputs.is_number(value) or not 0 < value < 1e300:
        raise BadInput(f"{shown(value)} is not a finite number above 0", where)
    return float(value)


def _whole(value: Any, where: str) -> int:
    return inputs.whole(value, where)


def _backend(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise BadInput(f"{shown(value)} is not the name of a backend", where)
    backends.resolve(value)
    return value


def _cells(problem: Problem, value: Any, where: str) -> dict[str, int]:
    """Return the cells of each axis of: one number for all, numbers in order, or by name."""
    names = problem.states
    if isinstance(value, Mapping):
        for name in value:
            if name not in names:
                raise BadInput(f"{shown(name)} is not an axis; these are {', '.join(names)}", where)
        own = {name: axis.cells for name, axis in problem.state_box.items()}
        given = {**own, **value}
    elif isinstance(value, list | tuple):
        if len(value) != len(names):
            raise BadInput(f"{len(value)} numbers for {len(names)} axes; give one each", where)
        given = dict(zip(names, value, strict=True))
    else:
        given = dict.fromkeys(names, value)
    return {name: inputs.whole(count, f"{where}.{name}") for name, count in given.items()}
