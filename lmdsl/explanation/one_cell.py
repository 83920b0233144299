"""Why one cell is not stabilizable: what each control does to it, or the set it cannot leave."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lmdsl.common.records import Frozen, jsonable
from lmdsl.common.types import Bools, Indices, Statuses
from lmdsl.explanation.whole_cell import WholeCells
from lmdsl.machine.kernels import kernel
from lmdsl.model.assembly.sampler import Block, Sampler
from lmdsl.model.assembly.transitions import outcome
from lmdsl.model.grid import boxes
from lmdsl.model.grid.boxes import Ends, Region
from lmdsl.model.grid.partition import Partition
from lmdsl.model.rows import Rows
from lmdsl.model.stabilizable_set import CellStatus

# The causes as words: "escapes", "trapped", "leads to these", ...
NAMES = {status: status.name.lower().replace("_", " ") for status in CellStatus}

MOST_CONTROLS = 32  # number of controls above which only some are shown, evenly chosen
MOST_BOXES = 8  # number of boxes above which a trap is shown in part
Named = dict[str, float]


@dataclass(frozen=True, eq=False)
class Move(Frozen):
    """What one control does to a cell that is not stabilizable.

    Attributes
    ----------
    control
        The control, by name.
    kind
        ``leaves`` the box, enters ``avoid``, is ``not finite``, is ``not admissible`` (the
        condition of the problem does not hold), or ``enters`` a cell that is not stabilizable; in a
        finite model also ``missing``, the control is not available, and ``escapes``, the row sums
        to less than 1; of recorded data ``not recorded``, and ``seen to leave`` the box. Where no
        sample is lost but enclosures of the whole cell do not rule it out: ``can leave``,
        ``can enter avoid``, ``can enter`` such a cell, ``not admissible everywhere``.
    state, noise, image
        The first sample that does so, and where it lands, or is judged on the way; noise is empty
        without noise.
    sides
        Of ``leaves``: the sides crossed, as (axis, "low" or "high", how far beyond).
    cell, cause
        Of ``enters``: the cell entered, and why it is not stabilizable.
    share
        The share of the cell's samples that leave, or if none leaves, that enter such cells.
    given
        The rows were given, not sampled.
    meets
        Of what enclosures say: what the image of the whole cell, or its way, can meet, by axis; an
        axis along which it can leave the box, or be undefined, is not among them.
    """

    control: Named
    kind: str
    state: Named
    noise: Named
    image: Named
    share: float
    sides: tuple[tuple[str, str, float], ...] = ()
    cell: int | None = None
    cause: str | None = None
    given: bool = False
    meets: Ends | None = None

    def __str__(self) -> str:
        control = _shown(self.control)
        if self.meets is not None or self.kind == "not admissible everywhere":
            return f"{control or 'it'} loses no sample, but {self._enclosed()}"
        if self.kind == "not admissible":
            at = _shown({**self.state, **self.control})
            return (
                f"{control or 'it'} is not admissible at {100 * self.share:.3g} % of the samples: "
                f"the condition does not hold at {at}"
            )
        start = f"{control} loses" if control else "it loses"
        if self.kind == "missing":
            return f"{control} is not available"
        if self.kind == "not recorded":
            return f"{control or 'what it does'} was not recorded here, or not often enough"
        if self.kind == "seen to leave":
            share = f"{100 * self.share:.3g} % of the recorded transitions"
            return f"{control or 'it'} was seen to leave the box in {share}"
        if self.kind == "escapes":
            return f"{start} {100 * self.share:.3g} %: its row sums to so much less than 1"
        sample = (
            f"{start} {100 * self.share:.3g} %{'' if self.given else ' of the samples'}: "
            f"{_shown({**self.state, **self.noise})} goes to {_shown(self.image)}"
        )
        if self.kind == "leaves":
            far = " and ".join(
                f"{'above' if end == 'high' else 'below'} the {axis} axis by {by:.3g}"
                for axis, end, by in self.sides
            )
            return f"{sample}, {far}"
        if self.kind == "avoid":
            return f"{sample}, in avoid"
        if self.kind == "not finite":
            return f"{sample}, which is not finite"
        return f"{sample}, in a cell that is lost ({self.cause})"

    def _enclosed(self) -> str:
        """Return why enclosures drop the control."""
        if self.kind == "not admissible everywhere":
            return "the condition is not shown to hold on the whole cell"
        assert self.meets is not None
        if self.kind == "can leave":
            out = ", ".join(axis for axis, _, _ in self.sides)
            return f"its enclosure leaves the box along {out}, or may be undefined there"
        where = f"its enclosure meets {boxes.shown(self.meets)}"
        if self.kind == "can enter avoid":
            return f"{where}, and so avoid"
        return f"{where}, and so a cell that is lost ({self.cause})"

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data."""
        sides = [{"axis": axis, "end": end, "beyond": by} for axis, end, by in self.sides]
        found: dict[str, Any] = jsonable({**vars(self), "sides": sides})
        return found


