"""Programs over ranks of whole problems, beside those of ``rank_programs``."""

import functools
from pathlib import Path

from alike import sampled
from rank_programs import main

import lmdsl as lm
from lmdsl import distributed

EXAMPLES = Path(__file__).parents[2] / "examples"
# At gamma above 1, with noise, ties; not verified, empty, beyond gamma_bar; maps and equations.
DOZEN = (1, 3, 5, 6, 7, 8, 12, 13, 25, "standard_map", "logistic_map", "double_integrator")


@functools.cache
def problem(name):
    """One of the dozen; made before threads ask for it, as filters of warnings are of all."""
    return sampled(name) if isinstance(name, int) else lm.load(EXAMPLES / f"{name}.json")


def solve_dozen(ranks, folder):
    """Solve all of them, each into a directory of its own; return what is said."""
    said = []
    for name in DOZEN:
        found = distributed.solve(problem(name), out=Path(folder) / str(name), ranks=ranks)
        said.append([str(found.status), found.cost, found.model_sha256])
    return said


if __name__ == "__main__":
    main({"solve_dozen": solve_dozen})
