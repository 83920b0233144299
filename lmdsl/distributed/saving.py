"""A result directory that all ranks write: each its own part of every vector, in place.

What must hold: it holds what one process would save, appears whole or not at all, and an error on
one rank (a full disk, a folder that a rank does not see) is one error of all.
"""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import arrays
from lmdsl.common.files import reason, synced
from lmdsl.distributed.answer import Answer
from lmdsl.errors import BadInput, shown
from lmdsl.ranks.verbs import Item, Ranks
from lmdsl.results.directory import archive, reading, vectors, writing


def require_place(ranks: Ranks, path: str | os.PathLike[str]) -> Path:
    """Refuse a path that cannot become a result directory; return where it is. Collective."""
    first = ranks.rank == 0
    ranks.agreed(lambda: writing.refuse_unless_free(path) if first else None)
    return ranks.agreed(lambda: writing.place(path))


def save(ranks: Ranks, answer: Answer, path: str | os.PathLike[str]) -> None:
    """Write an answer as a directory; an older one at the same place is replaced. Collective.

    BadInput: the place cannot be used, or not all ranks see it.
    """
    target = require_place(ranks, path)
    ranks.agreed(lambda: _require_model(answer))
    begun = _agreed(ranks, path, lambda: writing.Begun(target) if ranks.rank == 0 else None)
    names = {name: f"{name}.npy" for name in answer.arrays()}
    places = ranks.share({n: begun.path(file) for n, file in names.items()} if begun else {})
    try:
        _agreed(ranks, path, lambda: _made(answer, places) if begun else None)
        _agreed(ranks, path, lambda: _written(answer, places, int(answer.starts[ranks.rank])))
        hashes = ranks.collect(_agreed(ranks, path, lambda: _hashes(ranks, places)))
        digests = {
            file: reading.of_blocks(b"".join(own[name] for own in hashes))
            for name, file in names.items()
        }
        _agreed(ranks, path, lambda: _finish(begun, answer, digests) if begun else None)
    except Exception:  # on all ranks
        if begun:
            with contextlib.suppress(OSError):
                begun.abandon()
        raise


def _require_model(answer: Answer) -> None:
    if answer.problem.functions:
        raise BadInput("what Python functions gave is not saved by several ranks", "out")
    if not answer.model_sha256:
        raise BadInput("there is no model to save: " + answer.message, "out")


def _agreed(ranks: Ranks, path: str | os.PathLike[str], work: Callable[[], Item]) -> Item:
    """Return what work returns; an error of the system is said of the place, on every rank."""

    def tried() -> Item:
        try:
            return work()
        except OSError as error:
            text = f"cannot write {shown(str(path), 200)}: {reason(error)}"
            text += f" (rank {ranks.rank})" * (ranks.count > 1)
            raise BadInput(text, "out") from None

    return ranks.agreed(tried)


def _kind(answer: Answer, name: str) -> str:
    return vectors.types(answer.problem)[name]


def _made(answer: Answer, places: dict[str, Path]) -> None:
    """Make the files, as long as they will be."""
    N = answer.partition.size
    for name, place in places.items():
        head = arrays.header((N,), _kind(answer, name))
        with open(place, "xb") as file:
            file.write(head)
            file.truncate(len(head) + N * answer.arrays()[name].itemsize)


def _written(answer: Answer, places: dict[str, Path], first: int) -> None:
    """Write own cells in place, and wait until they are on the disk."""
    N = answer.partition.size
    for name, place in places.items():
        kind = _kind(answer, name)
        own: NDArray = answer.arrays()[name].astype(kind, copy=False)  # type: ignore[type-arg]
        with open(place, "r+b") as file:
            file.seek(len(arrays.header((N,), kind)) + first * own.itemsize)
            file.write(np.ascontiguousarray(own).view(np.uint8).data)
            synced(file)


def _hashes(ranks: Ranks, places: dict[str, Path]) -> dict[str, bytes]:
    """Return the hashes of this rank's share of the blocks of every file, read from the disk."""
    found = {}
    for name, place in places.items():
        with open(place, "rb") as file:
            found[name] = reading.share_of_hashes(file, ranks.rank, ranks.count)
    return found


def _finish(begun: writing.Begun, answer: Answer, digests: dict[str, str]) -> None:
    """Write what is small, and let the directory appear."""
    told = archive.about(answer)
    begun.finish(
        archive.declared_files(answer), digests, lambda keys: reading.text({**told, **keys})
    )
