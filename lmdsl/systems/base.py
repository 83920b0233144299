"""What a system is: states, and a function that maps arrays of states to their images.

Every system answers one question, ``compile(names)``: a :class:`StateMap`.
Formulas and users' own Python functions meet this one contract, so everything downstream
(transitions, simulation, proofs, plots) treats them alike. Every right-hand side sees the old
values.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol

from pydantic import BeforeValidator, Discriminator, Field, Tag

from lmdsl.common import spelling
from lmdsl.common.faults import require_all
from lmdsl.common.strict_model import Declared, Positive, plain
from lmdsl.common.types import Floats, Guard
from lmdsl.errors import BadInput, shown
from lmdsl.formulas.enclosures import Jet
from lmdsl.formulas.language import NO_DEFINITIONS, Definitions, Formula, parse
from lmdsl.formulas.names import Formulas, Parameters
from lmdsl.formulas.program import Program
from lmdsl.systems.black_box.steepness import Steepness
from lmdsl.systems.runge_kutta import RungeKutta

Substeps = Annotated[
    Annotated[
        Annotated[int, Field(strict=True, ge=1, le=1000), BeforeValidator(plain)], Tag("<number>")
    ]
    | Annotated[Literal["auto"], Tag("<word>")],
    Discriminator(lambda value: "<word>" if isinstance(value, str) else "<number>"),
]
UNSETTLED = 16  # substeps where as many as it takes are asked for, before these are known
Judged = Literal["path", "endpoint"]
OF_TIME = ("step", "substeps", "judged")
NO_TIME = "a map has no time between its steps; leave it out, or declare an ode"


class Names(NamedTuple):
    """What formulas and functions of a system may name, its parameters apart.

    Attributes
    ----------
    states
        In the order of the axes.
    controls, noise
        What is chosen in a step, and what is drawn.
    definitions
        What ``let`` defines by these; only formulas use it.
    """

    states: tuple[str, ...]
    controls: tuple[str, ...] = ()
    noise: tuple[str, ...] = ()
    definitions: Definitions = NO_DEFINITIONS

    @property
    def valued(self) -> tuple[str, ...]:
        """Names of all that has a value in a step."""
        return (*self.states, *self.controls, *self.noise)


def program(
    formulas: Mapping[str, str], names: Names, parameters: Mapping[str, float], where: str
) -> Program:
    """Compile the formulas of the states, in their order, into one program.

    BadInput: a formula is missing, belongs to no state, or cannot be parsed.
    """
    known, parsed = frozenset((*names.valued, *parameters)), []
    order = names.states

    def parse_one(state: str) -> None:
        if state not in formulas:
            raise BadInput(f"no formula for state {state!r}; add one", where)
        try:
            parsed.append(parse(formulas[state], known, names.definitions))
        except BadInput as error:
            raise BadInput(error.message, f"{where}.{state}") from None

    def refuse(state: str) -> None:
        near = spelling.hint(state, order) or "; remove it or declare the axis"
        raise BadInput(f"{shown(state)} is not an axis of state_box{near}", where)

    others = [state for state in formulas if state not in order]
    require_all(
        [*(partial(refuse, state) for state in others), *(partial(parse_one, x) for x in order)]
    )
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
    """Base of all systems x+ = T(x, u, w); ``scope`` is what certificates of it speak of."""

    scope: ClassVar[str] = (
        "the finite model (cells and sampled transitions), not the map between samples"
    )

    parameters: Parameters = Field(default_factory=dict, validate_default=True)
    assumes: ClassVar[str] = ""  # on what every claim rests beside the finite model, if anything

    def constants(self) -> Mapping[str, float]:
        """Return the values of all parameters, defaults included."""
        return self.parameters

    def compile(self, names: Names) -> StateMap:
        """Return the function from named arrays to the images, one array per state in order."""
        raise NotImplementedError

    def promised(self, states: Sequence[str], noise: Sequence[str]) -> Steepness | None:
        """Return the Lipschitz constants that are promised of a Python function; None: none."""
        return None

    def flow(self, names: Names, integrand: Formula | None = None) -> RungeKutta | None:
        """Return how the differential equation is integrated; None for a map, which has none.

        With an integrand, its integral along the step is the last of what is integrated.
        """
        return None


class MapSystem(System):
    """A discrete-time map: one formula per state.

    Attributes
    ----------
    next
        State name to the formula of its next value, in states, controls, noise and parameters.
    """

    elsewhere: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(OF_TIME, NO_TIME),
        "derivative": "a map has no derivative; write the next states in next, or declare an ode",
    }
    kind: Literal["map"] = "map"
    next: Formulas

    def compile(self, names: Names) -> StateMap:
        """See :meth:`System.compile`."""
        return program(self.next, names, self.parameters, "system.next")


class OdeSystem(System):
    """An ordinary differential equation, sampled by the classical Runge-Kutta method (RK4).

    Attributes
    ----------
    derivative
        State name to the formula of its time derivative.
    step
        Sampling time: control and noise are held during it. In the units of the derivative.
    substeps
        RK4 steps per sampling time; ``auto`` is as many as it takes, settled by compiling.
    judged
        ``path``: entering A, avoid or the outside of the box counts on the way as well.
        ``endpoint``: only where a step ends.
    """

    elsewhere: ClassVar[Mapping[str, str]] = {
        "next": "an ode has no next states; write their derivative, or declare a map"
    }
    kind: Literal["ode"] = "ode"
    derivative: Formulas
    step: Positive
    substeps: Substeps = 1
    judged: Judged = "path"

    def compile(self, names: Names) -> StateMap:
        """See :meth:`System.compile`."""
        return self.flow(names)

    def flow(self, names: Names, integrand: Formula | None = None) -> RungeKutta:
        """See :meth:`System.flow`."""
        field = program(self.derivative, names, self.parameters, "system.derivative")
        if integrand is not None:
            field = Program([*field.formulas, integrand], self.parameters)
        count = UNSETTLED if self.substeps == "auto" else self.substeps
        return RungeKutta(field, names.states, self.step, count)
