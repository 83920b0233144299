"""A function of the user's own that takes arrays, as a step from named arrays to results.

It gets copies that it cannot write to, and what it returns is copied into plain arrays of doubles.
"""

import inspect
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from lmdsl.common.types import Floats, Guard
from lmdsl.errors import BadInput
from lmdsl.machine.surroundings import restore_rounding
from lmdsl.systems.black_box.audit import Audit
from lmdsl.systems.black_box.returned import Returned

# What NumPy says where a function is written for numbers and gets arrays.
ONE_SAMPLE = ("truth value of an array", "converted to Python scalars", "length-1 arrays")


class FunctionMap:
    """A vectorised function, its results in order.

    Parameters
    ----------
    function
        Called with arrays by name.
    results
        What it returns.
    parameters
        Constants that it is given besides.
    names
        Those that it takes; None for all there are.
    """

    formulas = enclose = None  # nobody knows what it does, nor how long that takes
    live, effort, work = 16, math.inf, math.inf

    def __init__(
        self,
        function: Callable[..., Any],
        results: Returned,
        parameters: Mapping[str, float],
        names: Collection[str] | None = None,
    ) -> None:
        self.function, self.results, self.names = function, results, names
        self.parameters = {name: x for name, x in parameters.items() if self._takes(name)}

    def __call__(self, values: Mapping[str, Any], guard: Guard | None = None) -> tuple[Floats, ...]:
        """Return the results as new arrays, each of the shape of the arguments it depends on."""
        if guard is not None:
            guard()
        return tuple(np.array(image, dtype=np.float64) for image in self.returned(values, guard))

    def returned(self, values: Mapping[str, Any], guard: Guard | None = None) -> list[Any]:
        """Return the results as the function made them, each an array of the right shape."""
        given = {name: np.array(x, dtype=np.float64) for name, x in self.taken(values).items()}
        shape = np.broadcast_shapes(*(array.shape for array in given.values()))
        for array in given.values():
            array.setflags(write=False)
        try:
            with np.errstate(all="ignore"):
                images = self.function(**given, **self.parameters)
            restore_rounding("the function")
        except BadInput:
            raise
        except (ValueError, TypeError) as error:
            raise self._explained(error) from error
        names, ordered = self.results.names, self.results.ordered(images)
        if self.results.single and shape and np.ndim(images) == 0:
            shape = ()  # depends on nothing
        return [
            self.results.array(name, image, shape)
            for name, image in zip(names, ordered, strict=True)
        ]

    def taken(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return those of the values that the function takes."""
        return {name: value for name, value in values.items() if self._takes(name)}

    def twice(
        self, values: Mapping[str, Any], guard: Guard | None = None
    ) -> tuple[list[Any], list[Any]]:
        """Return :meth:`returned` of two tries."""
        return self.returned(values, guard), self.returned(values, guard)

    def audit(self, values: Mapping[str, Any], guard: Guard | None = None) -> Audit:
        """Return what it answers to some samples; refuse it unless a second try agrees."""
        return Audit(self, values, guard)

    @contextmanager
    def helped(self) -> Iterator[None]:
        """Keep ready what helps with many calls: nothing here."""
        yield

    def _takes(self, name: str) -> bool:
        return self.names is None or name in self.names

    def _explained(self, error: ValueError | TypeError) -> Exception:
        """Return the error to raise instead: ours where its cause is known."""
        text = str(error)
        if "read-only" in text:
            return self.results.fault(
                f"the function writes to its arguments ({error}); write to a copy, x = x.copy()"
            )
        if any(words in text for words in ONE_SAMPLE):
            return self.results.fault(
                f"the function is written for one sample at a time ({error}); declare "
                "vectorized=False, or write it for arrays (numpy.where instead of if)"
            )
        return error


def parameters_of(function: Callable[..., Any], known: Collection[str], where: str) -> list[str]:
    """Return those of the known names that a function takes: all if that cannot be said.

    Raises
    ------
    BadInput
        It takes something else.
    """
    try:
        signature = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # of a builtin, say
        return [*known]
    if any(each.kind == each.VAR_KEYWORD for each in signature):
        return [*known]
    for each in signature:
        if (
            each.name not in known
            and each.default is each.empty
            and each.kind != each.VAR_POSITIONAL
        ):
            listed = ", ".join(known)
            raise BadInput(
                f"the function takes {each.name!r}, which is none of {listed}; name its arguments "
                "after states, controls, noise or parameters",
                where,
            )
    return [each.name for each in signature if each.name in known]
