"""Claim 7: no run of the map from C is lost, whatever the noise that is covered does.

That is a theorem where, for every pair of the policy, all that the image of the whole cell can meet
lies in C u A, and its way in the box outside avoid (docs/mathematics.md). Of a Python function that
is known under its Lipschitz constants only, so that the claim is no more than assumed.
"""

from lmdsl.certificate.claims import Safe
from lmdsl.common.types import Bools, Guard, Policy
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import sets_of
from lmdsl.model.successors.inclusion import Inclusion
from lmdsl.systems import FunctionSystem
from lmdsl.systems.named import NotStored


def unproved(lp: StabilizationLP, policy: Policy | None, guard: Guard | None = None) -> int | None:
    """Return of how many cells the claim is not proved; None where it is not made.

    The work ends with the first ones: there may be more. What rests on a function that was not
    saved is not found out.
    """
    if policy is None or lp.problem.successors != "enclosed":
        return None
    try:
        return int((~kept(lp, policy, guard)).sum())
    except NotStored:
        return 0


def claim(lp: StabilizationLP, unsafe: int | None) -> Safe:
    """Return what is claimed where so many cells are not safe."""
    if unsafe == 0 and isinstance(lp.problem.system, FunctionSystem):
        return "assumed"
    return None if unsafe is None else not unsafe


def sentence(cells: int, unsafe: int) -> str:
    """Return why a policy is not safe."""
    return (
        f"from {unsafe} of {cells} cells it is not proved that all that the image of the cell can "
        "meet lies in C or the attractor"
    )


def kept(lp: StabilizationLP, policy: Policy, guard: Guard | None = None) -> Bools:
    """Return from which cells all that a policy can meet is proved to lie in C u A, shape (n,)."""
    sets = sets_of(lp.cell_status)
    allowed = sets.attractor.copy()
    allowed[lp.cells] = True
    return Inclusion(lp.problem, lp.partition, sets, allowed)(lp.cells, lp.control[policy], guard)
