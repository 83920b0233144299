"""Results as directories: what each file says, written and read.

A directory holds problem.json, certificate.json and solution.npz; for a system or a stage cost
written in Python also model.npz, the compiled rows, and for a finite model its matrices. Arrays are
accepted only with the shape and type the problem implies.
"""

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.certificate.claims import Certificate
from lmdsl.certificate.judge import CLAIMS
from lmdsl.common import arrays
from lmdsl.common.files import reason
from lmdsl.common.records import jsonable
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory
from lmdsl.model.discretization import control_count, control_vectors
from lmdsl.model.grid.partition import Partition
from lmdsl.model.lp import StabilizationLP
from lmdsl.problem.problem import Problem
from lmdsl.ranks.verbs import Alone
from lmdsl.results.directory import proved, reading, vectors, writing
from lmdsl.results.directory.certificate_file import CertificateFile, scope
from lmdsl.results.directory.declared import own_problem
from lmdsl.results.directory.reading import FORMAT, Reading
from lmdsl.results.directory.repair import repaired
from lmdsl.results.directory.vectors import TYPES as TYPES
from lmdsl.results.directory.vectors import types
from lmdsl.results.result import Result
from lmdsl.slabs.digest import of_model
from lmdsl.systems import MatrixSystem


def save(result: Result, path: str | os.PathLike[str]) -> None:
    """Write a result directory; an older one at the same place is replaced.

    BadInput: the place cannot be used, or the result does not hold what a directory needs.
    """
    if result.lp is None and not result.model_sha256:
        raise BadInput("there is no model to save: " + result.message, "out")
    writing.refuse_unless_free(path)
    contents = _contents(result)
    told = about(result)
    try:
        writing.write(writing.place(path), contents, lambda keys: reading.text({**told, **keys}))
    except OSError as error:
        text = shown(str(path), 200)
        raise BadInput(f"cannot write {text}: {reason(error)}", "out") from None


def rescue(result: Result, path: str | os.PathLike[str]) -> Path | None:
    """Write a result that could not be saved at its place to another: return where, if any."""
    name = Path(path).name or "out"
    for home in (tempfile.gettempdir, os.getcwd, Path.home):
        with contextlib.suppress(OSError, RuntimeError, MemoryError, BadInput):
            place = Path(tempfile.mkdtemp(prefix="lmdsl-", dir=home()))
            try:
                save(result, place / name)
            except BaseException:
                place.rmdir()
                raise
            return place / name
    return None


def _contents(result: Result) -> dict[str, bytes]:
    """Return the files of a result but its certificate."""
    contents = declared_files(result)
    contents[vectors.ARCHIVE] = arrays.packed(
        {name: getattr(result, name) for name in types(result.problem)}
    )
    if result.proof is not None:
        contents[proved.NAME] = arrays.packed(result.proof.arrays())
    return contents | repaired.contents(result)


def declared_files(result: Any) -> dict[str, bytes]:
    """Return the files that say what was solved."""
    problem, contents = result.problem, {}
    if problem.functions:
        data = _function_problem(problem)
        if result.lp is None:
            raise BadInput(
                "this result of a Python function was read from a directory, which holds its "
                "compiled rows; copy that directory"
            )
        contents["model.npz"] = arrays.packed(_model_arrays(result.lp))
    elif isinstance(problem.system, MatrixSystem):
        rows = problem.system.rows
        data = _function_problem(problem)
        data["system"]["sizes"] = rows.sizes()
        contents["model.npz"] = arrays.packed(rows.arrays())
    else:
        data = problem.to_dict()
    contents["problem.json"] = reading.text(data)
    return contents


def about(result: Any) -> dict[str, Any]:
    """Return what certificate.json says of a result, but for the files beside it."""
    proof, known = result.certificate, (result.model_sha256, result.digest)
    if result.lp is not None and result.digest == 1:
        known = identity(result.lp), 1
    apart = {
        "format": FORMAT,
        "beyond_gamma": result.beyond_gamma,
        "claims": proof.claims,
        "measure_residual": proof.measure_residual,
        "reasons": proof.reasons,
        "model_sha256": known[0],
        "digest": known[1],
        "versions": versions(),
        "scope": scope(result.problem),
        "proof": proved.said_of(result.proof),
        "proved": repaired.now(result, result.proof),
    }
    return {
        key: jsonable(apart[key] if key in apart else getattr(result, key))
        for key in CertificateFile.model_fields
    }


def identity(lp: StabilizationLP, version: int = 1) -> str:
    """Return the digest that a certificate names: that of the compiled model.

    Version 2 is that of a model over ranks. The rows of a Python function cannot be made anew from
    another problem: its digest is also of all that the problem says, but the name.
    """
    if version == 2:
        return of_model(Alone(), lp)
    if not lp.problem.functions:
        return lp.digest
    said = {**_function_problem(lp.problem), "name": "", "model_sha256": lp.digest}
    return hashlib.sha256(reading.text(said)).hexdigest()


