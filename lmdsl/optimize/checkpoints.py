"""Checkpoints: the policy at hand and its V, kept in a folder while a problem is solved.

What must hold: at every moment the folder holds a whole checkpoint, or none; what any number of
ranks kept, any other number can continue; and nothing that is read is trusted: a policy that is
continued is proved anew, so that a spoiled checkpoint costs time and changes no answer.

The arrays have an entry for each cell of the state box, 12 bytes in all. Every checkpoint has files
of its own; checkpoint.json, which is replaced as one, names them.
"""

import contextlib
import hashlib
import json
import logging
import os
import re
import secrets
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import arrays, inputs
from lmdsl.common.files import open_regular, parsed, read_bytes, reason, synced, write_whole
from lmdsl.common.types import Floats
from lmdsl.errors import BadInput, shown
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.ranks.verbs import Alone, Ranks

NAME, FORMAT = "checkpoint.json", "lmdsl-checkpoint/1"
ARRAYS = {"control_index": "<i4", "value": "<f8"}
EVERY = 60.0  # seconds between two checkpoints; more where writing one takes long:
SHARE = 10  # what is spent on it is at most one part in so many

_FILE = re.compile(rf"({'|'.join(ARRAYS)})\.([0-9a-f]{{16}})\.npy")

log = logging.getLogger(__name__)


class Unfinished(NamedTuple):
    """A policy to begin with, and a guess of its V, on the own cells of C, shape (n,) each."""

    control: NDArray[np.int32]  # control index, whatever was read
    value: Floats

    @property
    def positive(self) -> bool:
        """Whether V is what it may be: finite, and no free of cost."""
        return bool((np.isfinite(self.value) & (self.value > 0)).all())


class Checkpoints:
    """The checkpoints of a problem in a folder.

    Attributes
    ----------
    folder
        Where they are.
    problem
        SHA-256 of the problem.
    """

    def __init__(self, folder: Path, problem: Problem) -> None:
        self.folder, self.problem = folder, identity(problem)
        self.due = time.monotonic() + EVERY

    @classmethod
    def of(cls, path: Any, problem: Problem) -> "Checkpoints | None":
        """Return those of a folder, once a file can be made in it; None for no path."""
        if path is None:
            return None
        folder = inputs.path(path, "checkpoint").absolute()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except (OSError, ValueError) as error:
            raise BadInput(
                f"cannot write in {shown(str(path), 200)}: {reason(error)}; give another folder",
                "checkpoint",
            ) from None
        return cls(folder, problem)

    def keep(
        self, lp: StabilizationLP, policy: NDArray[np.int64], V: Floats, last: bool = False
    ) -> None:
        """Keep a policy, once it is time to, or it is the last; collective.

        Where that fails it is said, the checkpoint before stays, and the work goes on.
        """
        ranks: Ranks = Alone() if lp.mesh is None else lp.mesh.ranks
        began = time.monotonic()
        if not ranks.share(last or began >= self.due):
            return
        try:
            self._write(ranks, lp, policy, V)
        except OSError as error:  # on all ranks
            if ranks.rank == 0:
                self._tidy()
                log.warning("no checkpoint was kept in %s: %s", self.folder, reason(error))
        now = time.monotonic()
        self.due = now + max(EVERY, (now - began) * SHARE)

    def _write(
        self, ranks: Ranks, lp: StabilizationLP, policy: NDArray[np.int64], V: Floats
    ) -> None:
        sizes = ranks.collect(len(lp.cell_status))
        N, first = sum(sizes), sum(sizes[: ranks.rank])
        control = np.full(len(lp.cell_status), -1, dtype=np.int32)
        control[lp.cells - first] = lp.control[policy]
        value = np.where(lp.cell_status == CellStatus.ATTRACTOR, 0.0, np.inf)
        value[lp.cells - first] = V
        save, here = ranks.share(secrets.token_hex(8)), ranks.rank == 0
        ranks.agreed(lambda: self._make(save, N) if here else None)
        ranks.agreed(lambda: self._put(save, N, first, {"control_index": control, "value": value}))
        ranks.agreed(lambda: self._commit(save, N, len(lp.controls)) if here else None)

    def _place(self, name: str, save: str) -> Path:
        return self.folder / f"{name}.{save}.npy"

    def _make(self, save: str, N: int) -> None:
        for name, kind in ARRAYS.items():
            head = arrays.header((N,), kind)
            with open(self._place(name, save), "xb") as file:
                file.write(head)
                file.truncate(len(head) + N * np.dtype(kind).itemsize)

    def _put(self, save: str, N: int, first: int, own: Mapping[str, NDArray[Any]]) -> None:
        for name, kind in ARRAYS.items():
            with open(self._place(name, save), "r+b") as file:
                file.seek(len(arrays.header((N,), kind)) + first * np.dtype(kind).itemsize)
                file.write(np.ascontiguousarray(own[name], dtype=kind).data)
                synced(file)

    def _commit(self, save: str, N: int, M: int) -> None:
        from lmdsl import __version__

        about = {"format": FORMAT, "problem": self.problem, "cells": N, "controls": M, "save": save,
                 "versions": {"lmdsl": __version__, "numpy": np.__version__}}  # fmt: skip
        try:
            write_whole(self.folder / NAME, (json.dumps(about, indent=1) + "\n").encode())
        except BadInput as error:
            raise OSError(str(error)) from None
        self._tidy()

    def _tidy(self) -> None:
        """Remove the files of checkpoints that are none, or no longer."""
        with contextlib.suppress(OSError, BadInput):
            known = _about(self.folder).get("save") if (self.folder / NAME).exists() else None
            for name in os.listdir(self.folder):
                found = _FILE.fullmatch(name)
                if found and found[2] != known:
                    os.unlink(self.folder / name)


