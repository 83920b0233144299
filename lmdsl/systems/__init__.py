"""Systems: the generic kinds, and one short file per system known by name."""

from __future__ import annotations

from lmdsl.systems.base import FunctionSystem, MapSystem, NamedSystem, OdeSystem, System
from lmdsl.systems.standard_map import StandardMap

NAMED: dict[str, type[NamedSystem]] = {
    str(cls.model_fields["kind"].default): cls for cls in (StandardMap,)
}
"""Every system known by name, by its ``kind``."""

__all__ = [
    "NAMED",
    "FunctionSystem",
    "MapSystem",
    "NamedSystem",
    "OdeSystem",
    "StandardMap",
    "System",
]
