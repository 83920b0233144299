"""The hidden folder beside a result directory in which a save makes it.

It is named ``.NAME.xxxxxxxx`` and locked while the save lives, so that the next save can tell what
a killed one left behind: it takes the lock. What it finds is removed; an old result that was moved
there, and not yet replaced, goes back to its place first. Only folders of this name, of this user
and with nothing but result files inside are touched. Without file locks (Windows) none is.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # pragma: no cover
    fcntl = None  # type: ignore[assignment]

NEW, OLD = "new", "old"


@contextmanager
def beside(target: Path) -> Iterator[Path]:
    """Make a locked work folder beside a path, for one save; it is removed when the save ends.

    It stays where it holds the only copy of an old result.
    """
    work, lock = None, None
    try:
        while lock is None:
            # Again, if another save took it for a leftover in the moment before the lock.
            work = Path(tempfile.mkdtemp(prefix=_prefix(target), dir=target.parent))
            lock = _lock(work, wait=True)
            if fcntl is None:  # pragma: no cover
                break
        assert work is not None
        yield work
    finally:
        try:
            if work is not None and (os.path.lexists(target) or not (work / OLD).exists()):
                remove(work)
        finally:
            if lock is not None:
                os.close(lock)


def clear(target: Path, files: Collection[str]) -> None:
    """Remove what killed saves left beside a path, and put back an old result it has lost.

    Parameters
    ----------
    target
        Path of the result directory.
    files
        Names a result directory can hold; a folder with anything else is left alone.
    """
    if fcntl is None:  # pragma: no cover
        return
    name = re.compile(re.escape(_prefix(target)) + "[a-z0-9_]{8}")
    with contextlib.suppress(OSError):
        found = [path for path in target.parent.iterdir() if name.fullmatch(path.name)]
        for work in sorted(found, key=_changed, reverse=True):
            _clear(work, target, files)


def remove(work: Path) -> None:
    """Remove a work folder, the new result first: an old one without it is not put back."""
    shutil.rmtree(work / NEW, ignore_errors=True)
    shutil.rmtree(work, ignore_errors=True)


def _clear(work: Path, target: Path, files: Collection[str]) -> None:
    lock = _lock(work, wait=False)
    if lock is None:
        return  # a save that lives, or no folder
    try:
        if not _ours(work, os.fstat(lock), files):
            return
        # Both are there only between the two renames of a save; the old one is whole then.
        if (work / OLD).exists() and (work / NEW).exists() and not os.path.lexists(target):
            os.rename(work / OLD, target)
        remove(work)
    except OSError:
        pass  # it is only tidying
    finally:
        os.close(lock)


def _prefix(target: Path) -> str:
    name = target.name
    if len(name) > 40:  # file names have a largest length; the digest tells long names apart
        name = f"{name[:31]}-{hashlib.sha256(os.fsencode(name)).hexdigest()[:8]}"
    return f".{name}."


def _changed(path: Path) -> float:
    return path.lstat().st_mtime


def _lock(folder: Path, wait: bool) -> int | None:
    """Lock a folder; None where it is gone, is no folder, or (without waiting) is locked."""
    if fcntl is None:  # pragma: no cover
        return None
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        if os.path.samestat(os.fstat(descriptor), os.lstat(folder)):
            return descriptor
    except OSError:
        pass
    except BaseException:
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None


def _ours(work: Path, status: os.stat_result, files: Collection[str]) -> bool:
    """Return whether a folder holds nothing but what a save of this user puts there."""
    if status.st_uid != os.getuid():
        return False
    for part in work.iterdir():
        if part.name not in (NEW, OLD) or not stat.S_ISDIR(part.lstat().st_mode):
            return False
        for held in part.iterdir():
            if held.name not in files or not stat.S_ISREG(held.lstat().st_mode):
                return False
    return True
