"""Result directories: written whole or not at all, and read with suspicion.

A directory holds problem.json, certificate.json and solution.npz; for a system written in Python
also model.npz, the compiled rows. Arrays are accepted only with the shape and type the problem
implies, judged from the archive's directory and headers before anything is allocated; pickles are
never loaded.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl import memory, staging
from lmdsl.certificate import CLAIMS, Certificate
from lmdsl.errors import BadInput, shown
from lmdsl.files import read_json
from lmdsl.local_check import LocalCheck
from lmdsl.lp import StabilizationLP
from lmdsl.partition import Partition
from lmdsl.problem import Problem, parse_problem
from lmdsl.result import ARRAYS, EXIT, Report, Result, Seconds, jsonable
from lmdsl.sampling import control_count, control_vectors
from lmdsl.systems import FunctionSystem
from lmdsl.systems.base import NotStored

FORMAT = "lmdsl-result/1"
FILES = ("problem.json", "certificate.json", "solution.npz", "model.npz", "figures.png")
TYPES = {
    "control_index": "<i4",
    "value": "<f8",
    "lower": "<f8",
    "measure": "<f8",
    "cell_status": "|u1",
    "witness": "<f8",
}
MODEL = ("pair_pointer", "control", "pointer", "target", "code", "cost")


def refuse_unless_free(path: str | os.PathLike[str]) -> None:
    """Refuse a path that cannot become a result directory, before work starts.

    Raises
    ------
    BadInput
        The path is a file, its parent is missing or cannot be written, or it is a folder that
        holds anything lmdsl did not write.
    """
    target = Path(path)
    text = shown(str(target), 200)
    try:
        if target.is_symlink() or (target.exists() and not target.is_dir()):
            raise BadInput(f"{text} exists and is no directory; choose another name", "out")
        if target.is_dir():
            held = {entry.name for entry in target.iterdir()}
            if held and ("certificate.json" not in held or held - set(FILES)):
                raise BadInput(
                    f"{text} is not empty and not a result directory; choose another name", "out"
                )
        parent = _existing_parent(target)
        if not os.access(parent, os.W_OK | os.X_OK):
            raise BadInput(
                f"cannot write in {shown(str(parent), 200)}; choose another place", "out"
            )
    except (OSError, ValueError) as error:
        if isinstance(error, BadInput):
            raise
        reason = (getattr(error, "strerror", None) or str(error)).lower()
        raise BadInput(f"cannot use {text}: {reason}", "out") from None


def _existing_parent(target: Path) -> Path:
    parent = target.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir():
        raise BadInput(f"{shown(str(parent), 200)} is not a directory", "out")
    return parent


def save(result: Result, path: str | os.PathLike[str]) -> None:
    """Write a result directory; an older one at the same place is replaced.

    Raises
    ------
    BadInput
        The place cannot be used.
    """
    if result.lp is None and not result.model_sha256:
        raise BadInput("there is no model to save: " + result.message, "out")
    refuse_unless_free(path)
    target = Path(path).absolute()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        staging.clear(target, FILES)
        with staging.beside(target) as work:
            _replace(result, target, work)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise BadInput(f"cannot write {shown(str(path), 200)}: {reason}", "out") from None


def _replace(result: Result, target: Path, work: Path) -> None:
    """Write a result in a work folder, move the old one in and the new one out."""
    new, old = work / staging.NEW, work / staging.OLD
    try:
        new.mkdir()
        _write(result, new)
        with contextlib.suppress(OSError):
            target.rmdir()  # an empty folder
        if target.exists():
            os.rename(target, old)
        os.rename(new, target)
    except BaseException:
        if old.exists() and not target.exists():
            os.rename(old, target)
        raise


def _write(result: Result, folder: Path) -> None:
    problem = result.problem
    if isinstance(problem.system, FunctionSystem):
        data = problem.model_dump(mode="json", exclude_none=True)
        if result.lp is not None:
            _write_synced(folder / "model.npz", _npz(_model_arrays(result.lp)))
    else:
        data = problem.to_dict()
    _write_synced(folder / "problem.json", _text(data))
    arrays = {name: getattr(result, name) for name in (*ARRAYS, "witness")}
    _write_synced(folder / "solution.npz", _npz(arrays))
    _write_synced(folder / "certificate.json", _text(_certificate(result)))


def _text(data: Any) -> bytes:
    text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False)
    return (text + "\n").encode()


def _npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:  # as np.savez, which may pickle before NumPy 2.2
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getbuffer())
    return buffer.getvalue()


def _write_synced(path: Path, content: bytes) -> None:
    with open(path, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _certificate(result: Result) -> dict[str, Any]:
    proof = result.certificate
    return {
        "format": FORMAT,
        **result.stored(),
        "cause": result.cause,
        "claims": {name: getattr(proof, name) for name in (*CLAIMS, "refusal")},
        "measure_residual": jsonable(proof.measure_residual),
        "reasons": list(proof.reasons),
        "iterations": jsonable(result.iterations),
        "gap_before_polish": jsonable(result.gap_before_polish),
        "model_sha256": result.lp.digest if result.lp is not None else result.model_sha256,
        "versions": versions(),
        "scope": "the finite model (cells and sampled transitions), not the map between samples",
    }


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


def load(path: str | os.PathLike[str]) -> Result:
    """Read a result directory without recompiling or checking its claims.

    Raises
    ------
    BadInput
        The directory is unreadable or inconsistent with its problem.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise BadInput(f"{shown(str(folder), 200)} is not a result directory")
    problem = _problem(folder)
    stored = read_certificate(folder)
    partition = Partition.of(problem)
    N = partition.size
    M = min(control_count(problem), 10**40)
    memory.require(64 * N + 8 * M * (2 + len(problem.control_grid)), "arrays of the result")
    expected = {name: ((N,), kind) for name, kind in TYPES.items()}
    arrays = read_arrays(folder / "solution.npz", expected)
    vectors = control_vectors(problem)
    index = arrays["control_index"]
    if index.size and not (index.min() >= -1 and index.max() < len(vectors)):
        raise BadInput("control_index holds an index outside the control grid", "solution.npz")
    if arrays["cell_status"].max(initial=0) > 6:
        raise BadInput("cell_status holds an unknown code", "solution.npz")
    scalars = {
        key: stored[key]
        for key in Report.__dataclass_fields__
        if key in stored and key not in ("seconds", "gamma_bar", "local_controller")
    }
    claims = stored["claims"]
    certificate = Certificate(
        **{name: claims.get(name) is True for name in (*CLAIMS, "refusal")},
        contraction=stored["contraction"],
        cost=stored["cost"],
        lower=stored["lower_bound"],
        gap=stored["gap"],
        measure_residual=stored["measure_residual"],
        tolerance=stored["tolerance"],
        reasons=tuple(stored["reasons"]),
    )
    bracket = stored["gamma_bar"]
    known: dict[str, Any] = {**scalars, **arrays}
    return Result(
        **known,
        gamma_bar=(float(bracket[0]), float(bracket[1])) if bracket else None,
        local_controller=_local(stored.get("local_controller")),
        seconds=Seconds(**stored["seconds"]),
        problem=problem,
        partition=partition,
        certificate=certificate,
        control_vectors=vectors,
        iterations=stored["iterations"],
        gap_before_polish=stored["gap_before_polish"],
        cause=stored["cause"],
        model_sha256=stored["model_sha256"],
    )


