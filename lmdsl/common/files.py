"""Files: bounded reading of strict JSON, and writing that happens whole or not at all."""

import contextlib
import errno
import json
import math
import os
import re
import secrets
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

from lmdsl.errors import BadInput, shown

MAX_FILE_BYTES = 16 * 2**20  # number of bytes above which a file is refused
MAX_NESTING = 32  # depth of JSON above which it is refused
MAX_ITEMS = 1_000_000  # number of values in JSON above which it is refused


def write_whole(path: Path, content: bytes | Iterable[bytes]) -> None:
    """Write a file so that it appears whole or not at all; a long one piece by piece.

    Where a link stands, what it points to is written; a pipe or a device gets the bytes. BadInput
    where the path cannot be written.
    """
    pieces = [content] if isinstance(content, bytes) else content
    try:
        if path.exists() and not path.is_file() and not path.is_dir():  # a pipe, /dev/stdout
            with open(path, "wb") as file:
                file.writelines(pieces)
            return
        path = Path(os.path.realpath(path))
        name = path.with_name(f".{path.name[:40]}.{secrets.token_hex(8)}")
        try:
            write_new(name, pieces)
            os.replace(name, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(name)
            raise
    except (OSError, ValueError) as error:
        raise BadInput(f"cannot write {shown(str(path), 200)}: {reason(error)}") from None


def write_new(path: Path, pieces: Iterable[bytes | memoryview]) -> None:
    """Write a file that must not exist yet, and wait until it is on the disk."""
    with open(path, "xb") as file:
        file.writelines(pieces)
        synced(file)


def synced(file: BinaryIO) -> None:
    """Wait until what was written is on the disk, where the file system knows that."""
    file.flush()
    try:
        os.fsync(file.fileno())
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise


# What fsync says on file systems that do not know it; other errors mean lost data.
_NO_SYNC = {errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EROFS, errno.EBADF}


def reason(error: Exception) -> str:
    """Return what an error of the operating system says, for the end of a sentence."""
    return (getattr(error, "strerror", None) or str(error)).lower()


class _Flaw:
    """Stands in the parsed data for something JSON or the format does not allow."""

    def __init__(self, message: str) -> None:
        self.message = message


def read_bytes(path: Path, links: bool = True) -> bytes:
    """Read a regular file of MAX_FILE_BYTES at most; BadInput says why it cannot be read."""
    try:
        with open_regular(path, links) as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise BadInput(f"cannot read {shown(str(path), 200)}: {reason(error)}") from None
    except (TypeError, ValueError):
        raise BadInput(f"{shown(str(path), 200)} is not a path") from None
    if len(content) > MAX_FILE_BYTES:
        raise BadInput(
            f"{shown(str(path), 200)} is larger than the limit of {MAX_FILE_BYTES} bytes"
        )
    return content


def open_regular(path: Path, links: bool = True) -> BinaryIO:
    """Open a regular file for reading; a pipe or a device is refused without waiting for it.

    Without ``links`` a symbolic link is refused too.
    """
    more = sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY"))
    if not links:
        if os.path.islink(path):
            raise OSError(0, "it is a link")
        more |= getattr(os, "O_NOFOLLOW", 0)

    def opener(path: str, flags: int) -> int:
        # Without O_NONBLOCK, opening a pipe with no writer would hang.
        descriptor = os.open(path, flags | more)
        mode = os.fstat(descriptor).st_mode
        if not stat.S_ISREG(mode):
            os.close(descriptor)
            what = "it is a directory" if stat.S_ISDIR(mode) else "it is not a regular file"
            raise OSError(0, what)
        return descriptor

    return open(path, "rb", opener=opener)


def read_json(path: Path) -> Any:
    """Read strict JSON: UTF-8, no duplicate key, null, NaN or infinity, bounded nesting."""
    return parsed(path, read_bytes(path))


def parsed(path: Path, content: bytes, null: bool = False) -> Any:
    """Parse what was read of a file, which errors name; null is refused unless ``null``."""
    try:
        return strict_json(content, null)
    except BadInput as error:
        if error.where:
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
            parse_constant=lambda word: _Flaw(f"{word} is not a number of JSON; use a finite one"),
        )
    except json.JSONDecodeError as error:
        where = f"(line {error.lineno}, column {error.colno})"
        raise BadInput(f"not JSON: {error.msg} {where}{_remedy(text, error.pos)}") from None
    except RecursionError:
        raise BadInput(f"nested deeper than {MAX_NESTING} levels") from None
    _refuse_faults(data, "", null)
    return data


def _remedy(text: str, at: int) -> str:
    """Return what is to be written instead, where JSON ends to be JSON."""
    rest, before = text[at : at + 40], text[:at].rstrip()
    if rest[:1] == "#" or rest[:2] in ("//", "/*"):
        return "; JSON has no comments: leave them out"
    if rest[:1] == "'":
        return '; write text in "double quotes"'
    if before.endswith(",") and rest[:1] in ("}", "]"):
        return f"; leave out the comma before {rest[0]}"
    digits = "; numbers are written in digits"
    word = re.match(r"[-+]?\s*(pi|tau|e)\b", rest) or re.match(r"\s*\*\s*(pi|tau|e)\b", rest)
    if word:
        return f"{digits}: {word[1]} is {getattr(math, word[1])!r}"
    if at and re.match(r"[-+.*/^A-Za-z_]", rest):
        return f'{digits}, formulas in "double quotes", true and false in small letters'
    return ""


def _integer(digits: str) -> Any:
    if len(digits) > 320:
        return _Flaw(f"an integer of {len(digits)} digits is out of range; use a smaller number")
    return int(digits)


def _object(pairs: list[tuple[str, Any]]) -> Any:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        for key, _ in pairs:
            if key in seen:
                return _Flaw(f"the key {shown(key)} stands twice; keep one")
            seen.add(key)
    return found


def _refuse_faults(data: Any, where: str, null: bool, depth: int = 0) -> None:
    if depth > MAX_NESTING:
        raise BadInput(f"nested deeper than {MAX_NESTING} levels")
    if isinstance(data, _Flaw):
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
