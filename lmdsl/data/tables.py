"""Tables of recorded transitions in files: CSV, NPZ and Parquet, read with suspicion.

A file is data and nothing else: pickles are never loaded, and sizes are judged from what the file
says of itself before anything is unpacked.
"""

import io
import warnings
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import inputs
from lmdsl.common.files import open_regular, reason
from lmdsl.common.optional import installed
from lmdsl.common.types import Floats
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory

NEXT = "_next"
"""What the name of a column ends in that holds a state that followed."""
MOST_COLUMNS = 1_000
MOST_HEADER = 100_000  # bytes of the first line of a CSV file
MOST_BYTES = 2**36
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def read_data(path: Any) -> dict[str, Floats]:
    """Read a table of recorded transitions.

    Parameters
    ----------
    path
        ``.csv`` (names in the first line, commas), ``.npz`` (an array of shape (T,) for each
        column) or ``.parquet`` (needs the extra ``data``).

    Returns
    -------
    dict
        Column name to its numbers, shape (T,) each.

    Raises
    ------
    BadInput
        It cannot be read, or holds no table of numbers.
    """
    path = inputs.path(path)
    readers = {".csv": _csv, ".npz": _npz, ".parquet": _parquet}
    reader = readers.get(path.suffix.lower())
    name = shown(str(path), 200)
    if reader is None:
        raise BadInput(f"{name} ends in none of {', '.join(readers)}; rename or convert it", "x")
    try:
        with open_regular(path) as file:
            size = file.seek(0, io.SEEK_END)
            file.seek(0)
            if size > MOST_BYTES:
                raise BadInput(f"it holds {size} bytes; at most {MOST_BYTES}")
            memory.require(3.0 * size, "a table")
            columns = reader(file)
    except BadInput as error:
        raise BadInput(f"{name}: {error.message}", "x") from None
    except OSError as error:
        raise BadInput(f"cannot read {name}: {reason(error)}", "x") from None
    return _columns(columns, name)


def _columns(columns: dict[str, NDArray[Any]], name: str) -> dict[str, Floats]:
    """Return columns of equal length as doubles."""
    lengths = {key: column.shape for key, column in columns.items()}
    for key, column in columns.items():
        if column.ndim != 1 or column.dtype.kind not in "fiu":
            raise BadInput(
                f"{name}: column {shown(key)} is {column.dtype.name} of shape {column.shape}; "
                "columns are numbers of shape (T,)",
                "x",
            )
    if len(set(lengths.values())) > 1:
        said = ", ".join(f"{shown(key)} {shape[0]}" for key, shape in list(lengths.items())[:8])
        raise BadInput(f"{name}: the columns have different lengths: {said}", "x")
    return {key: column.astype(np.float64) for key, column in columns.items()}


def _csv(file: BinaryIO) -> dict[str, NDArray[Any]]:
    first = file.readline(MOST_HEADER + 1)
    if len(first) > MOST_HEADER:
        raise BadInput(f"its first line is longer than {MOST_HEADER} bytes; it holds the names")
    try:
        names = [part.strip().strip('"') for part in first.decode("utf-8-sig").split(",")]
    except UnicodeDecodeError:
        raise BadInput("its first line is no UTF-8 text; it holds the names") from None
    _few(len(names))
    if not all(names) or len(set(names)) < len(names):
        raise BadInput("names in its first line are empty or stand twice; name every column once")
    if len(names) == 1 and any(separator in names[0] for separator in ";\t"):
        raise BadInput("its columns are not separated by commas; write x,u,x_next and 0.5,0,0.1")
    if any(_is_number(name) for name in names):
        raise BadInput("its first line holds numbers; write the names of the columns there")
    text = io.TextIOWrapper(file, encoding="utf-8", errors="strict")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without transitions
            table = np.loadtxt(text, delimiter=",", ndmin=2, comments=None)
    except UnicodeDecodeError:
        raise BadInput("it is no UTF-8 text") from None
    except ValueError as error:
        raise BadInput(f"counted from the line after the names: {_said(error)}") from None
    finally:
        text.detach()
    if table.size == 0:
        table = np.empty((0, len(names)))
    if table.shape[1] != len(names):
        raise BadInput(f"{len(names)} names for {table.shape[1]} columns")
    return dict(zip(names, table.T, strict=True))


def _said(error: Exception) -> str:
    """Return what NumPy says of a line, on one line."""
    return shown(" ".join(str(error).split()), 200)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _few(count: int) -> None:
    if count > MOST_COLUMNS:
        raise BadInput(f"it has {count} columns; at most {MOST_COLUMNS}")


def _npz(file: BinaryIO) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            _few(len(members))
            memory.require(3.0 * sum(info.file_size for info in members), "the arrays of a file")
            columns = {
                Path(info.filename).name.removesuffix(".npy"): _member(archive, info)
                for info in members
            }
    except (BadInput, MemoryError):
        raise
    except Exception as error:  # decompressors and header parsers raise what they like
        raise BadInput(f"not a readable archive of arrays: {_said(error)}") from None
    if len(columns) < len(members):
        raise BadInput("an array stands twice; keep one")
    return columns


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """Read one array; no more is unpacked than the archive's directory says."""
    if info.compress_type not in METHODS:
        raise BadInput(f"compression method {info.compress_type} is not supported")
    with archive.open(info) as member:
        content = member.read(info.file_size + 1)
    if len(content) != info.file_size:
        raise BadInput(f"{shown(info.filename)} holds other than {info.file_size} bytes")
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise BadInput(f"array format {version} is not supported")
    shape, _, kind = np.lib.format.read_array_header_1_0(stream)
    body = content[stream.tell() :]
    if kind.kind not in "fiu" or len(shape) != 1 or len(body) != shape[0] * kind.itemsize:
        raise BadInput(f"{shown(info.filename)} is no array of numbers of shape (T,)")
    return np.frombuffer(body, dtype=kind)


def _parquet(file: BinaryIO) -> dict[str, NDArray[Any]]:
    try:
        from pyarrow import parquet
    except ImportError:
        raise BadInput(
            f"Parquet needs pyarrow: {installed('data')}; or convert it to CSV"
        ) from None
    try:
        found = parquet.ParquetFile(file)
        about = found.metadata
        _few(about.num_columns)
        memory.require(24.0 * about.num_rows * about.num_columns, "the columns of a file")
        table = found.read()
        return {
            name: table.column(name).to_numpy(zero_copy_only=False) for name in table.column_names
        }
    except (BadInput, MemoryError):
        raise
    except Exception as error:  # its parser raises what it likes
        raise BadInput(f"not a readable table: {_said(error)}") from None
