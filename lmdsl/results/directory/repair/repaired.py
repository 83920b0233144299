"""What a directory says of a repair: dropped.npz, and the key ``proved`` of certificate.json."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.certificate.claims import Certificate, Witness
from lmdsl.common import arrays
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.successors.left_out.dropping import list_sha256
from lmdsl.model.successors.left_out.lossless import Lossless
from lmdsl.proof.record import Proof
from lmdsl.results.directory.certificate_file import ProofKeys
from lmdsl.results.directory.reading import Reading
from lmdsl.results.result import Result
from lmdsl.results.summary import Proved

NAME = "dropped.npz"
Judge = Callable[[StabilizationLP, Witness, float], Certificate]
ROUNDING = 1e-12  # relative, of the declared lower bound


def now(result: Result, proof: Proof | None) -> Proved | None:
    """Return what is said of a repair, with the share that a proof gives."""
    said = result.proved
    if said is None:
        return None
    cells = result.stabilizable_cells or 0
    return replace(said, arrives=None if proof is None else share(proof.arrives, cells, said.cells))


def share(arrives: float, cells: int, first: int) -> float:
    """Return which share of the first C arrives, of the share of C that does."""
    return arrives * cells / max(first, 1)


def contents(result: Result) -> dict[str, bytes]:
    """Return the file of the dropped pairs, where there are any."""
    pairs = result.dropped
    if pairs is None:
        return {}
    lower = result.declared_lower
    return {
        NAME: arrays.packed(
            {
                "cell": pairs[:, 0],
                "control": pairs[:, 1].astype(np.int32),
                "lower": np.zeros(result.partition.size) if lower is None else lower,
            }
        )
    }


def read(files: Reading, said: Proved | None, N: int, controls: int) -> dict[str, NDArray[Any]]:
    """Read the dropped pairs, and the lower bound of the model with them."""
    if said is None or said.dropped == 0:
        return {}
    D = said.dropped
    if not 0 < D <= N * controls or not said.cells > 0:
        raise BadInput(f"{D} pairs and {said.cells} cells are not what lmdsl writes", "proved")
    memory.require(40.0 * D + 16 * N, "the dropped pairs")
    shapes = {"cell": ((D,), "<i8"), "control": ((D,), "<i4"), "lower": ((N,), "<f8")}
    found = arrays.unpacked(files.open(NAME, arrays.largest(shapes)), NAME, shapes)
    pairs = np.stack([found["cell"], found["control"].astype(np.int64)], axis=-1)
    if not ((pairs >= 0) & (pairs < (N, controls))).all():
        raise BadInput("a pair is none of the problem", NAME)
    if len(np.unique(pairs, axis=0)) != D or (np.diff(pairs[:, 0]) < 0).any():
        raise BadInput("the pairs are not in order, each once", NAME)
    return {"dropped": pairs, "declared_lower": found["lower"]}


def differences(
    result: Result,
    proof: ProofKeys | None,
    declared: Callable[[], StabilizationLP],
    lp: StabilizationLP,
    judge: Judge,
    deadline: Deadline,
) -> list[str]:
    """Return where what is said of a repair is not so, one sentence each.

    ``proof`` is what is said of the proof of the directory; ``declared`` compiles the model with
    all pairs.
    """
    said = result.proved
    if said is None:
        return []
    reasons = []
    if said.sha256 != list_sha256(result.dropped):
        reasons.append("dropped.npz is not the list of pairs that were dropped")
    first = lp if result.dropped is None else declared()
    if said.cells != first.n:
        reasons.append(f"proved.cells is stored as {said.cells!r}, but is {first.n!r}")
    arrives = None if proof is None else share(proof.arrives, lp.n, first.n)
    if said.arrives != arrives:
        reasons.append(f"proved.arrives is stored as {said.arrives!r}, but is {arrives!r}")
    return reasons + _lower(result, said, first, judge) + _without_loss(said, first, deadline)


def _lower(result: Result, said: Proved, first: StabilizationLP, judge: Judge) -> list[str]:
    """Check the lower bound of the declared model."""
    W = result.lower if result.declared_lower is None else result.declared_lower
    found = judge(first, Witness(None, W=W[first.cells]), 0.0).lower if first.n else None
    lower = found or 0.0
    if said.lower_bound is None or said.lower_bound <= lower + ROUNDING * abs(lower):
        return []
    return [f"proved.lower_bound is stored as {said.lower_bound!r}, but {lower!r} is proved"]


def _without_loss(said: Proved, first: StabilizationLP, deadline: Deadline) -> list[str]:
    """Check how much of the first C can be kept without a loss at most."""
    if said.without_loss is None or said.without_loss >= 1.0:
        return []
    found = Lossless.of(first, deadline)
    deadline.raise_if_over("looking for what can be kept")
    most = 1.0 if found is None else found.share
    if said.without_loss >= most:
        return []
    return [f"proved.without_loss is stored as {said.without_loss!r}, but {most!r} is proved"]
