"""What a system is: states, and a function that maps arrays of states to their images.

Every system answers one question, ``compile(states, controls, noise)``: a :class:`StateMap`.
Formulas and users' own Python functions meet this one contract, so everything downstream
(transitions, simulation, proofs, plots) treats them alike. Every right-hand side sees the old
values.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from pydantic import BeforeValidator, Field

from lmdsl.common.strict_model import Declared, Positive, plain
from lmdsl.common.types import Floats, Guard
from lmdsl.errors import BadInput, shown
from lmdsl.formulas.enclosures import Jet
from lmdsl.formulas.language import Formula, parse
from lmdsl.formulas.names import Formulas, Parameters
from lmdsl.formulas.program import Program
from lmdsl.formulas.tracing import Recorder
from lmdsl.machine.forking import cached_property

Substeps = Annotated[int, Field(strict=True, ge=1, le=1000), BeforeValidator(plain)]


def program(
    formulas: Mapping[str, str],
    order: Sequence[str],
    names: Sequence[str],
    parameters: Mapping[str, float],
    where: str,
) -> Program:
    """Compile the formulas of the states, in the given order, into one program.

    BadInput: a formula is missing, belongs to no state, or cannot be parsed.
    """
    for state in order:
        if state not in formulas:
            raise BadInput(f"no formula for state {state!r}; add one", where)
    for state in formulas:
        if state not in order:
            raise BadInput(
                f"{shown(state)} is not an axis of state_box; remove it or declare the axis", where
            )
    known = frozenset((*names, *parameters))
    parsed = []
    for state in order:
        try:
            parsed.append(parse(formulas[state], known))
        except BadInput as error:
            raise BadInput(error.message, f"{where}.{state}") from None
    return Program(parsed, parameters)


class StateMap(Protocol):
    """x+ = T(x, u, w) on named arrays, as every system compiles to one."""

    def __call__(self, values: Mapping[str, Any], guard: Guard | None = None) -> tuple[Floats, ...]:
        """Return new arrays of images, one per state, each in the shape of what it depends on.

        The arrays given broadcast against each other; ``guard`` is called now and then, and may
        raise.
        """

    @property
    def formulas(self) -> tuple[Formula, ...] | None:
        """The images written out as formulas; None where there are none, or too long ones."""

    @property
    def enclose(self) -> Callable[..., tuple[Jet, ...]] | None:
        """Encloses images and derivatives on boxes (jets by name, guard); None where it cannot."""

    @property
    def live(self) -> int:
        """Largest number of arrays at a time, inputs apart."""

    @property
    def effort(self) -> float:
        """Number of operations of a call, infinite where unknown."""

    @property
    def work(self) -> float:
        """The same with slow functions counted many times, for the time that a sample takes."""


class System(Declared):
    """Base of all systems x+ = T(x, u, w)."""

    parameters: Parameters = Field(default_factory=dict, validate_default=True)

    def constants(self) -> Mapping[str, float]:
        """Return the values of all parameters, defaults included."""
        return self.parameters

    def compile(
        self, states: Sequence[str], controls: Sequence[str], noise: Sequence[str]
    ) -> StateMap:
        """Return the function from named arrays to the images, one array per state in order."""
        raise NotImplementedError


class MapSystem(System):
    """A discrete-time map: one formula per state.

    Attributes
    ----------
    next
        State name to the formula of its next value, in states, controls, noise and parameters.
    """

    kind: Literal["map"] = "map"
    next: Formulas

    def compile(
        self, states: Sequence[str], controls: Sequence[str], noise: Sequence[str]
    ) -> StateMap:
        """See :meth:`System.compile`."""
        return program(
            self.next, states, [*states, *controls, *noise], self.parameters, "system.next"
        )


class OdeSystem(System):
    """An ordinary differential equation, sampled by the classical Runge-Kutta method (RK4).

    Attributes
    ----------
    derivative
        State name to the formula of its time derivative.
    step
        Sampling time: control and noise are held during it. In the units of the derivative.
    substeps
        RK4 steps per sampling time; only the final image is judged.
    """

    kind: Literal["ode"] = "ode"
    derivative: Formulas
    step: Positive
    substeps: Substeps = 1

    def compile(
        self, states: Sequence[str], controls: Sequence[str], noise: Sequence[str]
    ) -> StateMap:
        """See :meth:`System.compile`."""
        field = program(
            self.derivative,
            states,
            [*states, *controls, *noise],
            self.parameters,
            "system.derivative",
        )
        return _RungeKutta(field, tuple(states), self.step, self.substeps)


# Number of operations, or of subformulas times substeps, above which a step is not written out.
MOST_WRITTEN = 1_000


class _RungeKutta:
    """x+ = x + h/6 (k1 + 2 k2 + 2 k3 + k4), repeated; h = step / substeps."""

    def __init__(self, field: Program, states: tuple[str, ...], step: float, substeps: int) -> None:
        self.field, self.states = field, states
        self.substeps, self.h = substeps, step / substeps
        self.live = field.live + 8 * len(states)
        self.effort, self.work = (
            substeps * (4 * each + 14 * len(states)) for each in (field.effort, field.work)
        )

    def __call__(self, values: Mapping[str, Any], guard: Guard | None = None) -> tuple[Floats, ...]:
        start = tuple(np.asarray(values[name], float) for name in self.states)
        field = partial(self.field, guard=guard)
        with np.errstate(all="ignore"):
            images: tuple[Floats, ...] = self._advance(values, start, field)
        return images

    @cached_property
    def formulas(self) -> tuple[Formula, ...] | None:
        """The images written out as formulas, None where these are too long to be of use."""
        nodes = sum(len(formula.subformulas) for formula in self.field.formulas)
        if max(self.effort, self.substeps * nodes) > MOST_WRITTEN:
            return None
        recorder = Recorder()
        start = tuple(recorder.name(name) for name in self.states)

        def slope(values: Mapping[str, Any]) -> tuple[Any, ...]:
            return recorder.replay(
                self.field.formulas, {name: values[name] for name in self.states}
            )

        return tuple(recorder.formula(image) for image in self._advance({}, start, slope))

    def enclose(self, values: Mapping[str, Jet], guard: Guard | None = None) -> tuple[Jet, ...]:
        """Enclose the images and their derivatives on boxes."""
        start = tuple(values[name] for name in self.states)
        with np.errstate(all="ignore"):
            images: tuple[Jet, ...] = self._advance(
                values, start, partial(self.field.enclose, guard=guard)
            )
        return images

    def _advance(self, values: Mapping[str, Any], state: tuple[Any, ...], field: Any) -> Any:
        """Step arrays or jets: the arithmetic is the same."""
        held, h = dict(values), self.h

        def slope(at: Sequence[Any]) -> tuple[Any, ...]:
            held.update(zip(self.states, at, strict=True))
            image: tuple[Any, ...] = field(held)
            return image

        for _ in range(self.substeps):
            k1 = slope(state)
            k2 = slope([x + (h / 2) * k for x, k in zip(state, k1, strict=True)])
            k3 = slope([x + (h / 2) * k for x, k in zip(state, k2, strict=True)])
            k4 = slope([x + h * k for x, k in zip(state, k3, strict=True)])
            state = tuple(
                x + (h / 6) * (a + 2 * b + 2 * c + d)
                for x, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)
            )
        return state
