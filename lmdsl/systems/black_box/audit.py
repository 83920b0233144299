"""Whether a user's function answers the same question the same way, asked several ways."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lmdsl.common.types import Floats, Guard
from lmdsl.errors import BadInput

if TYPE_CHECKING:
    from lmdsl.systems.black_box.function_map import FunctionMap


# Samples that are also asked for one by one: before a compilation, and of every block of it.
ALONE, OF_BLOCK = 8, 2

# Differences that are rounding: of the same call twice, and of a sample among others and alone
# (an integrator may choose its steps for all), in parts of the spread of the images.
REPEATED, APART = 1e-12, 1e-3


class Audit:
    """What a function answered to some samples, to be asked again.

    Raises
    ------
    BadInput
        It returns the same memory again, another answer, or another one to a sample by itself.
    """

    def __init__(
        self, asked: FunctionMap, values: Mapping[str, Any], guard: Guard | None = None
    ) -> None:
        self.asked = asked
        self.values = {name: np.array(value, dtype=np.float64) for name, value in values.items()}
        kept, again = asked.twice(self.values, guard)
        self.first = tuple(np.array(image, dtype=np.float64) for image in kept)
        for name, a, b in zip(asked.results.names, kept, again, strict=True):
            if a.size > 1 and np.may_share_memory(a, b):
                raise BadInput(
                    f"the function returned {asked.results.called(name)} in the same memory twice; "
                    "return a new array at every call",
                    asked.results.where,
                )
        self._compare(tuple(np.array(image, dtype=np.float64) for image in again))
        self._spread = [_spread(image) for image in self.first]
        self.alone(self.values, self.first, ALONE)

    def again(self) -> None:
        """Ask once more."""
        self._compare(self.asked(self.values))

    def _compare(self, images: tuple[Floats, ...]) -> None:
        for name, a, b in zip(self.asked.results.names, self.first, images, strict=True):
            shape = np.broadcast_shapes(a.shape, b.shape)
            a, b = np.broadcast_to(a, shape), np.broadcast_to(b, shape)
            differs = _differ(a, b, REPEATED, _spread(a))
            if differs.any():
                k = tuple(int(i) for i in np.argwhere(differs)[0])
                raise BadInput(
                    f"the function gave {name} = {float(a[k])!r} and later {float(b[k])!r} for "
                    f"{_sample(self.values, k)}; it must answer the same every time: draw no "
                    "random numbers (declare noise instead) and keep nothing between calls",
                    self.asked.results.where,
                )

    def alone(
        self, values: Mapping[str, Floats], images: Sequence[Floats], count: int = OF_BLOCK
    ) -> None:
        """Ask for some of the samples that have these images one by one."""
        shape = np.broadcast_shapes(*(array.shape for array in values.values()))
        places = (np.arange(count) / count) ** 1.3  # the first, and nothing regular
        for flat in np.unique((places * (np.prod(shape) - 1)).astype(int)):
            k = tuple(int(i) for i in np.unravel_index(flat, shape))
            one = {
                name: np.broadcast_to(array, shape)[k].reshape((1,) * len(shape))
                for name, array in values.items()
            }
            for name, image, alone, spread in zip(
                self.asked.results.names, images, self.asked(one), self._spread, strict=True
            ):
                among = np.broadcast_to(image, shape)[k]
                if _differ(among, alone.ravel(), APART, spread).any():
                    raise BadInput(
                        f"the function gives {name} = {float(among)!r} for "
                        f"{_sample(values, k)} among others and {float(alone.ravel()[0])!r} for it "
                        "alone; the image of a sample must not depend on other samples, and "
                        "keep nothing between calls",
                        self.asked.results.where,
                    )


class AuditOfSingles(Audit):
    """The same of a function that is called sample by sample: each is alone anyway."""

    def alone(
        self, values: Mapping[str, Floats], images: Sequence[Floats], count: int = OF_BLOCK
    ) -> None:
        """Ask nothing."""


def _sample(values: Mapping[str, Floats], k: tuple[int, ...]) -> str:
    shape = np.broadcast_shapes(*(array.shape for array in values.values()))
    k = k + (0,) * (len(shape) - len(k))  # the results may depend on nothing that varies
    return ", ".join(
        f"{name} = {float(np.broadcast_to(array, shape)[k])!r}" for name, array in values.items()
    )


def _spread(image: Floats) -> float:
    finite = image[np.isfinite(image)]
    return float(finite.max() - finite.min()) if finite.size else 0.0


def _differ(a: Any, b: Any, share: float, spread: float) -> Any:
    """Return where two answers differ by more than a share of the spread, or of themselves."""
    with np.errstate(all="ignore"):
        near = np.abs(a - b) <= share * spread + REPEATED * np.abs(a)
    return ~(near | (a == b) | (np.isnan(a) & np.isnan(b)))
