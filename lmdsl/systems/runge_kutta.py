"""The classical Runge-Kutta method of order four: an equation becomes a map, its steps a path."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from lmdsl.common.types import Floats, Guard
from lmdsl.formulas.enclosures import Jet
from lmdsl.formulas.language import Formula
from lmdsl.formulas.program import Program
from lmdsl.formulas.tracing import Recorder
from lmdsl.machine.forking import cached_property

MOST_WRITTEN = 1_000
"""Operations, and nodes of the formulas times substeps, up to which a step is written out."""


class Knot(NamedTuple):
    """Where two substeps meet; between knots the path is a cubic Hermite arc.

    Attributes
    ----------
    state
        One array per state and integral, each in the shape of what it depends on. Not wrapped.
    slope
        Their time derivatives times the length of a substep.
    stages
        The derivatives of the integrals at the four stages of the substep that begins here; empty
        at the last knot.
    """

    state: tuple[Floats, ...]
    slope: tuple[Floats, ...]
    stages: tuple[tuple[Floats, ...], ...] = ()


class Substep(NamedTuple):
    """The slopes k1 to k4 of a substep, and where it ends."""

    slopes: tuple[tuple[Any, ...], ...]
    end: tuple[Any, ...]


def rk4(
    slope: Callable[[Sequence[Any]], tuple[Any, ...]], state: Sequence[Any], h: float, count: int
) -> Iterator[Substep]:
    """Yield substeps of arrays, jets or terms: the arithmetic is the same."""
    for _ in range(count):
        k1 = slope(state)
        k2 = slope([x + (h / 2) * k for x, k in zip(state, k1, strict=True)])
        k3 = slope([x + (h / 2) * k for x, k in zip(state, k2, strict=True)])
        k4 = slope([x + h * k for x, k in zip(state, k3, strict=True)])
        state = tuple(
            x + (h / 6) * (a + 2 * b + 2 * c + d)
            for x, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)
        )
        yield Substep((k1, k2, k3, k4), state)


class ArcJets(NamedTuple):
    """A substep on boxes, each a jet by axis: its start, the slopes at its ends, and the way."""

    start: tuple[Jet, ...]
    slope: tuple[Jet, ...]
    last_slope: tuple[Jet, ...]
    rise: tuple[Jet, ...]


class RungeKutta:
    """x+ = x + h/6 (k1 + 2 k2 + 2 k3 + k4), repeated; h = step / substeps.

    Parameters
    ----------
    field
        The derivatives of the states, and after them those of integrals that are 0 at the start.
    states
        Names of the states.
    step, substeps
        Sampling time, and the number of steps into which it is divided.
    """

    def __init__(self, field: Program, states: tuple[str, ...], step: float, substeps: int) -> None:
        self.field, self.states = field, states
        self.substeps, self.h = substeps, step / substeps
        self.integrals = len(field.formulas) - len(states)
        self.live = field.live + 8 * len(field.formulas)
        self.effort, self.work = (
            substeps * (4 * each + 14 * len(field.formulas)) for each in (field.effort, field.work)
        )

    def __call__(self, values: Mapping[str, Any], guard: Guard | None = None) -> tuple[Floats, ...]:
        """See :class:`lmdsl.systems.base.StateMap`."""
        with np.errstate(all="ignore"):
            images: tuple[Floats, ...] = self._last(
                values, self._start(values), partial(self.field, guard=guard)
            )
        return images

    def knots(self, values: Mapping[str, Any], guard: Guard | None = None) -> Iterator[Knot]:
        """Yield the start and the ends of all substeps; the last state is the image."""
        with np.errstate(all="ignore"):
            yield from self._knots(values, self._start(values), partial(self.field, guard=guard))

    @cached_property
    def formulas(self) -> tuple[Formula, ...] | None:
        """The images written out as formulas, None where these are too long to be of use."""
        if self._long:
            return None
        recorder = Recorder()
        start = tuple(recorder.name(name) for name in self.states)
        images = self._last({}, start, self._recorded(recorder))
        return tuple(recorder.formula(image) for image in images)

    @cached_property
    def written(self) -> Program | None:
        """What :meth:`knots` yields as one program: of each knot the state, slope and stages.

        None where it is too long to be of use. What stages have in common is evaluated once.
        """
        if self._long:
            return None
        recorder = Recorder()
        start = (
            *(recorder.name(name) for name in self.states),
            *(recorder.constant(0.0) for _ in range(self.integrals)),
        )
        knots: Iterator[Any] = self._knots({}, start, self._recorded(recorder))
        terms = [x for knot in knots for x in (*knot.state, *knot.slope, *sum(knot.stages, ()))]
        return Program([recorder.formula(term) for term in terms], self.field.constants)

    @property
    def _long(self) -> bool:
        nodes = sum(len(formula.subformulas) for formula in self.field.formulas)
        return max(self.effort, self.substeps * nodes) > MOST_WRITTEN

    def _recorded(self, recorder: Recorder) -> Any:
        """Return the field as a function of terms."""

        def slope(values: Mapping[str, Any]) -> tuple[Any, ...]:
            return recorder.replay(
                self.field.formulas, {name: values[name] for name in self.states}
            )

        return slope

    def enclose(self, values: Mapping[str, Jet], guard: Guard | None = None) -> tuple[Jet, ...]:
        """Enclose the images and their derivatives on boxes."""
        start = tuple(values[name] for name in self.states)
        with np.errstate(all="ignore"):
            images: tuple[Jet, ...] = self._last(
                values, start, partial(self.field.enclose, guard=guard)
            )
        return images

    def arcs(self, values: Mapping[str, Jet], guard: Guard | None = None) -> Iterator[ArcJets]:
        """Enclose the path, substep by substep."""
        start = tuple(values[name] for name in self.states)
        field = partial(self.field.enclose, guard=guard)
        with np.errstate(all="ignore"):
            substeps = list(self._substeps(values, start, field))
            last = field({**values, **dict(zip(self.states, substeps[-1].end, strict=True))})
            slopes = [*(substep.slopes[0] for substep in substeps), last]
            for k, substep in enumerate(substeps):
                a, b = (tuple(self.h * y for y in slope) for slope in slopes[k : k + 2])
                rise = tuple(
                    (self.h / 6) * (p + 2 * q + 2 * r + s)
                    for p, q, r, s in zip(*substep.slopes, strict=True)
                )
                yield ArcJets(start, a, b, rise)
                start = substep.end

    def _start(self, values: Mapping[str, Any]) -> tuple[Floats, ...]:
        start = tuple(np.asarray(values[name], float) for name in self.states)
        return (*start, *(np.zeros(()) for _ in range(self.integrals)))

    def _knots(
        self, values: Mapping[str, Any], state: tuple[Any, ...], field: Any
    ) -> Iterator[Knot]:
        d = len(self.states)
        for slopes, end in self._substeps(values, state, field):
            yield Knot(state, tuple(self.h * k for k in slopes[0]), tuple(k[d:] for k in slopes))
            state = end
        last = field({**values, **dict(zip(self.states, state, strict=False))})
        yield Knot(state, tuple(self.h * k for k in last))

    def _last(self, values: Mapping[str, Any], start: tuple[Any, ...], field: Any) -> Any:
        for substep in self._substeps(values, start, field):
            end = substep.end
        return end

    def _substeps(
        self, values: Mapping[str, Any], state: tuple[Any, ...], field: Any
    ) -> Iterator[Substep]:
        held = dict(values)

        def slope(at: Sequence[Any]) -> tuple[Any, ...]:
            held.update(zip(self.states, at, strict=False))
            image: tuple[Any, ...] = field(held)
            return image

        return rk4(slope, state, self.h, self.substeps)
