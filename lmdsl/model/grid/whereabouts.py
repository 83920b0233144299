"""Where what does not arrive sits: the fewest cells that hold half of it."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lmdsl.common.records import Frozen
from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.model.grid.boxes import Area
from lmdsl.model.grid.partition import Partition

HALF = 0.5
MOST = 5  # regions that are named


@dataclass(frozen=True, eq=False)
class Whereabouts(Frozen):
    """The cells that hold most of some volume.

    Attributes
    ----------
    area
        The fewest cells that hold half of it.
    share
        What they hold of it, a half at least.
    """

    area: Area
    share: float

    @classmethod
    def of(
        cls, partition: Partition, cell: Indices, volume: Floats, some: Bools
    ) -> "Whereabouts | None":
        """Return where the volume of some boxes sits, whose cells are given; None if nowhere."""
        cells, at = np.unique(cell[some], return_inverse=True)
        if not len(cells):
            return None
        held = np.bincount(at, weights=volume[some])
        order = np.argsort(-held, kind="stable")
        total = np.cumsum(held[order])
        count = int(np.searchsorted(total, HALF * total[-1])) + 1
        area = Area.of(partition, cells[order[:count]], MOST)
        return cls(area, float(total[count - 1] / total[-1]))

    def text(self) -> str:
        """Return it in words."""
        return f"{100 * self.share:.0f} % of it in {len(self.area)} cells: {self.area.text()}"

    __str__ = text

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {"share": self.share, **self.area.to_dict()}
