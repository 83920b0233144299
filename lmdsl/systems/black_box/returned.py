"""What a user's function returned: real numbers in the right shape, or a message why not."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lmdsl.errors import BadInput, shown


@dataclass(frozen=True)
class Returned:
    """What a function is to return.

    Attributes
    ----------
    names
        Of its results, in order: the states, or what a function of a single result computes.
    where
        The field that holds the function.
    single
        It returns one result and neither mapping nor sequence.
    """

    names: tuple[str, ...]
    where: str
    single: bool = False

    def called(self, name: str) -> str:
        """Return how messages speak of a result."""
        return "the result" if self.single else f"the image of {name}"

    def ordered(self, results: Any, at: str = "") -> list[Any]:
        """Return the results in the order of their names; ``at`` says for which sample."""
        if self.single:
            return [results]
        needed = f"return a mapping with the keys {', '.join(self.names)}, or a sequence of as many"
        if isinstance(results, Mapping):
            if set(results) != set(self.names):
                raise self.fault(f"the function returned {shown(list(results))}{at}; {needed}")
            return [results[name] for name in self.names]
        try:
            ordered = list(results)
        except TypeError:
            raise self.fault(f"the function returned {shown(results)}{at}; {needed}") from None
        if len(ordered) != len(self.names):
            count = f"{len(ordered)} images for {len(self.names)} states"
            raise self.fault(f"the function returned {count}{at}; {needed}")
        return ordered

    def array(self, name: str, result: Any, shape: tuple[int, ...]) -> Any:
        """Return a result as an array of real numbers in a shape that fits the arguments."""
        what = self.called(name)
        masked = isinstance(result, np.ma.MaskedArray) and np.ma.getmaskarray(result).sum()
        if masked:
            raise self.fault(
                f"{what} is masked in {masked} places; return plain arrays, NaN where there is no "
                "image"
            )
        try:
            array = np.asarray(result)
        except (TypeError, ValueError):
            raise self.fault(f"{what} is {shown(result)}, no array of numbers") from None
        if array.dtype.kind not in "fiu":
            raise self.fault(f"{what} is of type {array.dtype.name}; real numbers are needed")
        fits = array.ndim == 0 or (
            array.ndim == len(shape)
            and all(k in (1, n) for k, n in zip(array.shape, shape, strict=True))
        )
        if not fits:
            raise self.fault(
                f"{what} has shape {array.shape}; it must be that of the arguments it depends on, "
                f"which broadcast to {shape}: treat every sample by itself"
            )
        return array

    def number(self, name: str, result: Any, at: str) -> float:
        """Return the result of a single sample as a double."""
        if type(result) is float:
            return result
        real = isinstance(result, int | float | np.integer | np.floating)
        if isinstance(result, np.ndarray):
            real = result.ndim == 0 and result.dtype.kind in "fiu"
        if not real or isinstance(result, bool):
            raise self.fault(
                f"{self.called(name)} is {shown(result)}{at}; a function with vectorized=False "
                "returns a real number, NaN where there is no image"
            )
        try:
            return float(result)
        except OverflowError:
            return float("inf") if result > 0 else float("-inf")

    def fault(self, message: str) -> BadInput:
        """Return the error of a message about the function."""
        return BadInput(message, self.where)