def _local(stored: Any) -> LocalCheck | None:
    """Read what a certificate says of the local controller; results before it say nothing."""
    if stored is None:
        return None
    kinds: dict[str, Any] = {"kind": str, "cells": int, "samples": int, "kept": int}
    kinds |= {"multiplier": _NUMBER, "proved": (int, type(None))}
    sound = isinstance(stored, dict) and set(stored) == set(kinds)
    if not sound or not all(
        isinstance(stored[key], kind) and not isinstance(stored[key], bool)
        for key, kind in kinds.items()
    ):
        raise BadInput("not what lmdsl writes", "certificate.json.local_controller")
    if not _finite(stored["multiplier"]):
        raise BadInput("multiplier is out of range", "certificate.json.local_controller")
    return LocalCheck(**stored)


def _problem(folder: Path) -> Problem:
    data = read_json(folder / "problem.json")
    system = data.get("system") if isinstance(data, dict) else None
    if not (isinstance(system, dict) and system.get("kind") == "function"):
        return parse_problem(data)
    # A function cannot be stored: everything but calling it still works.
    stand_in = FunctionSystem(next=_not_stored, parameters=system.get("parameters", {}))
    problem: Problem = Problem.model_validate({**data, "system": stand_in})
    return problem


def _not_stored(**values: Any) -> Any:
    raise NotStored("this result came from a Python function, which a directory does not hold")


