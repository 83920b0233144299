"""Systems x+ = T(x, u, w): the generic kinds, and one short file per system known by name."""

from __future__ import annotations

from lmdsl.systems.base import MapSystem, OdeSystem, System
from lmdsl.systems.double_integrator import DoubleIntegrator
from lmdsl.systems.function import FunctionSystem
from lmdsl.systems.henon_map import HenonMap
from lmdsl.systems.inverted_pendulum import InvertedPendulum
from lmdsl.systems.logistic_map import LogisticMap
from lmdsl.systems.lorenz import Lorenz
from lmdsl.systems.named import NamedSystem
from lmdsl.systems.pendulum_on_cart import PendulumOnCart
from lmdsl.systems.standard_map import StandardMap
from lmdsl.systems.van_der_pol import VanDerPol

NAMED: dict[str, type[NamedSystem]] = {
    str(cls.model_fields["kind"].default): cls
    for cls in (
        StandardMap,
        LogisticMap,
        HenonMap,
        DoubleIntegrator,
        InvertedPendulum,
        PendulumOnCart,
        VanDerPol,
        Lorenz,
    )
}
"""Every system known by name, by its ``kind``."""

__all__ = [
    "NAMED",
    "DoubleIntegrator",
    "FunctionSystem",
    "HenonMap",
    "InvertedPendulum",
    "LogisticMap",
    "Lorenz",
    "MapSystem",
    "NamedSystem",
    "OdeSystem",
    "PendulumOnCart",
    "StandardMap",
    "System",
    "VanDerPol",
]
