"""A function of the user's own that takes one sample at a time, as a step on arrays."""

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from lmdsl.common.types import Floats, Guard
from lmdsl.errors import BadInput
from lmdsl.machine.surroundings import restore_rounding
from lmdsl.machine.workers import Workers
from lmdsl.systems.black_box.audit import Audit, AuditOfSingles
from lmdsl.systems.black_box.function_map import FunctionMap
from lmdsl.systems.black_box.returned import Returned

# Samples of which it is asked before and after a compilation.
ASKED_TWICE = 24

# Parts for each worker: the last ones are short, and the clock is looked at between them.
TASKS = 8


@dataclass(frozen=True)
class Calls:
    """Calls of a scalar function; what is sent to other processes.

    Attributes
    ----------
    function, results, parameters
        As of :class:`FunctionMap`.
    """

    function: Callable[..., Any]
    results: Returned
    parameters: Mapping[str, float]

    def __call__(
        self, task: tuple[Sequence[str], Sequence[Sequence[float]]], guard: Guard | None = None
    ) -> Floats:
        """Return the results of samples, shape (samples, results)."""
        names, samples = task
        found = np.empty((len(samples), len(self.results.names)))
        with np.errstate(all="ignore"):
            for k, sample in enumerate(samples):
                if guard is not None:
                    guard()
                found[k] = self._one(dict(zip(names, sample, strict=True)))
        restore_rounding("the function")
        return found

    def _one(self, sample: dict[str, float]) -> list[float]:
        try:
            images = self.function(**sample, **self.parameters)
        except BadInput:
            raise
        except Exception as error:
            error.add_note(
                f"raised by the function of {self.results.where} at {_said(sample)}; "
                "where a sample has no image, return NaN"
            )
            raise
        at = f" for {_said(sample)}"
        return [
            self.results.number(name, image, at)
            for name, image in zip(
                self.results.names, self.results.ordered(images, at), strict=True
            )
        ]


class ScalarMap(FunctionMap):
    """A function called with Python floats, sample by sample.

    Attributes
    ----------
    pace
        Seconds for a call: the least mean of the calls made so far, infinite before the first.
    processes
        How many processes of their own make the calls while :meth:`helped`; None for this one.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        results: Returned,
        parameters: Mapping[str, float],
        names: Collection[str] | None = None,
        processes: int | None = None,
    ) -> None:
        super().__init__(function, results, parameters, names)
        self.processes, self.pace = processes, math.inf
        self._calls = Calls(function, results, self.parameters)
        self._workers: Workers | None = None

    def returned(self, values: Mapping[str, Any], guard: Guard | None = None) -> list[Any]:
        """Return the results of all samples, in the shape to which the arguments broadcast."""
        return self._returned(values, guard, self._workers)

    def twice(
        self, values: Mapping[str, Any], guard: Guard | None = None
    ) -> tuple[list[Any], list[Any]]:
        """Return the results of two tries, the second in this process: they must agree.

        What a program changes in a module is not changed in the processes that it starts.
        """
        first = self.returned(values, guard)
        return first, self._returned(values, guard, None)

    def _returned(
        self, values: Mapping[str, Any], guard: Guard | None, workers: Workers | None
    ) -> list[Any]:
        given = self.taken(values)
        arrays = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in given.values()))
        shape = arrays[0].shape if arrays else ()
        samples = np.stack([x.ravel() for x in arrays], axis=-1).tolist() if arrays else [[]]
        found = self._made(list(given), samples, guard, workers)
        return [column.reshape(shape) for column in np.ascontiguousarray(found.T)]

    def audit(self, values: Mapping[str, Any], guard: Guard | None = None) -> Audit:
        """Return what it answers to a few of the samples; refuse it unless a second try agrees."""
        return AuditOfSingles(self, few(values, ASKED_TWICE), guard)

    @contextmanager
    def helped(self) -> Iterator[None]:
        """Keep the processes that make the calls, where some are asked for."""
        if self.processes is None or self._workers is not None:
            yield
            return
        with Workers(self._calls, self.processes, self.results.where) as workers:
            self._workers = workers
            try:
                yield
            finally:
                self._workers = None

    def _made(
        self,
        names: list[str],
        samples: list[list[float]],
        guard: Guard | None,
        workers: Workers | None,
    ) -> Floats:
        started, at_once = time.perf_counter(), 1
        if workers is None:
            found = self._calls((names, samples), guard)
        else:
            size = max(1, -(-len(samples) // (TASKS * workers.count)))
            parts = [(names, samples[k : k + size]) for k in range(0, len(samples), size)]
            at_once = min(workers.count, len(parts))
            found = np.concatenate(workers.map(parts, guard))
        if samples:
            seconds = (time.perf_counter() - started) * at_once / len(samples)
            self.pace = min(self.pace, seconds)
        return found


def few(values: Mapping[str, Any], count: int) -> dict[str, Floats]:
    """Return some of the samples of arrays that broadcast, spread over all, shape (count,)."""
    arrays = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in values.values()))
    places = np.unique(np.linspace(0, arrays[0].size - 1, count).astype(int))
    return {name: x.ravel()[places] for name, x in zip(values, arrays, strict=True)}


def _said(sample: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {value!r}" for name, value in sample.items())
