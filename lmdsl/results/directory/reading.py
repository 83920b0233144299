"""Result directories as sets of files: each is read as one.

A save writes its files under hidden names, ``.NAME.SAVE``, and then renames certificate.json into
place: that is the commit. The certificate names the save and the SHA-256 of every other file, so
that from this moment a reader finds the new files, also those that are not renamed yet; before it,
the old ones. Files of two saves are refused, or read again while another save is at work.
"""

import hashlib
import json
import mmap
import os
import re
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from numpy.typing import NDArray

from lmdsl.common import arrays
from lmdsl.common.arrays import MARK
from lmdsl.common.files import MAX_FILE_BYTES, open_regular, parsed, read_bytes, reason, strict_json
from lmdsl.errors import BadInput, shown

FORMAT = "lmdsl-result/1"
COMMIT = "certificate.json"
# Vectors that stand each in a file of its own, instead of all in solution.npz.
APART = tuple(
    f"{name}.npy"
    for name in ("control_index", "value", "lower", "measure", "cell_status", "witness",
                 "sure_levels")
)  # fmt: skip
# The files of a save; of the others in a directory none is read, replaced or removed.
NAMES = ("problem.json", "solution.npz", *APART, "model.npz", "proof.npz", "dropped.npz", COMMIT)
SAVE = "[0-9a-f]{16}"
BLOCKS, BLOCK = "blocks:", 2**20  # digests of files of which blocks of so many bytes are hashed
TRIES = 100  # number of attempts to read one save while others replace it
T = TypeVar("T")


class Mixture(BadInput):
    """The files of a directory are not of one save."""


def read(folder: Path, what: Callable[["Reading"], T]) -> T:
    """Read the files of one save, again where another save replaced them meanwhile.

    BadInput: the directory is unreadable, or its files are of several saves.
    """
    if not folder.is_dir():
        hint = "; `lmdsl solve FILE --out DIR` makes one" if folder.is_file() else ""
        raise BadInput(f"{shown(str(folder), 200)} is not a result directory{hint}")
    for attempt in range(TRIES):
        before = plain(folder / COMMIT)
        try:
            with ExitStack() as stack:
                return what(Reading(folder, before, stack))
        except BadInput as error:
            again = attempt < 3 and isinstance(error, Mixture)
            if not again and (attempt == TRIES - 1 or plain(folder / COMMIT) == before):
                raise
        time.sleep(0.005)
    raise AssertionError  # the last attempt returned or raised


class Reading:
    """The files of one save, open.

    Attributes
    ----------
    certificate
        Content of certificate.json.
    digests
        Name and SHA-256 of the other files; empty for a directory of an earlier version.
    rewritten
        Files that somebody wrote anew since the save, as far as they were opened.
    confirmed
        Files of which the digests were compared with those of the save, by all ranks together.
    """

    def __init__(self, folder: Path, certificate: bytes, stack: ExitStack) -> None:
        self.folder, self._stack = folder, stack
        self.certificate = stored(folder, certificate)
        self.save, self.digests = _identity(self.certificate)
        self.rewritten: list[str] = []
        self.confirmed: frozenset[str] = frozenset()
        self._files: dict[str, BinaryIO | BadInput] = {
            name: self._opened(name) for name in NAMES if name != COMMIT
        }
        if plain(folder / COMMIT) != certificate:
            raise Mixture("another save replaces the files all the time; read it again later")

    def open(self, name: str, limit: int | None = None) -> BinaryIO:
        """Return a file of this save, at its start.

        BadInput: it is missing, no regular file, of another save, or larger than ``limit`` bytes.
        """
        found, digest = self._files[name], self.digests.get(name)
        known = digest is None or name in self.confirmed
        if digest is not None and not known and not _is(found, digest, limit):
            hidden = self._opened(f".{name}.{self.save}")
            if _is(hidden, digest, limit):
                found = hidden
            elif isinstance(found, BadInput):
                raise Mixture(found.message)
            elif _as_saved(name, found):
                raise Mixture(
                    f"{name} is not the one this result was saved with: it was edited, or is of "
                    "another save; solve the problem again"
                )
            else:
                self.rewritten.append(name)
        if isinstance(found, BadInput):
            raise found
        if limit is not None and _size(found) > limit:
            raise BadInput(f"holds {_size(found)} bytes where at most {limit} are expected", name)
        found.seek(0)
        return found

    def content(self, name: str) -> bytes | memoryview:
        """Return what a file of this save holds; a large one is mapped."""
        file = self.open(name)
        if name not in APART:
            return file.read()
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))

    def arrays(self, name: str, expected: arrays.Expected) -> dict[str, NDArray[Any]]:
        """Read arrays of an archive of this save."""
        return arrays.unpacked(self.open(name, arrays.largest(expected)), name, expected)

    def apart(self) -> dict[str, BinaryIO]:
        """Return the files that are hashed by blocks, so that many can share in it."""
        wanted = (name for name, digest in self.digests.items() if digest.startswith(BLOCKS))
        found = ((name, self._files[name]) for name in wanted)
        return {name: file for name, file in found if not isinstance(file, BadInput)}

    def confirm(self, hashes: Mapping[str, bytes]) -> bool:
        """Compare the hashes of all blocks of the files; return whether they are of this save."""
        found = {name: of_blocks(held) for name, held in hashes.items()}
        wanted = {n: digest for n, digest in self.digests.items() if digest.startswith(BLOCKS)}
        self.confirmed = frozenset(found) if found == wanted else frozenset()
        return found == wanted

    def _opened(self, name: str) -> BinaryIO | BadInput:
        path = self.folder / name
        try:
            return self._stack.enter_context(open_regular(path, links=False))
        except OSError as error:
            return BadInput(f"cannot read {shown(str(path), 200)}: {reason(error)}")


