"""A system written as a Python function, and what it must do to be one.

The function is the user's: it gets copies that it cannot write to, its images are copied into plain
arrays of doubles, and before and after a compilation it is asked the same question several ways.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field

from lmdsl.common.types import Floats, Guard
from lmdsl.errors import BadInput, shown
from lmdsl.formulas.language import NO_DEFINITIONS, Definitions
from lmdsl.machine.surroundings import restore_rounding
from lmdsl.systems.base import StateMap, System

WHERE = "system.next"
# Samples that are also asked for one by one: before a compilation, and of every block of it.
ALONE, OF_BLOCK = 8, 2

# Differences that are rounding: of the same call twice, and of a sample among others and alone (an
# integrator may choose its steps for all), in parts of the spread of the images.
REPEATED, APART = 1e-12, 1e-3


class FunctionSystem(System):
    """A system written as a Python function; it works everywhere except in JSON files.

    Attributes
    ----------
    next
        ``next(**values)`` receives every state, control, noise variable and parameter by name, as
        arrays that broadcast against each other, and returns the images: a mapping from state
        names, or a sequence in the order of the axes. It must work on each sample by itself (NumPy
        semantics), answer the same every time, also when called from several threads, and not
        write to its arguments, which are read-only.

    Examples
    --------
    >>> import lmdsl as lm
    >>> lm.systems.FunctionSystem(next=lambda x, u: {"x": 0.5 * x + u}).kind
    'function'
    """

    kind: Literal["function"] = "function"
    next: Callable[..., Any] = Field(exclude=True)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        """Say that no JSON is a function."""
        return {"not": {}}

    def compile(
        self,
        states: Sequence[str],
        controls: Sequence[str],
        noise: Sequence[str],
        definitions: Definitions = NO_DEFINITIONS,
    ) -> StateMap:
        """See :meth:`System.compile`."""
        return FunctionMap(self.next, tuple(states), dict(self.parameters))


class FunctionMap:
    """The map of a :class:`FunctionSystem`, for some order of the states."""

    formulas = enclose = None  # nobody knows what it does, nor how long that takes
    live, effort, work = 16, math.inf, math.inf

    def __init__(
        self, function: Callable[..., Any], states: tuple[str, ...], parameters: dict[str, float]
    ) -> None:
        self.function, self.states, self.parameters = function, states, parameters

    def __call__(self, values: Mapping[str, Any], guard: Guard | None = None) -> tuple[Floats, ...]:
        """Return the images as new arrays, each of the shape of the arguments it depends on."""
        if guard is not None:
            guard()
        return tuple(np.array(image, dtype=np.float64) for image in self._returned(values))

    def _returned(self, values: Mapping[str, Any]) -> list[Any]:
        """Return the images as the function made them, each an array of the right shape."""
        given = {name: np.array(value, dtype=np.float64) for name, value in values.items()}
        shape = np.broadcast_shapes(*(array.shape for array in given.values()))
        for array in given.values():
            array.setflags(write=False)
        try:
            with np.errstate(all="ignore"):
                images = self.function(**given, **self.parameters)
            restore_rounding("the function")
        except BadInput:
            raise
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise BadInput(
                f"the function writes to its arguments ({error}); write to a copy, x = x.copy()",
                WHERE,
            ) from error
        return [
            _image(name, image, shape)
            for name, image in zip(self.states, self._ordered(images), strict=True)
        ]

    def _ordered(self, images: Any) -> list[Any]:
        """Return the images in the order of the states."""
        needed = (
            f"return a mapping with the keys {', '.join(self.states)}, or a sequence of as many"
        )
        if isinstance(images, Mapping):
            if set(images) != set(self.states):
                raise BadInput(f"the function returned {shown(list(images))}; {needed}", WHERE)
            return [images[name] for name in self.states]
        try:
            ordered = list(images)
        except TypeError:
            raise BadInput(f"the function returned {shown(images)}; {needed}", WHERE) from None
        if len(ordered) != len(self.states):
            count = f"{len(ordered)} images for {len(self.states)} states"
            raise BadInput(f"the function returned {count}; {needed}", WHERE)
        return ordered

    def audit(self, values: Mapping[str, Any]) -> "Audit":
        """Return what it answers to some samples; refuse it unless a second try agrees."""
        return Audit(self, values)


class Audit:
    """What a function answered to some samples, to be asked again.

    Raises
    ------
    BadInput
        It returns the same memory again, another answer, or another one to a sample by itself.
    """

    def __init__(self, step: FunctionMap, values: Mapping[str, Any]) -> None:
        self.step = step
        self.values = {name: np.array(value, dtype=np.float64) for name, value in values.items()}
        kept, again = step._returned(self.values), step._returned(self.values)
        self.first = tuple(np.array(image, dtype=np.float64) for image in kept)
        for name, a, b in zip(step.states, kept, again, strict=True):
            if a.size > 1 and np.may_share_memory(a, b):
                raise BadInput(
                    f"the function returned the image of {name} in the same memory twice; "
                    "return a new array at every call",
                    WHERE,
                )
        self._compare(tuple(np.array(image, dtype=np.float64) for image in again))
        self._spread = [_spread(image) for image in self.first]
        self.alone(self.values, self.first, ALONE)

    def again(self) -> None:
        """Ask once more."""
        self._compare(self.step(self.values))

    def _compare(self, images: tuple[Floats, ...]) -> None:
        for name, a, b in zip(self.step.states, self.first, images, strict=True):
            shape = np.broadcast_shapes(a.shape, b.shape)
            a, b = np.broadcast_to(a, shape), np.broadcast_to(b, shape)
            differs = _differ(a, b, REPEATED, _spread(a))
            if differs.any():
                k = tuple(int(i) for i in np.argwhere(differs)[0])
                raise BadInput(
                    f"the function gave {name} = {float(a[k])!r} and later {float(b[k])!r} for "
                    f"{_sample(self.values, k)}; it must answer the same every time: draw no "
                    "random numbers (declare noise instead) and keep nothing between calls",
                    WHERE,
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
                self.step.states, images, self.step(one), self._spread, strict=True
            ):
                among = np.broadcast_to(image, shape)[k]
                if _differ(among, alone.ravel(), APART, spread).any():
                    raise BadInput(
                        f"the function gives {name} = {float(among)!r} for "
                        f"{_sample(values, k)} among others and {float(alone.ravel()[0])!r} for it "
                        "alone; the image of a sample must not depend on other samples, and "
                        "keep nothing between calls",
                        WHERE,
                    )


def _sample(values: Mapping[str, Floats], k: tuple[int, ...]) -> str:
    shape = np.broadcast_shapes(*(array.shape for array in values.values()))
    return ", ".join(
        f"{name} = {float(np.broadcast_to(array, shape)[k])!r}" for name, array in values.items()
    )


def _image(name: str, image: Any, shape: tuple[int, ...]) -> Any:
    """Return an image as an array of real numbers in a shape that fits the arguments."""
    masked = np.ma.getmaskarray(image).sum() if isinstance(image, np.ma.MaskedArray) else 0
    if masked:
        raise BadInput(
            f"the image of {name} is masked in {masked} places; return plain arrays, NaN where "
            "there is no image",
            WHERE,
        )
    try:
        array = np.asarray(image)
    except (TypeError, ValueError):
        raise BadInput(
            f"the image of {name} is {shown(image)}, no array of numbers", WHERE
        ) from None
    if array.dtype.kind not in "fiu":
        raise BadInput(
            f"the image of {name} is of type {array.dtype.name}; real numbers are needed", WHERE
        )
    fits = array.ndim == 0 or (
        array.ndim == len(shape)
        and all(k in (1, n) for k, n in zip(array.shape, shape, strict=True))
    )
    if not fits:
        raise BadInput(
            f"the image of {name} has shape {array.shape}; it must be that of the arguments it "
            f"depends on, which broadcast to {shape}: treat every sample by itself",
            WHERE,
        )
    return array


def _spread(image: Floats) -> float:
    finite = image[np.isfinite(image)]
    return float(finite.max() - finite.min()) if finite.size else 0.0


def _differ(a: Any, b: Any, share: float, spread: float) -> Any:
    """Return where two answers differ by more than a share of the spread, or of themselves."""
    with np.errstate(all="ignore"):
        near = np.abs(a - b) <= share * spread + REPEATED * np.abs(a)
    return ~(near | (a == b) | (np.isnan(a) & np.isnan(b)))
