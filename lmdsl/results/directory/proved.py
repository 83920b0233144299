"""The proof of a directory: proof.npz, and what certificate.json says of it."""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import arrays
from lmdsl.common.records import jsonable
from lmdsl.common.types import Guard
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.proof import checking
from lmdsl.proof.record import BOX, Proof, expected
from lmdsl.results.directory import reading, writing
from lmdsl.results.directory.certificate_file import ProofKeys
from lmdsl.results.directory.reading import Reading
from lmdsl.results.proofs import holds, loop_of
from lmdsl.results.result import Result

NAME = "proof.npz"
SHARES = ("arrives", "lost", "stays", "undecided", "steps", "cost", "boxes")


def add(path: str | os.PathLike[str], result: Result, proof: Proof) -> None:
    """Write a proof into the directory of its result; an older proof there is replaced.

    BadInput: the directory holds another result by now, or cannot be written.
    """
    folder = writing.place(path)

    def content(files: Reading) -> tuple[dict[str, Any], dict[str, bytes]]:
        loaded = _policy(files, result)
        if not all(np.array_equal(x, getattr(result, name)) for name, x in loaded.items()):
            raise BadInput("another save replaced the directory; prove it again", "solution.npz")
        names = [n for n in files.digests or ("problem.json", "solution.npz") if n != NAME]
        return files.certificate, {name: files.open(name).read() for name in names}

    certificate, files = reading.read(folder, content)
    files[NAME] = arrays.packed(proof.arrays())
    said = {name: jsonable(getattr(proof, name)) for name in ProofKeys.model_fields}
    about = {**certificate, "proof": said}

    def commit(keys: dict[str, Any]) -> bytes:
        return reading.text({**about, **keys})

    try:
        writing.write(folder, files, commit)
    except OSError as error:
        raise BadInput(f"the proof cannot be written: {error.strerror}", "out") from None


def _policy(files: Reading, result: Result) -> dict[str, NDArray[Any]]:
    N = result.partition.size
    wanted = {"control_index": ((N,), "<i4"), "cell_status": ((N,), "|u1")}
    return arrays.unpacked(files.open("solution.npz"), "solution.npz", wanted)


def read(path: str | os.PathLike[str], result: Result, said: ProofKeys) -> dict[str, NDArray[Any]]:
    """Read the boxes of a proof."""
    shapes = expected(said.boxes, result.partition.dimension)
    memory.require(
        2.0 * (BOX + 5 * result.partition.dimension) * said.boxes, "the boxes of the proof"
    )

    def boxes(files: Reading) -> dict[str, NDArray[Any]]:
        return arrays.unpacked(files.open(NAME, arrays.largest(shapes)), NAME, shapes)

    return reading.read(writing.place(path), boxes)


def proof_differences(
    path: str | os.PathLike[str], result: Result, said: ProofKeys | None, guard: Guard
) -> list[str]:
    """Check the proof of a directory box by box; return what does not hold, one sentence each."""
    if said is None:
        return []
    found = read(path, result, said)
    reasons = checking.faults(loop_of(result), found, guard)
    if reasons:
        return reasons
    cells = int((result.cell_status == 1).sum())
    proof = Proof.of(
        found, cells, seconds=said.seconds, holds=holds(result), target=said.target,
        to_stay=result.problem.attractor.empty,
    )  # fmt: skip
    if said.sha256 != proof.sha256:
        reasons.append("proof.sha256 is not that of the boxes")
    for name in (*SHARES, "holds"):
        ours, theirs = getattr(said, name), getattr(proof, name)
        if ours != theirs:
            reasons.append(f"proof.{name} is stored as {ours!r}, but is {theirs!r}")
    return reasons