@dataclass(frozen=True, eq=False)
class Why(Frozen):
    """The cause of one cell and the facts behind it.

    Attributes
    ----------
    cell, index, box
        The cell: number, index on every axis, ends on every axis.
    cause
        ``escapes``, ``trapped``, ``leads to these``; or ``stabilized``, ``attractor``, ``avoid``.
    moves
        Of ``escapes`` and ``leads to these``: what the controls do, at most 32, evenly chosen.
    controls
        Number of controls.
    trap
        Of ``trapped``: the cells that can be reached through admissible pairs, as boxes.
    trap_cells, trap_lost
        How many these are, and how many of them have no admissible control.
    """

    cell: int
    index: tuple[int, ...]
    box: Ends
    cause: str
    controls: int
    moves: tuple[Move, ...] = ()
    trap: tuple[Region, ...] = ()
    trap_cells: int = 0
    trap_lost: int = 0

    @property
    def first(self) -> str:
        """The first blocking fact, one sentence; of several controls, the one that loses least."""
        if self.moves:
            return str(min(self.moves, key=lambda m: (m.share, sum(by for *_, by in m.sides))))
        if self.trap_cells:
            where = "; ".join(str(region) for region in self.trap[:2])
            more = "; and more" if self.trap_cells > sum(r.cells for r in self.trap[:2]) else ""
            lost = f", {self.trap_lost} without admissible control" if self.trap_lost else ""
            return (
                f"it can reach {_count(self.trap_cells, 'cell')} and never the attractor{lost}: "
                f"{where}{more}"
            )
        return {"stabilized": "it is stabilizable"}.get(self.cause, f"it is {self.cause}")

    def text(self) -> str:
        """Return all facts, a line each."""
        own = f"cell {list(self.index)}, " * (not isinstance(self.box, boxes.ByNumber))
        lines = [f"{own}{boxes.shown(self.box)}: {self.cause}"]
        lines += [f"  {move}" for move in self.moves] or [f"  {self.first}"]
        lines += [f"  trap: {_count(r.cells, 'cell')}, {r}" for r in self.trap]
        if 0 < len(self.moves) < self.controls:
            lines.append(f"  ({self.controls - len(self.moves)} more controls)")
        return "\n".join(lines)

    __str__ = text

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data."""
        found: dict[str, Any] = jsonable(vars(self))
        return {**found, "first": self.first}


def _shown(named: Named) -> str:
    return ", ".join(f"{name} = {value + 0.0:.6g}" for name, value in named.items())


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}{'s' * (n != 1)}"


def moves(
    sampler: Sampler, status: Statuses, cell: int, whole: WholeCells | None = None
) -> tuple[Move, ...]:
    """Return what the controls do to a cell that escapes or leads to lost cells."""
    M = len(sampler.controls)
    picked = np.unique(np.linspace(0, M - 1, min(M, MOST_CONTROLS)).round().astype(int))
    return tuple(_move(sampler, status, cell, int(a), whole) for a in picked)


def _move(
    sampler: Sampler, status: Statuses, cell: int, control: int, whole: WholeCells | None
) -> Move:
    p, nodes = sampler.partition, sampler.nodes
    flat = outcome(sampler, cell, control)
    code = np.where(flat < 0, CellStatus.AVOID, status[flat])
    weight = np.tile(nodes.weights, len(sampler.points))
    weight = weight / weight.sum()
    leaving = code == CellStatus.AVOID
    bad = leaving
    if not leaving.any():
        bad = (code != CellStatus.STABILIZED) & (code != CellStatus.ATTRACTOR)
    block = Block(0, np.array([cell]), (control, control + 1))
    values = sampler.values(block)
    admitted = sampler.admits(values)
    refused = np.zeros(len(flat), dtype=np.bool_)
    if admitted is not None:
        shape = (1, len(sampler.points), len(nodes.weights), 1)
        refused = ~np.broadcast_to(admitted, shape).ravel()
        bad = refused if refused.any() else bad
    named = dict(zip(sampler.problem.controls, map(float, sampler.controls[control]), strict=True))
    if whole is not None and not leaving.any() and not refused.any():
        enclosed = _enclosed(whole, status, cell, control, named, certain=bool(bad.any()))
        if enclosed is not None:
            return enclosed
    s = int(np.argmax(bad))
    point, node = divmod(s, len(nodes.weights))
    image = sampler.places(block)[:, s].tolist()
    problem = sampler.problem
    found: dict[str, Any] = {
        "control": named,
        "state": {name: float(values[name][0, point, 0, 0]) for name in problem.states},
        "noise": {name: float(nodes.values[node, k]) for k, name in enumerate(problem.noises)},
        "image": dict(zip(problem.states, image, strict=True)),
        "share": float(weight[bad].sum()),
    }
    if refused[s]:
        return Move(kind="not admissible", **found)
    if flat[s] >= 0 and leaving.any():
        return Move(kind="avoid", **found)
    if flat[s] >= 0:
        return Move(kind="enters", cell=int(flat[s]), cause=NAMES[CellStatus(code[s])], **found)
    if not np.isfinite(image).all():
        return Move(kind="not finite", **found)
    return Move(kind="leaves", sides=_sides(p, image), **found)


def _enclosed(
    whole: WholeCells, status: Statuses, cell: int, control: int, named: Named, certain: bool
) -> Move | None:
    """Return why enclosures drop a control; None where they do not, or samples are ``certain``."""
    doubt = whole.inadmissible(cell, control) if certain else whole.lost(cell, control, status)
    if doubt is None:
        return None
    cause = None if doubt.cell is None else NAMES[CellStatus(status[doubt.cell])]
    sides = tuple((axis, "", 0.0) for axis in doubt.out)
    return Move(named, doubt.kind, {}, {}, {}, 0.0, sides, doubt.cell, cause, meets=doubt.meets)


def _sides(p: Partition, image: list[float]) -> tuple[tuple[str, str, float], ...]:
    found = []
    for k, x in enumerate(image):
        low, high = float(p.low[k]), float(p.high[k])
        if not p.periodic[k] and not low <= x <= high:
            found.append((p.names[k], *(("low", low - x) if x < low else ("high", x - high))))
    return tuple(found)


def reachable(
    pair_pointer: Indices, rows: Rows, start: int, admissible: Bools | None = None
) -> Bools:
    """Return the free cells that runs from one of them can reach, the start included, (F,).

    It is the smallest set that contains the start and that no admissible pair leaves (but into A).
    """
    seen = np.zeros(rows.columns + 1, dtype=np.bool_)
    allowed = np.ones(rows.count, dtype=np.bool_) if admissible is None else admissible
    _reach(pair_pointer, rows.pointer, rows.target, allowed, start, seen)
    return seen[:-1]


@kernel(allocates=True)
def _reach(pair_pointer, pointer, target, allowed, start, seen):  # type: ignore[no-untyped-def]
    queue = np.empty(len(seen), dtype=np.int64)
    queue[0], end, at = start, 1, 0
    seen[start] = True
    while at < end:
        i = queue[at]
        at += 1
        if i == len(seen) - 1:
            continue
        for k in range(pair_pointer[i], pair_pointer[i + 1]):
            if allowed[k]:
                for e in range(pointer[k], pointer[k + 1]):
                    j = target[e]
                    if not seen[j]:
                        seen[j] = True
                        queue[end] = j
                        end += 1
