"""From which cells of C a policy reaches the attractor."""

from __future__ import annotations

import numpy as np

from lmdsl.common.types import Bools, Pairs
from lmdsl.machine.kernels import ONE, kernel
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import tree


def reaches_attractor(lp: StabilizationLP, policy: Pairs) -> Bools:
    """Return the cells from which the policy can reach A, shape (n,)."""
    reaches = np.zeros(lp.n + 1, dtype=np.bool_)
    reaches[-1] = True
    if not _reach(policy.view(np.uint64), *lp.rows.kernel[:2], reaches, 64):
        level, _ = tree(np.arange(lp.n + 1, dtype=np.int64), lp.rows.take(policy))
        return level >= 0
    return reaches[:-1]


@kernel
def _reach(policy, pointer, target, reaches, sweeps):  # type: ignore[no-untyped-def]
    """Mark cells with a marked successor until nothing changes; False where sweeps run out."""
    n = np.uint64(len(policy))
    for sweep in range(sweeps):
        changed = False
        for t in range(n):
            i = t if sweep % 2 == 0 else n - ONE - t
            if reaches[i]:
                continue
            for e in range(pointer[policy[i]], pointer[policy[i] + ONE]):
                if reaches[target[e]]:
                    reaches[i] = changed = True
                    break
        if not changed:
            return True
    return False
