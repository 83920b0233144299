"""A linear program solved by SciPy's HiGHS: all that a process of its own has to import."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

TIGHT = 1e-9  # violation of a constraint or of dual feasibility above which HiGHS goes on


def solved(
    price: NDArray[np.float64], matrix: Any, b: NDArray[np.float64], seconds: float | None
) -> tuple[Any, Any, str]:
    """Return x and the multipliers of an LP, and what HiGHS says where there are none."""
    from scipy.optimize import linprog

    options = {"primal_feasibility_tolerance": TIGHT, "dual_feasibility_tolerance": TIGHT}
    if seconds is not None:
        options["time_limit"] = seconds
    solver: Any = linprog
    found = solver(price, A_eq=matrix, b_eq=b, method="highs-ipm", options=options)
    if found.status != 0 or found.x is None:
        return None, None, str(found.message)
    return found.x, found.eqlin.marginals, ""
