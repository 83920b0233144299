"""Which components of a map depend on the same states, controls and noise: a tape for each set.

Components that share all are worked out together. What depends on the angle and the controls only
is so enclosed once for all positions, by a tape that knows nothing of these.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.formulas.compiled.traced import Traced, trace
from lmdsl.formulas.program import Program
from lmdsl.model.successors.compiled.tapes import Maker, Tapes
from lmdsl.model.true_map import TrueMap
from lmdsl.systems.runge_kutta import RungeKutta, rk4

Places = NDArray[np.int64]


class Shared(NamedTuple):
    """What encloses some components.

    Attributes
    ----------
    advance
        Makes a substep. Its outputs are the components that are carried from one to the next, of a
        map the own ones; where a path is judged then of own ones h times the slope, and the way.
    last
        Of the last knot h times the slope; without outputs where no path is judged.
    place, side
        Registers of what is given, and of the directions.
    own
        Which outputs of ``advance`` are the own components.
    sizes
        Numbers of carried components, of directions, of substeps, and of parts of an arc, 0 where
        no path is judged.
    """

    advance: Tapes
    last: Tapes
    place: Places
    side: Places
    own: Places
    sizes: tuple[int, int, int, int]


class Group(NamedTuple):
    """Components that depend on the same.

    Attributes
    ----------
    components
        Which components of the state these are.
    given
        Positions of what they depend on among states, controls and noise.
    shared
        What encloses them.
    """

    components: list[int]
    given: list[int]
    shared: Shared


def groups(true_map: TrueMap, varying: Sequence[str], arc_parts: int) -> list[Group]:
    """Return the groups of components of a map, in order of their first.

    Parameters
    ----------
    true_map
        A map made of formulas.
    varying
        Names of the noise that varies within its parts.
    arc_parts
        Number of parts into which arcs are cut, 0 where no path is judged.
    """
    found: dict[frozenset[str], list[int]] = {}
    depends = _dependencies(true_map)
    for i, names in enumerate(depends):
        found.setdefault(names, []).append(i)
    made = []
    for names, own in found.items():
        given = [k for k, name in enumerate(true_map.names) if name in names]
        carried = [i for i, other in enumerate(depends) if other <= names]
        make = _SharedMaker(true_map, names, own, carried, [w for w in varying if w in names])
        made.append(Group(own, given, make.shared(arc_parts)))
    return made


def _dependencies(true_map: TrueMap) -> list[frozenset[str]]:
    """Return of every component the names that it depends on, over all substeps."""
    states, map_ = true_map.problem.states, true_map.map
    assert isinstance(map_, Program | RungeKutta)
    program = map_ if isinstance(map_, Program) else map_.field
    some = states[:1]  # of what depends on nothing: a tape needs a row
    direct = [frozenset(program.part([slot]).variables or some) for slot in program.outputs]
    if isinstance(map_, Program):
        return direct
    own = [names | {state} for state, names in zip(states, direct, strict=True)]
    while True:
        more = [
            names.union(*(own[k] for k, other in enumerate(states) if other in names))
            for names in own
        ]
        if more == own:
            return own
        own = more


class _SharedMaker:
    """Makes the tapes of a group."""

    def __init__(
        self, true_map: TrueMap, names: frozenset[str], own: list[int], carried: list[int],
        varying: list[str],
    ) -> None:  # fmt: skip
        problem, self.map = true_map.problem, true_map.map
        states, controls, noise = (
            [name for name in kind if name in names]
            for kind in (problem.states, problem.controls, problem.noises)
        )
        self.own, self.carried, self.states = own, carried, states
        once = getattr(self.map, "substeps", 1) == 1
        self.make = Maker(states, (controls, noise), len(states), once, varying, False)
        self.end = Maker(states, (controls, noise), len(states), False, varying, False)
        first = len(states) * (2 + self.make.directions)
        self.place = [*range(len(states)), *range(first, first + len(controls) + len(noise))]
        others = [*controls, *noise]
        self.side = [*range(len(states)), *(first + others.index(name) for name in varying)]

    def shared(self, arc_parts: int) -> Shared:
        """Return what encloses the group."""
        make, last = self.make, self.make.nothing()
        if isinstance(self.map, RungeKutta):
            boxed, centred = (self._substep(n, arc_parts) for n in (make.directions, 0))
            advance = make.made(boxed, centred, len(self.carried))
            if arc_parts:
                last = self.end.made(self._slopes(make.directions), self._slopes(0))
            own = [self.carried.index(i) for i in self.own]
        else:
            assert isinstance(self.map, Program)
            advance = make.program(self.map.part([self.map.outputs[i] for i in self.own]))
            own = [*range(len(self.own))]
        place, side, chosen = (
            np.array(x, dtype=np.int64) for x in (self.place, self.side, own)
        )  # fmt: skip
        sizes = (len(self.states), make.directions, getattr(self.map, "substeps", 1), arc_parts)
        return Shared(advance, last, place, side, chosen, sizes)

    def _field(self, parts: list[int]) -> Program:
        assert isinstance(self.map, RungeKutta)
        return self.map.field.part([self.map.field.outputs[i] for i in parts])

    def _substep(self, directions: int, arc_parts: int) -> list[Traced]:
        assert isinstance(self.map, RungeKutta)
        _, held, parts = self.make.given(directions)
        field, h = self._field(self.carried), self.map.h

        def slope(at: Sequence[Traced]) -> tuple[Traced, ...]:
            held.update(zip(self.states, at, strict=True))
            return trace(field, held)

        (k1, k2, k3, k4), end = next(iter(rk4(slope, tuple(parts), h, 1)))
        found, own = list(end), [self.carried.index(i) for i in self.own if arc_parts]
        found += [h * k1[i] for i in own]
        found += [(h / 6) * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]) for i in own]
        return found

    def _slopes(self, directions: int) -> list[Traced]:
        assert isinstance(self.map, RungeKutta)
        _, named, _ = self.end.given(directions)
        return [self.map.h * k for k in trace(self._field(self.own), named)]
