"""The proof of a result, and what its directory says of it: proof.npz and certificate.json."""

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import arrays, inputs
from lmdsl.common.records import Unread, jsonable
from lmdsl.common.types import Bools, Guard, Progress
from lmdsl.control.invariance import keeping
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.model.local import holding
from lmdsl.model.local.controller import LocalController
from lmdsl.model.local.holding import HoldingLaw
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.proof import checking
from lmdsl.proof.bounds.flights.checking import checked_above
from lmdsl.proof.bounds.flights.refining import Above
from lmdsl.proof.bounds.optimum.bracket import Optimum
from lmdsl.proof.bounds.optimum.checking import checked
from lmdsl.proof.bounds.optimum.parts import fits
from lmdsl.proof.loop import Loop
from lmdsl.proof.proving import Ending
from lmdsl.proof.proving import prove as proved
from lmdsl.proof.record import BOX, Proof, expected
from lmdsl.proof.warming import warm
from lmdsl.results.directory import reading, vectors, writing
from lmdsl.results.directory.certificate_file import ProofKeys
from lmdsl.results.directory.reading import Reading
from lmdsl.results.directory.repair import repaired
from lmdsl.results.result import Result

NAME = "proof.npz"
SHARES = (
    "arrives",
    "lost",
    "stays",
    "undecided",
    "steps",
    "cost",
    "boxes",
    "optimum",
    "probability",
)


def prove(
    result: Result, target: float, time_limit: float | None, progress: Progress | None = None,
    bracket: bool = False, ending: Ending | None = None,
) -> Proof:  # fmt: skip
    """Prove what becomes of C under the controller of a result; see :meth:`Result.prove`.

    It ends early where ``ending`` says so (proving.py).
    """
    if not (inputs.is_number(target) and 0 < target <= 1):
        raise BadInput(f"{shown(target)} is no share; give a number above 0, at most 1", "target")
    deadline, bracket = Deadline.of(time_limit), inputs.flag(bracket, "bracket")
    if not (result.control_index >= 0).any():
        raise BadInput(
            "there is no controller of which anything could be proved: " + result.message
        )
    held, loop = partial(holds, result), loop_of(result)
    if time_limit is not None:
        warm(loop, bracket, progress)
        deadline = Deadline.of(time_limit)  # begins when the kernels are compiled
    return proved(loop, target, deadline, held, progress, bracket, ending)


def loop_of(result: Result) -> Loop:
    """Return the closed loop of a result."""
    index = result.control_index
    if not _complete(result):
        raise BadInput("control_index has no control for a cell of C", "solution.npz")
    return Loop(
        result.problem, result.partition, result.cell_status,
        result.control_vectors[np.maximum(index, 0)],
    )  # fmt: skip


def _complete(result: Result) -> bool:
    """Return whether every cell of C has a control."""
    return bool((result.control_index[result.cell_status == CellStatus.STABILIZED] >= 0).all())


def holds(result: Result, entered: Bools) -> bool | None:
    """Return whether what enters some attractor cells stays: proved, refuted by a run, or neither.

    It stays where these cells are among those that hold.
    """
    local = result.local_controller
    if local is None:
        return None
    if local.proved == local.cells:
        return True
    if local.proved and entered.any() and not (entered & ~_holding(result)).any():
        return True
    return False if local.kept < local.samples else None


def _holding(result: Result) -> Bools:
    """Return attractor cells that are proved to be kept for ever, shape (N,)."""
    local = result.local_controller
    attractor = np.asarray(result.cell_status == CellStatus.ATTRACTOR)
    problem, partition = result.problem, result.partition
    law: LocalController | HoldingLaw | None = LocalController.of(problem, partition, attractor)
    if law is None:
        index = holding.stored(problem, result.cell_status, result.control_index)
        if index is None:
            return np.zeros_like(attractor)
        if local is not None and local.proved == local.holding:
            return np.asarray(index >= 0)
        law = HoldingLaw.of(problem, partition, index)
    return keeping(problem, law)


def add(path: str | os.PathLike[str], result: Result, proof: Proof) -> None:
    """Write a proof into the directory of its result; an older proof there is replaced.

    BadInput: the directory holds another result by now, or cannot be written.
    """
    folder = writing.place(path)

    def content(files: Reading) -> tuple[dict[str, Any], dict[str, writing.Content]]:
        loaded = vectors.read(files, result.problem, result.partition.size)
        told = ("control_index", "cell_status")
        if not all(np.array_equal(loaded[name], getattr(result, name)) for name in told):
            raise BadInput("another save replaced the directory; prove it again", "solution.npz")
        names = [n for n in files.digests or ("problem.json", "solution.npz") if n != NAME]
        return files.certificate, {name: files.content(name) for name in names}

    certificate, files = reading.read(folder, content)
    files[NAME] = arrays.packed(proof.arrays())
    about = {**certificate, "proof": said_of(proof)}
    if result.proved is not None:
        about["proved"] = jsonable(repaired.now(result, proof))

    def commit(keys: dict[str, Any]) -> bytes:
        return reading.text({**about, **keys})

    try:
        writing.write(folder, files, commit)
    except OSError as error:
        raise BadInput(f"the proof cannot be written: {error.strerror}", "out") from None