def plain(path: Path) -> bytes:
    """Read a small file of a directory, which is no link."""
    return read_bytes(path, links=False)


def stored(folder: Path, content: bytes | None = None) -> dict[str, Any]:
    """Return what certificate.json of a folder holds, an object at least."""
    path = folder / COMMIT
    found = parsed(path, plain(path) if content is None else content, null=True)
    if not isinstance(found, dict):
        raise BadInput(f"not a certificate of format {FORMAT}", COMMIT)
    return found


def _identity(certificate: dict[str, Any]) -> tuple[str, dict[str, str]]:
    """Return the name of the save and the digests; results of earlier versions have none."""
    save, digests = certificate.get("save", ""), certificate.get("files", {})
    sound = isinstance(save, str) and re.fullmatch(f"({SAVE})?", save)
    if not sound or not isinstance(digests, dict) or bool(save) != bool(digests):
        raise BadInput("save and files are not what lmdsl writes", COMMIT)
    if not set(digests) <= set(NAMES) - {COMMIT} or not all(
        isinstance(x, str) for x in digests.values()
    ):
        raise BadInput("files are not what lmdsl writes", COMMIT)
    return save, digests


def _size(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size


def _is(file: BinaryIO | BadInput, digest: str, limit: int | None) -> bool:
    """Return whether a file has a digest."""
    if isinstance(file, BadInput) or (limit is not None and _size(file) > limit):
        return False
    file.seek(0)
    if digest.startswith(BLOCKS):
        return of_blocks(block_hashes(iter(lambda: file.read(BLOCK), b""))) == digest
    found = hashlib.sha256()
    while piece := file.read(2**20):
        found.update(piece)
    return found.hexdigest() == digest


def block_hashes(blocks: Iterable[bytes | memoryview]) -> bytes:
    """Return the SHA-256 of every block of a file, one after the other."""
    return b"".join(hashlib.sha256(block).digest() for block in blocks)


def share_of_hashes(file: BinaryIO, rank: int, count: int) -> bytes:
    """Return the SHA-256 of each block of one of ``count`` shares of a file, which ascend."""
    blocks = -(-_size(file) // BLOCK)
    first, last = (blocks * k // count for k in (rank, rank + 1))
    file.seek(first * BLOCK)
    return block_hashes(file.read(BLOCK) for _ in range(first, last))


def of_blocks(hashes: bytes) -> str:
    """Return the digest of a file that many hash at a time: that of its blocks' hashes."""
    return BLOCKS + hashlib.sha256(hashes).hexdigest()


def digest_of(name: str, content: bytes | memoryview) -> str:
    """Return the digest of a file, as certificate.json names it."""
    if name not in APART:
        return hashlib.sha256(content).hexdigest()
    whole = memoryview(content)
    return of_blocks(block_hashes(whole[k : k + BLOCK] for k in range(0, len(whole), BLOCK)))


def _as_saved(name: str, file: BinaryIO) -> bool:
    """Return whether a file looks as a save writes it, so that it is one of another save."""
    if name.endswith(".npy"):
        return True
    if name.endswith(".npz"):
        file.seek(max(0, _size(file) - len(MARK)))
        return file.read() == MARK
    file.seek(0)
    content = file.read(MAX_FILE_BYTES)
    try:
        return text(strict_json(content)) == content
    except BadInput:
        return False


def text(data: Any) -> bytes:
    """Return JSON as a save writes it."""
    content = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False)
    return (content + "\n").encode()