def identity(problem: Problem) -> str:
    """Return the SHA-256 of what a problem declares, the number of substeps apart.

    That may be found by what compiles it. (Functions and given rows are not in it.)
    """
    declared = problem.model_dump()
    declared["system"].pop("substeps", None)
    return hashlib.sha256(json.dumps(declared, default=lambda _: None).encode()).hexdigest()


def wanted(path: Any, problem: Problem, checkpoint: Any, start: Any = None) -> Path | None:
    """Return the folder to resume from; None where nothing is to be resumed.

    A folder that is that of ``checkpoint`` may hold no checkpoint yet, so that the same command
    begins and continues. BadInput: there is no checkpoint, or one of another problem, or another
    policy to ``start`` with.
    """
    if path is None:
        return None
    if start is not None:
        raise BadInput("not together with start, which is another policy to begin with", "resume")
    folder = inputs.path(path, "resume").absolute()
    if not os.path.lexists(folder / NAME):
        if checkpoint is not None and inputs.path(checkpoint, "checkpoint").absolute() == folder:
            return None
        raise BadInput(
            f"{shown(str(path), 200)} holds no checkpoint; give the folder of --checkpoint, or "
            "leave it out to begin",
            "resume",
        )
    about = _about(folder)
    if about.get("problem") != identity(problem):
        raise BadInput(
            f"the checkpoint in {shown(str(path), 200)} is that of another problem; resume the one "
            "that it was kept for, or give another folder",
            "resume",
        )
    return folder


def unfinished(folder: Path | None, lp: StabilizationLP) -> Unfinished | None:
    """Return what a checkpoint holds for the own cells of C; None where there is none.

    Collective. BadInput: it is not whole, or of other cells.
    """
    if folder is None:
        return None
    ranks: Ranks = Alone() if lp.mesh is None else lp.mesh.ranks
    sizes = ranks.collect(len(lp.cell_status))
    first = sum(sizes[: ranks.rank])
    own = slice(first, first + sizes[ranks.rank])
    found = ranks.agreed(lambda: _read(folder, sum(sizes), len(lp.controls), own))
    mine = lp.cells - first
    return Unfinished(found.control[mine], found.value[mine])


def _read(folder: Path, N: int, M: int, own: slice) -> Unfinished:
    about = _about(folder)
    if (about.get("cells"), about.get("controls")) != (N, M):
        raise BadInput(
            f"the checkpoint in {shown(str(folder), 200)} is of {about.get('cells')!r} cells and "
            f"{about.get('controls')!r} controls, the problem has {N} and {M}; give another folder",
            "resume",
        )
    found = {}
    for name, kind in ARRAYS.items():
        file_name = f"{name}.{about.get('save')}.npy"
        if not _FILE.fullmatch(file_name):
            raise BadInput(f"{NAME} names no file of ours; give another folder", "resume")
        try:
            with open_regular(folder / file_name, links=False) as file:
                found[name] = np.array(arrays.mapped(file, file_name, (N,), kind)[own])
        except OSError as error:
            raise BadInput(f"cannot read {file_name}: {reason(error)}", "resume") from None
        except BadInput as error:
            raise BadInput(f"{error}; give another folder, or begin anew", "resume") from None
    return Unfinished(found["control_index"], found["value"])


def _about(folder: Path) -> dict[str, Any]:
    """Return what checkpoint.json says."""
    try:
        found = parsed(folder / NAME, read_bytes(folder / NAME, links=False))
    except BadInput as error:
        raise BadInput(f"{error}; give another folder, or begin anew", "resume") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise BadInput(
            f"{shown(str(folder / NAME), 200)} is not of the format {FORMAT}; give another folder, "
            "or begin anew",
            "resume",
        )
    return found