def names(result: Result, lp: StabilizationLP) -> bool:
    """Return whether a result that was read names the digest of a model; see :func:`identity`."""
    if result.digest == 1 and result.model_sha256 == lp.digest:  # earlier it was always this one
        return True
    return result.model_sha256 == identity(lp, result.digest)


def _function_problem(problem: Problem) -> dict[str, Any]:
    """Return what JSON can say of the problem of a Python function, or of matrices."""
    data: dict[str, Any] = problem.model_dump(mode="json", exclude_none=True)
    return data


def versions() -> dict[str, str]:
    """Return the versions that made a result."""
    import platform
    from importlib.metadata import version

    names = ("numpy", "scipy", "numba", "pydantic")
    from lmdsl import __version__

    return {
        "lmdsl": __version__,
        "python": platform.python_version(),
        **{name: version(name) for name in names},
    }


def _model_arrays(lp: StabilizationLP) -> dict[str, NDArray[Any]]:
    rows = lp.rows
    return {
        "pair_pointer": lp.pair_pointer,
        "control": lp.control,
        "pointer": rows.pointer,
        "target": rows.target,
        "code": rows.code.astype(np.uint32),
        "cost": lp.cost,
    }


# Reading ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stored:
    """What a directory holds."""

    result: Result  # the result, none of its claims checked
    certificate: CertificateFile  # content of certificate.json
    rewritten: tuple[str, ...]  # files that are not as they were saved, and are no other save's


def load(path: str | os.PathLike[str]) -> Result:
    """Read a result directory without recompiling or checking its claims.

    BadInput: it is unreadable, inconsistent with its problem, or its files are of several saves.
    """
    return read(path).result


def read(path: str | os.PathLike[str]) -> Stored:
    """Read a result directory, as :func:`load`, with what else it says."""
    return reading.read(Path(path), of_save)


def problem_of(path: str | os.PathLike[str]) -> Problem:
    """Read the problem of a result directory, a finite model with its rows.

    BadInput: it is unreadable, or its files are of several saves.
    """
    return reading.read(Path(path), own_problem)


def read_model(
    path: str | os.PathLike[str], result: Result, expected: Mapping[str, Any]
) -> dict[str, NDArray[Any]]:
    """Read arrays of model.npz, of the save that a result was read from."""

    def model(files: Reading) -> dict[str, NDArray[Any]]:
        if files.certificate.get("model_sha256") != result.model_sha256:
            raise BadInput("another save replaced the directory; start again", "model.npz")
        return files.arrays("model.npz", expected)

    return reading.read(Path(path), model)


def of_save(files: Reading, share: tuple[int, int] = (0, 1)) -> Stored:
    """Return what a save holds; controls and statuses are looked at in one of so many shares.

    BadInput: it is unreadable, or inconsistent with its problem.
    """
    problem = own_problem(files)
    stored = CertificateFile.read(files.certificate)
    partition = Partition.of(problem)
    N = partition.size
    M = min(control_count(problem), 10**40)
    memory.require(8 * M * (2 + len(problem.control_grid)), "arrays of the result")
    loaded = vectors.read(files, problem, N) | repaired.read(files, stored.proved, N, M)
    result = _result(problem, partition, stored, loaded, share)
    proved.attach(files.folder, result, stored.proof)
    return Stored(result, stored, tuple(files.rewritten))


def _result(
    problem: Problem,
    partition: Partition,
    stored: CertificateFile,
    loaded: dict[str, NDArray[Any]],
    share: tuple[int, int],
) -> Result:
    controls, (rank, count) = control_vectors(problem), share
    part = slice(*(partition.size * k // count for k in (rank, rank + 1)))
    codes = loaded["control_index"][part], loaded["cell_status"][part]
    vectors.require_codes(*codes, len(controls))
    said = dict(stored) | loaded
    del said["proof"]  # its keys; the boxes stay in their file
    known: dict[str, Any] = {f.name: said[f.name] for f in fields(Result) if f.name in said}
    proof: dict[str, Any] = {f.name: getattr(stored, f.name, None) for f in fields(Certificate)}
    proof |= {claim.name: bool(stored.claims.get(claim.name)) for claim in CLAIMS}
    proof["safe"] = stored.claims.get("safe")
    proof |= {"lower": stored.lower_bound, "assumes": problem.system.assumes}
    certificate = Certificate(**proof)
    return Result(
        **known, problem=problem, partition=partition, certificate=certificate,
        control_vectors=controls,
    )  # fmt: skip
