"""Arrays in files of a folder instead of memory: mapped, so that the system reads what is used.

What must hold: what an array holds does not depend on where it lies; a full disk is an error with a
sentence, never a crash; and nothing is left in the folder, however the process ends. So room is
taken before it is mapped (to write to a page that the disk has no room for would kill the process),
and files have no name from the moment at which they are made: they are gone with their last user.
"""

import mmap
import os
import shutil
import tempfile
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.files import reason
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory

WHERE = "rows_on_disk"  # the argument that errors name
PIECE = 2**24  # bytes that are written at a time


class Disk:
    """A folder for arrays.

    Attributes
    ----------
    path
        The folder; it is made where it does not exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def of(cls, path: Any) -> "Disk | None":
        """Return the folder of a path, once a file can be made in it; None for no path."""
        if path is None:
            return None
        if not isinstance(path, str | os.PathLike) or not os.fspath(path):
            raise BadInput(f"{shown(path)} is not the path of a folder", WHERE)
        found = cls(Path(os.path.abspath(os.fspath(path))))
        try:
            found.path.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise found.refusal(error) from None
        found.file().close()
        return found

    def refusal(self, error: Exception) -> BadInput:
        """Return what is told of a folder that cannot be used."""
        where = shown(str(self.path), 200)
        return BadInput(
            f"cannot write rows to {where}: {reason(error)}; make room, or give another folder",
            WHERE,
        )

    def require(self, count: float) -> None:
        """Refuse work whose rows exceed what is free in the folder, before any of it is done."""
        try:
            free = shutil.disk_usage(self.path).free // memory.processes()
        except OSError as error:
            raise self.refusal(error) from None
        if count > free:
            raise BadInput(
                f"the rows need about {memory.human(count)} on disk and {memory.human(free)} are "
                f"free in {shown(str(self.path), 200)}; give a folder on a larger disk, or use "
                "fewer cells, controls, sample points or noise nodes",
                WHERE,
            )

    def file(self) -> IO[bytes]:
        """Return a new file without a name."""
        try:
            return tempfile.TemporaryFile("w+b", buffering=0, prefix="lmdsl-", dir=self.path)
        except (OSError, ValueError) as error:
            raise self.refusal(error) from None

    def empty(self, count: int, dtype: Any) -> NDArray[Any]:
        """Return an array whose room on the disk is taken."""
        with self.file() as file:
            size = count * np.dtype(dtype).itemsize
            try:
                if size and hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, size)
                else:
                    for at in range(0, size, PIECE):
                        _write(file, memoryview(bytes(min(PIECE, size - at))))
            except OSError as error:
                raise self.refusal(error) from None
            return self.mapped(file, count, dtype)

    def mapped(self, file: IO[bytes], count: int, dtype: Any) -> NDArray[Any]:
        """Return the content of a file that holds so many numbers."""
        if not count:
            return np.empty(0, dtype=dtype)
        try:
            content = _Mapping(file.fileno(), count * np.dtype(dtype).itemsize)
        except OSError as error:  # no addresses are left, say by ulimit -v
            raise MemoryError(f"rows cannot be mapped: {reason(error)}") from None
        content.disk = self
        return np.ndarray((count,), dtype, buffer=content)


class _Mapping(mmap.mmap):
    """The memory that stands for a file, and the folder of it."""

    disk: Disk


class Growing(Protocol):
    """An array that is filled part by part."""

    used: int  # entries so far

    def append(self, part: NDArray[Any]) -> None:
        """Add entries."""

    def array(self) -> NDArray[Any]:
        """Return what was added."""


def growing(disk: Disk | None, dtype: Any, capacity: int) -> Growing:
    """Return an array that grows, in memory or on disk; ``capacity`` is about its last length."""
    return _InMemory(dtype, capacity) if disk is None else _OnDisk(disk, dtype)


class _InMemory:
    """An array that grows by reallocation, so that no second copy of it ever exists.

    Capacity that is never used is never touched: it takes addresses, not memory.
    """

    def __init__(self, dtype: Any, capacity: int) -> None:
        self.data = np.empty(capacity, dtype=dtype)
        self.used = 0

    def append(self, part: NDArray[Any]) -> None:
        end = self.used + len(part)
        if end > len(self.data):
            more = int(1.1 * end) - len(self.data)
            memory.require(more * self.data.itemsize, "rows longer than those of a few cells")
            self.data.resize(int(1.1 * end), refcheck=False)
        self.data[self.used : end] = part
        self.used = end

    def array(self) -> NDArray[Any]:
        self.data.resize(self.used, refcheck=False)
        return self.data


class _OnDisk:
    """An array that grows by writing to its file, which is mapped once it is complete."""

    def __init__(self, disk: Disk, dtype: Any) -> None:
        self.disk, self.dtype = disk, dtype
        self.file, self.used = disk.file(), 0

    def __del__(self) -> None:
        self.file.close()  # of work that was broken off

    def append(self, part: NDArray[Any]) -> None:
        try:
            _write(self.file, np.ascontiguousarray(part, dtype=self.dtype).data.cast("B"))
        except OSError as error:
            raise self.disk.refusal(error) from None
        self.used += len(part)

    def array(self) -> NDArray[Any]:
        with self.file:
            return self.disk.mapped(self.file, self.used, self.dtype)


def _write(file: IO[bytes], content: memoryview) -> None:
    """Write all of it: a call may write a part."""
    while content:
        content = content[file.write(content[:PIECE]) :]


def disk_of(array: NDArray[Any]) -> Disk | None:
    """Return the folder in which an array lies, None where it lies in memory."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return base.disk if isinstance(base, _Mapping) else None


def empty(disk: Disk | None, count: int, dtype: Any) -> NDArray[Any]:
    """Return a new array, in memory or on disk."""
    return np.empty(count, dtype=dtype) if disk is None else disk.empty(count, dtype)


def beside(array: NDArray[Any], count: int, dtype: Any) -> NDArray[Any]:
    """Return a new array, in memory or on the disk, where another one lies."""
    return empty(disk_of(array), count, dtype)


def filled(array: NDArray[Any], value: float) -> NDArray[np.float64]:
    """Return a number for each one of an array, where that lies."""
    found = beside(array, len(array), np.float64)
    found[:] = value
    return found


def taken(array: NDArray[Any], index: NDArray[np.integer] | slice) -> NDArray[Any]:
    """Return entries of an array, where the index lies."""
    if isinstance(index, slice) or disk_of(index) is None:
        found: NDArray[Any] = array[index]
        return found
    found = beside(index, len(index), array.dtype)
    for at in range(0, len(index), PIECE):
        part = slice(at, at + PIECE)
        found[part] = array[index[part]]
    return found