def said_of(proof: Proof | None) -> Any:
    """Return what a certificate says of a proof."""
    if proof is None:
        return None
    return {name: jsonable(getattr(proof, name)) for name in ProofKeys.model_fields}


def read(path: str | os.PathLike[str], result: Result, said: ProofKeys) -> dict[str, NDArray[Any]]:
    """Read the boxes of a proof."""
    shapes = expected(said.boxes, result.partition.dimension, said.followed, said.parts,
                      said.probability is not None)  # fmt: skip
    each = BOX + 5 * result.partition.dimension
    more = 24 * (said.followed or 0) + 8 * (said.parts or 0)
    memory.require(2.0 * each * said.boxes + more, "the boxes of the proof")

    def boxes(files: Reading) -> dict[str, NDArray[Any]]:
        held = files.certificate.get("proof")
        if not isinstance(held, dict) or held.get("sha256", "") != said.sha256:
            raise BadInput("another proof replaced it in the directory; load it again", NAME)
        return arrays.unpacked(files.open(NAME, arrays.largest(shapes)), NAME, shapes)

    return reading.read(writing.place(path), boxes)


def as_stored(path: str | os.PathLike[str], result: Result, said: ProofKeys | None) -> Proof | None:
    """Return the proof of a directory, unchecked; None without one.

    BadInput: it cannot be read.
    """
    if said is None:
        return None
    found, loop = read(path, result, said), loop_of(result)
    wrong = checking.malformed(loop, found)
    if wrong:
        raise BadInput(wrong.removeprefix(f"{NAME}: "), NAME)
    above = Above(found["above_split"], found["above"]) if said.followed is not None else None
    bound = None
    if said.parts is not None:
        nonnegative = bool(said.nonnegative)
        bound = Optimum(found["optimum_split"], found["optimum"], nonnegative)
    for split, parts in (x[:2] for x in (above, bound) if x is not None):
        if not fits(loop.partition, split, len(parts)):
            raise BadInput("the bounds do not fit the number of their parts", NAME)
    return Proof.of(
        found, loop, seconds=said.seconds, holds=said.holds, target=said.target, above=above,
        bound=bound, stopped=said.stopped,
    )  # fmt: skip


def attach(folder: Path, result: Result, said: ProofKeys | None) -> None:
    """Let a result that was read from a folder have its proof, once it is asked for."""
    if said is not None:
        later = partial(as_stored, folder.absolute(), result, said)
        vars(result)["proof"] = Unread(later)


def note(said: ProofKeys) -> str:
    """Return one line on a proof that holds."""
    return (
        f"proof of the true map: {100 * said.arrives:.4f} % of C arrives, {100 * said.lost:.4f} % "
        f"is lost, {100 * said.stays:.4f} % stays elsewhere ({said.boxes:,} boxes checked)"
    ) + (
        f"; no control law costs less than {said.optimum[0]:.6g} on average there ({said.parts:,} "
        "parts checked)" if said.optimum is not None else ""
    )  # fmt: skip


def proof_findings(
    path: str | os.PathLike[str], result: Result, said: ProofKeys | None, guard: Guard,
    notes: list[str],
) -> list[str]:  # fmt: skip
    """Check the proof of a directory; return what does not hold, one sentence each.

    A proof that holds is added to the notes.
    """
    if said is None:
        return []
    reasons = _differences(path, result, said, guard)
    notes += [] if reasons else [note(said)]
    return reasons


def _differences(
    path: str | os.PathLike[str], result: Result, said: ProofKeys, guard: Guard
) -> list[str]:
    if not _complete(result):
        return ["the proof is of no controller: control_index lacks a cell of C"]
    found = read(path, result, said)
    loop = loop_of(result)
    bound, above = None, None
    entry = np.zeros(result.partition.size, dtype=np.bool_)
    reasons = checking.faults(loop, found, guard, entry)
    if not reasons and said.followed is not None:
        above, reasons = checked_above(loop, found, guard)
    if not reasons and said.parts is not None:
        bound, reasons = checked(loop, found, guard)
    if reasons:
        return reasons
    proof = Proof.of(
        found,
        loop,
        seconds=said.seconds,
        holds=holds(result, entry),
        target=said.target,
        above=above,
        bound=bound,
    )
    if said.nonnegative is True and proof.nonnegative is not True:
        reasons.append("proof.nonnegative is stored as true, but it is not proved")
    if said.sha256 != proof.sha256:
        reasons.append("proof.sha256 is not that of the boxes")
    for name in (*SHARES, "holds"):
        ours, theirs = getattr(said, name), getattr(proof, name)
        if ours != theirs:
            reasons.append(f"proof.{name} is stored as {ours!r}, but is {theirs!r}")
    return reasons