_NUMBER = (float, int, type(None))
_SHAPE: dict[str, Any] = {
    "status": str,
    "backend": (str, type(None)),
    "solver_status": (str, type(None)),
    "gamma": _NUMBER,
    "cost": _NUMBER,
    "lower_bound": _NUMBER,
    "gap": _NUMBER,
    "tolerance": (float, int),
    "contraction": _NUMBER,
    "gamma_bar": (list, type(None)),
    "polish_steps": (int, type(None)),
    "message": str,
    "cause": (str, type(None)),
    "claims": dict,
    "measure_residual": (float, int, str, type(None)),
    "reasons": list,
    "iterations": (int, type(None)),
    "gap_before_polish": _NUMBER,
    "model_sha256": str,
    "seconds": dict,
    "cells": int,
    "controls": int,
    "pairs": int,
    "attractor_cells": int,
    "stabilizable_cells": int,
}


def _finite(value: Any) -> bool:
    """Return whether a stored number is unknown or within the range of doubles."""
    if value is None:
        return True
    if not isinstance(value, float | int) or isinstance(value, bool):
        return False
    return abs(value) <= sys.float_info.max


def read_certificate(folder: Path) -> dict[str, Any]:
    """Read certificate.json and check that every key has its type."""
    where = "certificate.json"
    data = read_json(folder / where, null=True)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise BadInput(f"not a certificate of format {FORMAT}", where)
    for key, kinds in _SHAPE.items():
        if key not in data or not isinstance(data[key], kinds) or isinstance(data[key], bool):
            raise BadInput(f"{key} is missing or of the wrong type", where)
    for key, kinds in _SHAPE.items():
        if kinds in (_NUMBER, (float, int)) and not _finite(data[key]):
            raise BadInput(f"{key} is out of range", where)
    if data["tolerance"] < 0:
        raise BadInput("tolerance is negative", where)
    if data["status"] not in EXIT:
        raise BadInput(f"{shown(data['status'])} is not a status", f"{where}.status")
    seconds = data["seconds"]
    fields = set(Seconds.__dataclass_fields__)
    if set(seconds) != fields or not all(_finite(v) for v in seconds.values()):
        raise BadInput("seconds needs compile, solve and verify", where)
    bracket = data["gamma_bar"]
    if bracket is not None and not (
        len(bracket) == 2 and all(x == "inf" or _finite(x) for x in bracket)
    ):
        raise BadInput("gamma_bar is null or [low, high]", where)
    if not all(isinstance(reason, str) for reason in data["reasons"]):
        raise BadInput("reasons are sentences", where)
    return data


def read_arrays(
    path: Path, expected: Mapping[str, tuple[tuple[int, ...], str]]
) -> dict[str, NDArray[Any]]:
    """Read arrays of known shape and type from an .npz file, whatever it claims to hold.

    Raises
    ------
    BadInput
        A member is missing, compressed beyond its size, or not exactly of the expected kind.
    """
    where = path.name
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for name, (shape, kind) in expected.items():
                arrays[name] = _member(archive, name, shape, np.dtype(kind))
    except BadInput as error:
        raise BadInput(error.message, f"{where}.{error.where}") from None
    except KeyError as error:
        raise BadInput(f"array missing: {shown(str(error))}", where) from None
    except Exception as error:  # decompressors and header parsers raise what they like
        if isinstance(error, MemoryError):
            raise
        raise BadInput(f"not a readable archive of arrays: {shown(str(error))}", where) from None
    return arrays


def _member(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], kind: np.dtype[Any]
) -> NDArray[Any]:
    info = archive.getinfo(f"{name}.npy")
    count = int(np.prod(shape, dtype=np.int64))
    size = count * kind.itemsize
    if not size <= info.file_size <= size + 4096:
        raise BadInput(f"holds {info.file_size} bytes where {size} are expected", name)
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        if version != (1, 0):
            raise BadInput(f"array format {version} is not supported", name)
        found, fortran, stored = np.lib.format.read_array_header_1_0(file)
        if found != shape or fortran or stored != kind:
            raise BadInput(f"is {stored} of shape {found}, not {kind} of shape {shape}", name)
        content = file.read(size + 1)
    if len(content) != size:
        raise BadInput(f"ends after {len(content)} of {size} bytes", name)
    return np.frombuffer(content, dtype=kind).copy()
