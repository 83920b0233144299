"""The finite model in the explicit format (DRN) of the probabilistic model checker Storm.

State i < n is the i-th cell of C, state n the attractor. The value of a state is the least expected
``cost`` until ``attractor`` is reached: ``R{"cost"}min=? [F "attractor"]``. With a discount state
n + 1 is where runs end by it, and the value that of ``R{"cost"}min=? [F "attractor" | "ended"]``.
"""

import os
from collections.abc import Iterator
from fractions import Fraction

from lmdsl.common import inputs
from lmdsl.common.files import write_whole
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.lp import StabilizationLP
from lmdsl.results.directory.writing import refuse_own_file
from lmdsl.results.exports.markov import exact_row, last_states, require_model
from lmdsl.results.result import Result


@own_arithmetic
def export_drn(lp: StabilizationLP, path: str | os.PathLike[str]) -> None:
    """Write the finite model as a Markov decision process for Storm; only for gamma = 1.

    Parameters
    ----------
    lp
        The finite model; its gamma must be 1.
    path
        The file to write; it appears whole or not at all.

    Notes
    -----
    Probabilities and costs are exact fractions. The reward model is ``cost``; the labels are
    ``attractor`` and, on the cells where m > 0, ``init``; with a discount also ``ended``. An action
    is named by the index of its control.

    Raises
    ------
    BadInput
        Gamma is not 1, C is empty, no cell of C has m > 0, or the file cannot be written.
    """
    require_model(lp)
    refuse_own_file(inputs.path(path))
    write_whole(inputs.path(path), _lines(lp))


def write(result: Result, lp: StabilizationLP, path: str) -> None:
    """Write the model of a result for ``lmdsl export``."""
    export_drn(lp, path)


def _lines(lp: StabilizationLP) -> Iterator[bytes]:
    last = last_states(lp)
    where = "".join(f"; state {j}: the {name}" for j, name in last.items())
    yield (
        "// written by lmdsl\n"
        f"// model {lp.digest}\n{_assumed(lp)}"
        f"// states 0 to {lp.n - 1}: the stabilizable cells{where}\n"
        "@type: MDP\n@parameters\n\n@reward_models\ncost\n"
        f"@nr_states\n{lp.n + len(last)}\n@nr_choices\n{lp.K + len(last)}\n@model\n"
    ).encode()
    for i in range(lp.n):
        text = [f"state {i} [0]{' init' if lp.weight[i] > 0 else ''}\n"]
        for k in range(lp.pair_pointer[i], lp.pair_pointer[i + 1]):
            text.append(f"\taction {lp.control[k]} [{Fraction(float(lp.cost[k]))}]\n")
            text += [f"\t\t{j} : {share}\n" for j, share in exact_row(lp, k)]
        yield "".join(text).encode()
    for j, name in last.items():
        yield f"state {j} [0] {name}\n\taction stay [0]\n\t\t{j} : 1\n".encode()


def _assumed(lp: StabilizationLP) -> str:
    assumes = lp.problem.system.assumes
    return f"// assumed: {assumes}\n" if assumes else ""
