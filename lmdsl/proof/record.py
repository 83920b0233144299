"""What a proof says: shares of the volume of C, bounds, and the boxes that carry it."""

import hashlib
import math
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.records import Frozen, jsonable
from lmdsl.common.types import Floats
from lmdsl.model.grid.whereabouts import Whereabouts
from lmdsl.proof.bounds.flights.refining import Above
from lmdsl.proof.bounds.optimum.averages import Bracket, mean, means, volumes
from lmdsl.proof.bounds.optimum.bracket import Optimum
from lmdsl.proof.loop import Loop
from lmdsl.proof.search import ARRIVES, LOST, STAYS, UNDECIDED

_WITNESSES = {
    "lost": "runs are lost", "stays": "runs stay elsewhere", "undecided": "it is undecided",
}  # fmt: skip
TARGET = 0.999  # share of the volume that is asked for where nothing else is


ARRAYS: dict[str, tuple[bool, str]] = {  # by axis too, and the kind
    "cell": (False, "<i8"), "split": (True, "|u1"), "place": (True, "<u4"), "class": (False, "|u1"),
    "level": (False, "<i4"), "cost": (False, "<f8"), "lower": (False, "<f8"),
}  # fmt: skip
# Bounds on equal parts of cells: of runs that arrive, and of a bracket.
ABOVE: dict[str, str] = {"above_split": "|u1", "above": "<f4"}
CHANCE: dict[str, str] = {"probability": "<f8"}  # of boxes, with noise
BOUND: dict[str, str] = {"optimum_split": "|u1", "optimum": "<f8"}
BOX = 40  # bytes of a box but for its axes


