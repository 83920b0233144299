"""Archives of arrays (.npz) and arrays (.npy): written plainly, and read with suspicion.

An array is accepted only with the shape and type that is expected of it, judged from the size of
the file, the archive's directory and the headers before anything is allocated. Pickles are never
loaded.
"""

import io
import zipfile
from collections.abc import Mapping
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import BadInput, shown

# Comment of the archives written here: one that was written anew by others has none.
MARK = b"lmdsl"
Expected = Mapping[str, tuple[tuple[int, ...], str]]

_DIRECTORY = 256 * 2**10  # bytes read of an archive's directory; six arrays need a hundredth
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # others may ask for gigabytes to unpack


def packed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays as an uncompressed .npz archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:  # as np.savez, which may pickle before NumPy 2.2
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getbuffer())
        archive.comment = MARK
    return buffer.getvalue()


def largest(expected: Expected) -> int:
    """Return the largest size in bytes of an archive that can hold what is expected of it."""
    return sum(_size(*kind) + 4096 for kind in expected.values()) + _DIRECTORY


def unpacked(file: BinaryIO, name: str, expected: Expected) -> dict[str, NDArray[Any]]:
    """Read arrays of known shape and type from an .npz file, whatever it claims to hold.

    The file is open, at its start, and no larger than :func:`largest` says; ``name`` is for
    messages; others than the expected arrays are not looked at. BadInput: one is missing,
    compressed beyond its size, or not exactly of the expected kind.
    """
    arrays: dict[str, NDArray[Any]] = {}
    bounded = _Bounded(file)
    try:
        with zipfile.ZipFile(cast(BinaryIO, bounded)) as archive:
            bounded.limit = None
            if len(set(names := archive.namelist())) < len(names):
                raise BadInput("an array stands twice; keep one")
            for key, (shape, kind) in expected.items():
                arrays[key] = _member(archive, key, shape, np.dtype(kind))
    except BadInput as error:
        where = f"{name}.{error.where}" if error.where else name
        raise BadInput(error.message, where) from None
    except KeyError as error:
        raise BadInput(f"array missing: {shown(str(error))}", name) from None
    except Exception as error:  # decompressors and header parsers raise what they like
        if isinstance(error, MemoryError):
            raise
        raise BadInput(f"not a readable archive of arrays: {shown(str(error))}", name) from None
    return arrays


def header(shape: tuple[int, ...], kind: str) -> bytes:
    """Return what a file .npy of an array begins with."""
    written = io.BytesIO()
    about = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(written, about)
    return written.getvalue()


def mapped(file: BinaryIO, name: str, shape: tuple[int, ...], kind: str) -> NDArray[Any]:
    """Return the array of a file .npy, read-only, of which nothing is read before it is needed.

    BadInput: it is not exactly of this shape and type, or its file is not just as long.
    """
    try:
        _require_header(file, name, shape, np.dtype(kind))
        begins, size = file.tell(), file.seek(0, io.SEEK_END)
    except BadInput:
        raise
    except Exception as error:  # header parsers raise what they like
        if isinstance(error, MemoryError):
            raise
        raise BadInput(f"not a readable array: {shown(str(error))}", name) from None
    if size != begins + _size(shape, kind):
        raise BadInput(f"holds {size - begins} bytes where {_size(shape, kind)} are expected", name)
    return np.memmap(file, np.dtype(kind), "r", begins, shape).view(np.ndarray)


class _Bounded:
    """A file of which the archive's directory is read, but no more than a directory needs."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.limit = file, cast(int | None, _DIRECTORY)
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        if self.limit is None:
            return self.file.read(size)
        content = self.file.read(size if 0 <= size <= self.limit else self.limit + 1)
        self.limit -= len(content)
        if self.limit < 0:
            raise BadInput(f"the archive's directory is larger than {_DIRECTORY} bytes")
        return content


def _size(shape: tuple[int, ...], kind: str | np.dtype[Any]) -> int:
    return int(np.prod(shape, dtype=np.int64)) * np.dtype(kind).itemsize


def _member(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], kind: np.dtype[Any]
) -> NDArray[Any]:
    info = archive.getinfo(f"{name}.npy")
    size = _size(shape, kind)
    if not size <= info.file_size <= size + 4096:
        raise BadInput(f"holds {info.file_size} bytes where {size} are expected", name)
    if info.compress_type not in _METHODS:
        raise BadInput(f"compression method {info.compress_type} is not supported", name)
    with archive.open(info) as file:
        _require_header(file, name, shape, kind)
        content = file.read(size + 1)
    if len(content) != size:
        raise BadInput(f"ends after {len(content)} of {size} bytes", name)
    return np.frombuffer(content, dtype=kind).reshape(shape).copy()


def _require_header(file: Any, name: str, shape: tuple[int, ...], kind: np.dtype[Any]) -> None:
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        raise BadInput(f"array format {version} is not supported", name)
    found, fortran, stored = np.lib.format.read_array_header_1_0(file)
    if found != shape or fortran or stored != kind:
        raise BadInput(f"is {stored} of shape {found}, not {kind} of shape {shape}", name)
