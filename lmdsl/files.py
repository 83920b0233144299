"""Files: bounded reading of strict JSON, and writing that happens whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lmdsl.errors import BadInput, shown

MAX_FILE_BYTES = 16 * 2**20
MAX_NESTING = 32
MAX_ITEMS = 1_000_000


def write_whole(path: Path, content: bytes | Iterable[bytes]) -> None:
    """Write a file so that it appears whole or not at all; a long one piece by piece.

    Raises
    ------
    BadInput
        The path cannot be written.
    """
    name = path.parent / f".{path.name[:40]}.{secrets.token_hex(4)}"
    try:
        handle = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            with os.fdopen(handle, "wb") as file:
                file.writelines([content] if isinstance(content, bytes) else content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(name, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(name)
            raise
    except (OSError, ValueError) as error:
        reason = (getattr(error, "strerror", None) or str(error)).lower()
        raise BadInput(f"cannot write {shown(str(path), 200)}: {reason}") from None


class _Fault:
    """Stands in the parsed data for something JSON or the format does not allow."""

    def __init__(self, message: str) -> None:
        self.message = message


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """Read a regular file of at most ``limit`` bytes; BadInput says why it cannot be read."""
    try:
        with open(path, "rb", opener=_open_regular) as file:
            content = file.read(limit + 1)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise BadInput(f"cannot read {shown(str(path), 200)}: {reason}") from None
    except (TypeError, ValueError):
        raise BadInput(f"{shown(str(path), 200)} is not a path") from None
    if len(content) > limit:
        raise BadInput(f"{shown(str(path), 200)} is larger than the limit of {limit} bytes")
    return content


def _open_regular(path: str, flags: int) -> int:
    # Without O_NONBLOCK, opening a pipe with no writer would hang.
    descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        what = "it is a directory" if stat.S_ISDIR(mode) else "it is not a regular file"
        raise OSError(0, what)
    return descriptor


def read_json(path: Path, null: bool = False) -> Any:
    """Read strict JSON: UTF-8, no duplicate key, NaN or infinity, bounded nesting.

    Null is refused unless ``null`` is True.
    """
    try:
        return strict_json(read_bytes(path), null)
    except BadInput as error:
        if error.where or error.message.startswith("cannot read"):
            raise
        raise BadInput(f"{shown(str(path), 200)}: {error.message}") from None


def strict_json(content: bytes, null: bool = False) -> Any:
    """Parse strict JSON; the first fault is raised as BadInput with its path."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(f"not UTF-8 text (byte {error.start})") from None
    if text.count(",") > MAX_ITEMS:
        raise BadInput(f"more than {MAX_ITEMS} items; use a smaller problem")
    try:
        data = json.loads(
            text,
            object_pairs_hook=_object,
            parse_int=_integer,
            parse_constant=lambda word: _Fault(f"{word} is not a number of JSON; use a finite one"),
        )
    except json.JSONDecodeError as error:
        raise BadInput(
            f"not JSON: {error.msg} (line {error.lineno}, column {error.colno})"
        ) from None
    except RecursionError:
        raise BadInput(f"nested deeper than {MAX_NESTING} levels") from None
    _refuse_faults(data, "", null)
    return data


def _integer(digits: str) -> Any:
    if len(digits) > 320:
        return _Fault(f"an integer of {len(digits)} digits is out of range; use a smaller number")
    return int(digits)


def _object(pairs: list[tuple[str, Any]]) -> Any:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        for key, _ in pairs:
            if key in seen:
                return _Fault(f"the key {shown(key)} stands twice; keep one")
            seen.add(key)
    return found


def _refuse_faults(data: Any, where: str, null: bool, depth: int = 0) -> None:
    if depth > MAX_NESTING:
        raise BadInput(f"nested deeper than {MAX_NESTING} levels")
    if isinstance(data, _Fault):
        raise BadInput(data.message, where)
    if data is None and not null:
        raise BadInput("null is not a value of the format; leave the key out", where)
    if isinstance(data, str):
        _refuse_surrogates(data, where)
    elif isinstance(data, dict):
        for key, value in data.items():
            _refuse_surrogates(key, where)
            name = key if key.isascii() and key.isidentifier() else shown(key)
            _refuse_faults(value, joined(where, name), null, depth + 1)
    elif isinstance(data, list):
        for i, value in enumerate(data):
            if type(value) is not float and type(value) is not int:
                _refuse_faults(value, joined(where, f"[{i}]"), null, depth + 1)


def _refuse_surrogates(text: str, where: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise BadInput(
            f"{shown(text)} holds half of a surrogate pair; write whole characters", where
        ) from None


def joined(*parts: str) -> str:
    """Join paths of fields: ``joined("a", "[0]", "b") == "a[0].b"``."""
    path = ""
    for part in parts:
        path += part if not path or part.startswith("[") or not part else f".{part}"
    return path
