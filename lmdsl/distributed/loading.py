"""A result directory read by all ranks: each hashes its share of the files, and maps all of them.

What must hold: what is refused is refused on every rank, with the message of one process. So what
is not as it should be, for any rank, is read again as one process reads it, by rank 0 first.
"""

import contextlib
import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from lmdsl.ranks.verbs import Item, Ranks
from lmdsl.results.directory import archive, reading
from lmdsl.results.directory.archive import Stored
from lmdsl.results.directory.reading import Reading


def read(ranks: Ranks, path: str | os.PathLike[str]) -> Stored:
    """Read a result directory, as :func:`archive.read` does; collective.

    BadInput: on every rank, what that raises.
    """
    if ranks.count > 1:
        with ExitStack() as stack:
            found = _shared(ranks, Path(path), stack)
        if found is not None:
            return found
        ranks.agreed(lambda: archive.read(path) if ranks.rank == 0 else None)
    return ranks.agreed(lambda: archive.read(path))


def version(ranks: Ranks, path: str | os.PathLike[str]) -> int:
    """Return which version of the digest a directory names, 0 for none; collective."""
    known = _tried(lambda: reading.stored(Path(path))) if ranks.rank == 0 else None
    named = (known or {}).get("digest", 1 if known else 0)
    return ranks.share(next((each for each in (1, 2) if each == named), 0))


def _shared(ranks: Ranks, folder: Path, stack: ExitStack) -> Stored | None:
    """Return what a directory holds; None, on every rank, where that is not the same and sound."""
    files = _tried(lambda: Reading(folder, reading.plain(folder / reading.COMMIT), stack))
    seen = ranks.collect(None if files is None else _seen(files))
    if files is None or any(other is None or other != seen[0] for other in seen):
        return None
    hashes = ranks.collect(_tried(lambda: _hashes(files, ranks)))
    whole = {name: b"".join(own[name] for own in hashes if own) for name in files.apart()}
    if not ranks.all(files.confirm(whole)):
        return None
    found = _tried(lambda: archive.of_save(files, (ranks.rank, ranks.count)))
    return found if ranks.all(found is not None) else None


def _seen(files: Reading) -> tuple[Any, ...]:
    """Return what is the same on every rank, if all see the same files."""
    states = [os.fstat(file.fileno()) for file in files.apart().values()]
    return files.certificate, [(about.st_ino, about.st_size, about.st_mtime_ns) for about in states]


def _hashes(files: Reading, ranks: Ranks) -> dict[str, bytes]:
    """Return the hashes of this rank's share of the blocks of every file."""
    return {
        name: reading.share_of_hashes(file, ranks.rank, ranks.count)
        for name, file in files.apart().items()
    }


def _tried(work: Callable[[], Item]) -> Item | None:
    """Return what work returns, None where it raises: it will again, read by one process."""
    with contextlib.suppress(Exception):
        return work()
    return None
