"""Systems x+ = T(x, u, w): the generic kinds, and one short file per system known by name."""

from lmdsl.systems.base import MapSystem as MapSystem
from lmdsl.systems.base import OdeSystem as OdeSystem
from lmdsl.systems.base import System as System
from lmdsl.systems.function import FunctionSystem as FunctionSystem
from lmdsl.systems.matrices.data import DataSystem as DataSystem
from lmdsl.systems.matrices.system import MatrixSystem as MatrixSystem
from lmdsl.systems.named import NamedSystem as NamedSystem
from lmdsl.systems.translated.casadi_systems import from_casadi as from_casadi
from lmdsl.systems.translated.sympy_systems import from_sympy as from_sympy

# A line for each system known by name, in the order in which they are listed.
# isort: off
from lmdsl.systems.standard_map import StandardMap as StandardMap
from lmdsl.systems.logistic_map import LogisticMap as LogisticMap
from lmdsl.systems.henon_map import HenonMap as HenonMap
from lmdsl.systems.double_integrator import DoubleIntegrator as DoubleIntegrator
from lmdsl.systems.inverted_pendulum import InvertedPendulum as InvertedPendulum
from lmdsl.systems.pendulum_on_cart import PendulumOnCart as PendulumOnCart
from lmdsl.systems.van_der_pol import VanDerPol as VanDerPol
from lmdsl.systems.lorenz import Lorenz as Lorenz
from lmdsl.systems.cart_pole import CartPole as CartPole
# isort: on

# Every system known by name, by its ``kind``.
NAMED: dict[str, type[NamedSystem]] = {
    str(system.model_fields["kind"].default): system
    for system in list(globals().values())
    if isinstance(system, type) and issubclass(system, NamedSystem) and system is not NamedSystem
}