def expected(
    boxes: int,
    axes: int,
    followed: int | None = None,
    parts: int | None = None,
    chance: bool = False,
) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the shapes and kinds of the arrays of so many boxes, and of the parts of a bound."""
    shapes: dict[str, tuple[tuple[int, ...], str]] = {
        name: ((boxes, axes) if by_axis else (boxes,), kind)
        for name, (by_axis, kind) in ARRAYS.items()
    }
    if chance:
        shapes |= {name: ((boxes,), kind) for name, kind in CHANCE.items()}
    for kinds, count in ((ABOVE, followed), (BOUND, parts)):
        if count is not None:
            sizes = (axes,), (count,)
            shapes |= {n: (size, k) for (n, k), size in zip(kinds.items(), sizes, strict=True)}
    return shapes


@dataclass(frozen=True, eq=False)
class Proof(Frozen):
    """What is proved of the true map under a controller, by volume; see :meth:`Result.prove`.

    Attributes
    ----------
    arrives, lost, stays, undecided
        Shares of the volume of C.
    steps
        Within how many steps all that arrives does; None where nothing does.
    cost
        Bounds of the average true cost over what arrives, by volume; None where nothing does.
    boxes
        Number of boxes.
    seconds
        Time it took.
    holds
        Whether what arrives stays in A: True where it is proved of all attractor cells that it can
        enter, False where a run left A, None where neither is known.
    target
        The share asked for.
    witnesses
        The middle of the largest box that is ``lost``, ``stays`` or is ``undecided``; None
        where there is none. ``closed_loop.path(x, steps, as_compiled=True)`` follows it.
    cell, split, place
        The boxes: part ``place`` of 2^``split`` equal parts of a cell, by axis; (B,) and (B, d).
    kind
        What becomes of each: 0 undecided, 1 arrives, 2 is lost, 3 stays.
    level
        Steps to A, or to the loss; else 0.
    cost_above, cost_below
        Bounds of the cost of a run from there (with noise ``cost_below`` of the mean too); 0
        unless it arrives.
    above
        Upper bounds of the cost of what arrives, on 2^``split`` equal parts of every cell; None
        where parts were not followed. ``cost`` has its means where they are better.
    optimum
        Of a bracket: bounds of the average over what arrives of the least cost that any control law
        has there, by volume; None without one, or where nothing arrives.
    nonnegative
        Whether costs are proved not to be negative, as the lower bound needs it: else it is
        assumed. None without a bracket.
    bound
        The lower bound, on 2^``split`` equal parts of every cell; None without a bracket.
    probability
        With noise a lower bound of the probability to arrive, from a state drawn from C by volume;
        None without noise or attractor.
    chance
        The same from every box, (B,); None likewise.
    where
        Of what is ``lost``, ``stays`` or is ``undecided`` the fewest cells that hold half of it.
    stopped
        Whether the time limit ended it before the target was reached.
    maps
        Its means over what arrives of each cell, and those of ``cost_above``, shape (N,) each; NaN
        where nothing arrives.
    """

    arrives: float
    lost: float
    stays: float
    undecided: float
    steps: int | None
    cost: tuple[float, float] | None
    boxes: int
    seconds: float
    holds: bool | None
    target: float
    witnesses: dict[str, tuple[float, ...] | None]
    cell: NDArray[np.int64]
    split: NDArray[np.uint8]
    place: NDArray[np.uint32]
    kind: NDArray[np.uint8]
    level: NDArray[np.int32]
    cost_above: Floats
    cost_below: Floats
    to_stay: bool = False
    above: Above | None = None
    optimum: tuple[float, float] | None = None
    nonnegative: bool | None = None
    bound: Optimum | None = None
    maps: tuple[Floats, Floats] | None = None
    probability: float | None = None
    chance: Floats | None = None
    where: dict[str, Whereabouts | None] = field(default_factory=dict)
    stopped: bool = False

    @classmethod
    def of(
        cls, arrays: dict[str, NDArray[Any]], loop: Loop, *, seconds: float, holds: bool | None,
        target: float, above: Above | None = None, bound: Optimum | None = None,
        stopped: bool = False,
    ) -> Self:  # fmt: skip
        """Return the proof that boxes are."""
        kind, volume = arrays["class"], volumes(arrays["split"])

        def share(state: int) -> float:
            return math.fsum(volume[kind == state]) / max(loop.cells, 1)

        def middle(state: int) -> tuple[float, ...] | None:
            largest = int(np.argmax(np.where(kind == state, volume, -1.0))) if len(kind) else 0
            if not len(kind) or kind[largest] != state:
                return None
            (index,) = np.stack(loop.partition.multi_index(arrays["cell"][[largest]]), axis=-1)
            part = (arrays["place"][largest] + 0.5) / 2.0 ** arrays["split"][largest]
            x = loop.partition.low + (index + part) * loop.partition.width
            return tuple(x.tolist())

        arriving = kind == ARRIVES
        boxes = {name: array[arriving] for name, array in arrays.items() if name in ARRAYS}
        dear, weight, cost, steps = boxes["cost"], volume[arriving], None, None
        if above is not None:
            dear = np.minimum(dear, means(above.split, above.bound, loop.partition, boxes))
        if arriving.any():
            cost = mean(boxes["lower"], weight), mean(dear, weight)
            steps = int(boxes["level"].max())
        bracket = Bracket.of(boxes, dear, loop, bound) if bound is not None else Bracket()
        witnesses = {"lost": middle(LOST), "stays": middle(STAYS), "undecided": middle(UNDECIDED)}
        return cls(
            share(ARRIVES), share(LOST), share(STAYS), share(UNDECIDED), steps, cost, len(kind),
            seconds, holds, target, witnesses, arrays["cell"], arrays["split"], arrays["place"],
            kind, arrays["level"], arrays["cost"], arrays["lower"], loop.to_stay,
            above, *bracket, *_likely(arrays.get("probability"), volume, loop.cells),
            {
                name: Whereabouts.of(loop.partition, arrays["cell"], volume, kind == state)
                for name, state in (("lost", LOST), ("stays", STAYS), ("undecided", UNDECIDED))
            }, stopped and share(STAYS if loop.to_stay else ARRIVES) < target,
        )  # fmt: skip

    @property
    def reached(self) -> bool:
        """Whether the target is reached: by what arrives, or stays where there is no attractor."""
        return (self.stays if self.to_stay else self.arrives) >= self.target

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of proof.npz."""
        found: tuple[NDArray[Any], ...] = (
            self.cell, self.split, self.place, self.kind, self.level, self.cost_above,
            self.cost_below,
        )  # fmt: skip
        kinds = {name: kind for name, (_, kind) in ARRAYS.items()}
        if self.chance is not None:
            kinds |= CHANCE
            found += (self.chance,)
        if self.above is not None:
            kinds |= ABOVE
            found += self.above
        if self.bound is not None:
            kinds |= BOUND
            found += (self.bound.split, self.bound.bound)
        return {
            name: np.ascontiguousarray(array, dtype=kind)
            for (name, kind), array in zip(kinds.items(), found, strict=True)
        }

    @property
    def followed(self) -> int | None:
        """Number of parts that were followed; None where none was."""
        return None if self.above is None else len(self.above.bound)

    @property
    def parts(self) -> int | None:
        """Number of parts on which the lower bound is; None without one."""
        return None if self.bound is None else len(self.bound.bound)

    @property
    def sha256(self) -> str:
        """SHA-256 of the arrays."""
        found = hashlib.sha256()
        for array in self.arrays().values():
            found.update(array.tobytes())
        return found.hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        names = ("arrives", "lost", "stays", "undecided", "steps", "cost", "boxes", "seconds",
                 "holds", "witnesses", "followed", "optimum", "nonnegative", "parts",
                 "probability", "where", "stopped")  # fmt: skip
        return {name: jsonable(getattr(self, name)) for name in names}

    def text(self) -> str:
        """Return what is proved for people."""
        lost, stays = f"{_percent(self.lost)} to be lost", f"{_percent(self.stays)} to stay"
        what = f"to arrive, {lost}, {stays} elsewhere" if not self.to_stay else f"to stay, {lost}"
        share = self.stays if self.to_stay else self.arrives
        lines = [
            f"of the volume that is controlled {_percent(share)} is proved {what}; "
            f"{_percent(self.undecided)} is undecided"
        ]
        if self.cost is not None:
            low, high = self.cost
            lines.append(
                f"  what arrives does so in at most {self.steps} steps; its average cost lies "
                f"between {low:.6g} and {high:.6g}"
            )
        if self.probability is not None:
            lines.append(
                f"  with its noise a run from there arrives with a probability of at least "
                f"{self.probability:.6g}"
            )
        if self.optimum is not None:
            low, high = self.optimum
            assumed = "" if self.nonnegative else ", if no cost is negative, which is assumed"
            lines.append(
                f"  what any control law costs there is at least {low:.6g} on average, and need "
                f"not be more than {high:.6g}{assumed}"
            )
        lines += [
            f"  {words}, for example from ({', '.join(f'{x:.9g}' for x in found)})"
            + (f"; {self.where[name]}" if self.where.get(name) else "")
            for name, words in _WITNESSES.items()
            if (found := self.witnesses[name]) is not None
            and not (name == "stays" and self.to_stay)
        ]
        held = {True: "proved", False: "refuted by a run", None: "not proved"}[self.holds]
        if not self.to_stay:
            lines.append(f"  that what arrives stays in the attractor is {held}")
        lines.append(f"  {self.boxes:,} boxes, {self.seconds:.1f} s; target {self.target:.6g} is "
                     f"{'reached' if self.reached else 'not reached'}")  # fmt: skip
        if self.stopped:
            lines.append("  stopped by the time limit; a longer one decides more")
        return "\n".join(lines)

    __str__ = text


def _likely(
    chance: Floats | None, volume: Floats, cells: int
) -> tuple[float | None, Floats | None]:
    """Return the mean probability over C, and that of boxes."""
    if chance is None:
        return None, None
    return math.fsum(chance * volume) / max(cells, 1), chance


def _percent(share: float) -> str:
    return f"{100 * share:.4f} %"
