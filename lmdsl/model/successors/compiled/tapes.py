"""The step of a problem as tapes: what encloses its images, its paths and its cost on boxes.

Registers that are given come first: the values of all components (states, then the integral of a
cost rate), their slopes in all directions (the states, and of the noise what varies), their errors,
the controls, the noise.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import BadInput
from lmdsl.formulas.compiled.machine import IntervalTape
from lmdsl.formulas.compiled.tape import ONE, ZERO, Value, Writer
from lmdsl.formulas.compiled.traced import Traced, trace
from lmdsl.formulas.compiled.undefined import Flag, as_number, never_a_number
from lmdsl.formulas.program import Program
from lmdsl.problem.consistency import texts
from lmdsl.problem.problem import Problem
from lmdsl.systems.runge_kutta import RungeKutta, rk4

Registers = NDArray[np.int64]


class Tapes(NamedTuple):
    """A function on boxes: on the box with slopes, and at its centre.

    Attributes
    ----------
    box, centre
        The tapes.
    out
        Registers of ``box``, shape (outputs, 2 + directions): value, error, slopes (-1: no slope).
    middle
        Registers of ``centre``, shape (outputs,).
    into
        Number of components that the tapes leave where they found them, for the next substep.
    """

    box: IntervalTape
    centre: IntervalTape
    out: Registers
    middle: Registers
    into: int


class Step(NamedTuple):
    """The step of a problem.

    Attributes
    ----------
    advance
        Makes a substep; its outputs are the components, and where a path is judged control points
        a + m/3 and a - m/3 of the arcs after and before, by state, and m/3 and the way b - a.
    end
        Of the last knot a - m/3, and m/3.
    cost, terminal
        The stage cost, and the terminal cost in a state; without outputs where there is none.
    nowhere
        1 where the image is certainly no number, and so is all of a path but its start; without
        outputs where it never is.
    substeps
        Number of substeps; 1 for a map.
    path
        Whether the path is judged.
    sizes
        Numbers of states, of components, of controls and of noise variables.
    """

    advance: Tapes
    end: Tapes
    cost: Tapes
    terminal: Tapes
    nowhere: Tapes
    substeps: int
    path: bool
    sizes: tuple[int, int, int, int]


def step(problem: Problem) -> Step:
    """Return the step of a problem as tapes.

    BadInput: a part of it is no formula.
    """
    if problem.functions:
        raise BadInput(
            "a Python function cannot be enclosed; write a formula", problem.functions[0]
        )
    flow = problem.flow()
    advances: Any = problem.step() if flow is None else flow
    if not isinstance(advances, Program | RungeKutta):
        raise BadInput("nothing but its rows is known of the system, so that nothing can be proved "
                       "of what lies between", "system")  # fmt: skip
    stage = None if problem.cost_rate is not None else problem.program(problem.cost())
    names, states = (problem.controls, problem.noises), problem.states
    path = problem.judged == "path"
    if isinstance(advances, Program):
        make = Maker(states, names, len(states), seeded=True)
        advance, end = make.program(advances), make.nothing()
    else:
        make = Maker(states, names, len(states) + advances.integrals, advances.substeps == 1)
        advance, end = make.substep(advances, path), make.nothing()
        if path:
            end = Maker(states, names, make.components, seeded=False).knot(advances)
    plain = Maker(states, names, len(states), seeded=True)
    return Step(
        advance, end, plain.program(stage), plain.program(problem.terminal()),
        plain.nowhere(advances), getattr(advances, "substeps", 1), path,
        (len(states), make.components, len(names[0]), len(names[1])),
    )  # fmt: skip


def admitted(problem: Problem) -> Tapes | None:
    """Return what is 1 where a pair is admissible and 0 where not; None: nothing is known."""
    if problem.admissible is None:
        return None
    try:
        formula = problem.formula(f"where({problem.admissible}, 1, 0)", "admissible", texts.PAIRS)
    except BadInput:  # it is as long as a formula may be
        return None
    names = (problem.controls, problem.noises)
    plain = Maker(problem.states, names, len(problem.states), seeded=True)
    return plain.program(problem.program(formula))


class Maker:
    """Makes tapes of the same registers.

    Parameters
    ----------
    states, names
        Names of the states, and of controls and noise.
    components
        Number of components.
    seeded
        Whether slopes are those at the start, 1 and 0; they are then no registers.
    varying
        Names of noise in whose direction there are slopes.
    units
        As of a :class:`Writer`.
    """

    def __init__(
        self, states: Sequence[str], names: tuple[Sequence[str], ...], components: int,
        seeded: bool, varying: Sequence[str] = (), units: bool = True,
    ) -> None:  # fmt: skip
        self.states, self.names, self.varying = states, (*names[0], *names[1]), varying
        self.components, self.seeded, self.units = components, seeded, units
        self.directions = len(states) + len(varying)

    def given(self, directions: int) -> tuple[Writer, dict[str, Traced], list[Traced]]:
        """Return a writer, the jets by name, and those of the components."""
        n, m = self.directions, self.components
        first = m * (2 + n)
        writer = Writer(first + len(self.names), self.units)
        parts = []
        for i in range(m):
            slope: list[Value | None] = [
                (ONE if i == k else None) if self.seeded else writer.input(m + i * n + k)
                for k in range(directions)
            ]
            error = None if self.seeded else writer.input(m + m * n + i)
            value = ZERO if self.seeded and i >= len(self.states) else writer.input(i)
            parts.append(Traced(writer, value, slope, error if directions else None))
        named = dict(zip(self.states, parts, strict=False))
        for j, name in enumerate(self.names):
            own = len(self.states) + self.varying.index(name) if name in self.varying else -1
            slope = [ONE if k == own else None for k in range(directions)]
            named[name] = Traced(writer, writer.input(first + j), slope, None)
        return writer, named, parts

    def nothing(self) -> Tapes:
        """Return tapes without outputs."""
        return self.made([], [])

    def program(self, program: Program | None) -> Tapes:
        """Return the tapes of formulas; without outputs where there are none."""
        if program is None:
            return self.nothing()
        boxed, centred = (list(trace(program, self.given(n)[1])) for n in (self.directions, 0))
        return self.made(boxed, centred)

    def substep(self, flow: RungeKutta, path: bool) -> Tapes:
        """Return the tapes of a substep of an equation."""
        boxed, centred = (self._substep(flow, path, n) for n in (self.directions, 0))
        return self.made(boxed, centred, self.components)

    def _substep(self, flow: RungeKutta, path: bool, directions: int) -> list[Traced]:
        _, named, parts = self.given(directions)
        held = dict(named)

        def slope(at: Sequence[Traced]) -> tuple[Traced, ...]:
            held.update(zip(self.states, at, strict=False))
            return trace(flow.field, held)

        (k1, k2, k3, k4), end = next(iter(rk4(slope, tuple(parts), flow.h, 1)))
        found, h, d = list(end), flow.h, len(self.states)
        if path:
            thirds = [(h / 3) * k1[i] for i in range(d)]
            found += [parts[i] + thirds[i] for i in range(d)]
            found += [parts[i] - thirds[i] for i in range(d)]
            found += thirds
            found += [(h / 6) * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]) for i in range(d)]
        return found

    def nowhere(self, map_: Program | RungeKutta) -> Tapes:
        """Return the tapes of what is 1 where images are no numbers; of a flow, after a substep."""
        d = len(self.states)
        program = map_ if isinstance(map_, Program) else map_.field.part(map_.field.outputs[:d])

        def found(directions: int) -> list[Traced]:
            writer, held, parts = self.given(directions)
            flags: list[Flag] = []

            def slope(at: Sequence[Traced]) -> tuple[Traced, ...]:
                held.update(zip(self.states, at, strict=True))
                slots: list[Any] = []
                images = trace(program, held, slots)
                flags.extend(never_a_number(program, slots, d, writer))
                return images

            if isinstance(map_, Program):
                slope(parts)
            else:
                next(iter(rk4(slope, tuple(parts), map_.h, 1)))
            jet = as_number(writer, flags, directions)
            return [] if jet is None else [jet]

        return self.made(found(self.directions), found(0))

    def knot(self, flow: RungeKutta) -> Tapes:
        """Return the tapes of the last control point before a knot."""

        def found(directions: int) -> list[Traced]:
            _, named, parts = self.given(directions)
            slopes, d = trace(flow.field, named), len(self.states)
            thirds = [(flow.h / 3) * slopes[i] for i in range(d)]
            return [*(parts[i] - thirds[i] for i in range(d)), *thirds]

        return self.made(found(self.directions), found(0))

    def made(self, boxed: list[Traced], centred: list[Traced], into: int = 0) -> Tapes:
        """Return finished tapes; the first ``into`` outputs go where the components were."""
        n, m = self.directions, self.components
        writer = boxed[0].writer if boxed else Writer(0)
        values: list[Value] = []
        goes: dict[int, Value] = {}
        for i, jet in enumerate(boxed):
            slope = [ZERO if p is None else p for p in jet.slope]
            error = ZERO if jet.error is None else jet.error
            values += [jet.value, error, *slope]
            if i < into:
                goes |= {i: jet.value, m + m * n + i: error}
                goes |= {m + i * n + k: p for k, p in enumerate(slope)}
        box, out = writer.finish(values, goes)
        slopes = [p for jet in boxed for p in (ZERO, ZERO, *jet.slope)]
        out = [-1 if p is None else register for p, register in zip(slopes, out, strict=True)]
        other = centred[0].writer if centred else Writer(0)
        goes = {i: jet.value for i, jet in enumerate(centred[:into])}
        centre, middle = other.finish([jet.value for jet in centred], goes)
        return Tapes(
            box, centre, np.array(out, dtype=np.int64).reshape(-1, 2 + n),
            np.array(middle, dtype=np.int64), into,
        )  # fmt: skip
