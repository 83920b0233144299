"""How much ranks ask each other, and along which axis of cuts they would ask less."""

from typing import Any, NamedTuple

from lmdsl.model.lp import StabilizationLP
from lmdsl.slabs.chains.first import First
from lmdsl.slabs.graph import cuts, looking


class Talk(NamedTuple):
    """What becomes part of an answer; see :class:`lmdsl.distributed.answer.Answer`."""

    ghosts: float
    by_axis: dict[str, float] | None
    note: str  # which axis to declare first; empty where that matters little

    @classmethod
    def of(cls, lp: StabilizationLP) -> "Talk":
        """Count the cells of others that ranks know; collective."""
        mesh = First(lp).mesh
        ghosts = sum(mesh.ranks.collect(len(mesh.ghosts))) / max(mesh.division.cells, 1)
        by_axis = looking.ghosts_by_axis(lp)
        return cls(ghosts, by_axis, cuts.sentence(lp.partition, by_axis, mesh.ranks.count))

    def facts(self) -> dict[str, Any]:
        """Return attributes of the answer."""
        return {"ghosts": self.ghosts, "ghosts_by_axis": self.by_axis}
