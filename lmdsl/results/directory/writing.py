"""Saving: the files of a result directory are replaced as one, see ``folder``.

Saves into one directory wait for each other where the file system knows locks. Where it does not, a
save that finds files of two saves at its end writes its own again. Files of other names in the
directory are never touched. A directory that is not there yet is
made beside its place, under a hidden name, and renamed.
"""

import contextlib
import errno
import os
import random
import re
import secrets
import shutil
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from lmdsl.common.files import reason, write_new
from lmdsl.errors import BadInput, shown
from lmdsl.results.directory.reading import (
    COMMIT,
    NAMES,
    SAVE,
    TRIES,
    Mixture,
    Reading,
    digest_of,
    read,
    stored,
)

try:
    import fcntl
except ImportError:  # pragma: no cover
    fcntl = None  # type: ignore[assignment]

Content = bytes | memoryview  # of a file; of a large one its memory
PATIENCE = 10.0  # seconds that a save waits for another one
_HIDDEN = re.compile(rf"\.({'|'.join(map(re.escape, NAMES))})\.({SAVE})")
_LITTER = r"\.DS_Store|Thumbs\.db|desktop\.ini|lost\+found|\._.*|\.nfs.*|\.fuse_hidden.*"
# What killed saves, and systems on their own account, put into folders.
_IGNORED = re.compile(f"{_HIDDEN.pattern}|{_LITTER}")


def place(path: str | os.PathLike[str]) -> Path:
    """Return where a directory is or will be, links followed."""
    return Path(os.path.realpath(path))


def refuse_unless_free(path: str | os.PathLike[str]) -> None:
    """Refuse a path that cannot become a result directory, before work starts.

    It is a file, cannot be written, or is a folder that holds anything and is no result directory.
    """
    text = shown(str(path), 200)
    try:
        target = place(path)
        if os.path.lexists(target) and not target.is_dir():
            raise BadInput(f"{text} exists and is no directory; choose another name", "out")
        if target.is_dir():
            _refuse_foreign(target, text)
        used = target if target.is_dir() else _existing_parent(target)
        if not os.access(used, os.W_OK | os.X_OK):
            raise BadInput(f"cannot write in {shown(str(used), 200)}; choose another place", "out")
    except (OSError, ValueError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(f"cannot use {text}: {reason(error)}", "out") from None


def refuse_own_file(path: str | os.PathLike[str]) -> None:
    """Refuse to write something else in place of a file of a result directory, links followed."""
    target = Path(os.path.realpath(path))
    if target.name in NAMES and _marked(target.parent):
        raise BadInput(
            f"{shown(str(path), 200)} is a part of the result; choose another name", "out"
        )


def _refuse_foreign(target: Path, text: str) -> None:
    present = {name for name in os.listdir(target) if not _IGNORED.fullmatch(name)}
    if present and not _marked(target):
        raise BadInput(
            f"{text} is not empty and not a result directory; choose another name", "out"
        )
    for name in present.intersection(NAMES):
        if not stat.S_ISREG((target / name).lstat().st_mode):
            raise BadInput(f"{name} in {text} is not a regular file; choose another name", "out")


def _marked(target: Path) -> bool:
    """Return whether a folder holds a certificate of ours."""
    try:
        return str(stored(target).get("format")).startswith("lmdsl-result/")
    except BadInput:
        return False


def _existing_parent(target: Path) -> Path:
    parent = target.parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir():
        raise BadInput(f"{shown(str(parent), 200)} is not a directory", "out")
    return parent


# Writing ------------------------------------------------------------------------------------


def write(
    target: Path, files: Mapping[str, Content], commit: Callable[[dict[str, Any]], bytes]
) -> None:
    """Write the files of one save; what an older save left at the same place is replaced.

    The directory need not exist. ``files`` are all but certificate.json, which ``commit`` makes of
    the keys that join it to them. OSError: the place cannot be used; the old files are still there
    then.
    """
    digests = {name: digest_of(name, content) for name, content in files.items()}
    target.parent.mkdir(parents=True, exist_ok=True)
    failure: OSError | None = None
    for attempt in range(TRIES):
        save = secrets.token_hex(8)
        whole = {**files, COMMIT: commit({"save": save, "files": digests})}
        try:
            if not target.is_dir() and _made(target, whole):
                return
            with _alone(target):
                _replace(target, whole, save)
                if _intact(target):
                    return
        except FileNotFoundError as error:  # another save took our files for those of a killed one
            failure = error
        time.sleep(random.uniform(0, 0.002 * 2 ** min(attempt, 5)))
    raise failure or OSError(errno.EBUSY, "other saves write there at the same time")


class Begun:
    """A save of which others write large files, in place, before it appears as a whole.

    Attributes
    ----------
    save
        Its name.
    """

    def __init__(self, target: Path) -> None:
        self.target, self.save = target, secrets.token_hex(8)
        target.parent.mkdir(parents=True, exist_ok=True)
        self._beside = not target.is_dir()
        self._folder = target
        if self._beside:
            start = f".{target.name[:40]}."
            _tidy_beside(target, start)
            self._folder = target.with_name(start + self.save)
            self._folder.mkdir()

    def path(self, name: str) -> Path:
        """Return where a file is to be written."""
        return self._folder / (name if self._beside else f".{name}.{self.save}")

    def finish(
        self, files: Mapping[str, Content], there: Mapping[str, str],
        commit: Callable[[dict[str, Any]], bytes],
    ) -> None:  # fmt: skip
        """Write the other files, and let the save appear; ``there`` are digests of the large ones.

        OSError: the place cannot be used; the old files are still there then.
        """
        digests = {**{name: digest_of(name, content) for name, content in files.items()}, **there}
        whole = {**files, COMMIT: commit({"save": self.save, "files": digests})}
        if self._beside:
            for name, content in whole.items():
                write_new(self.path(name), [content])
            os.rename(self._folder, self.target)
        else:
            with _alone(self.target):
                _replace(self.target, whole, self.save, [*there])

    def abandon(self) -> None:
        """Remove what was written, where the save has not appeared."""
        if self._beside:
            _remove(self._folder)
        else:
            _tidy(self.target)


def _made(target: Path, files: Mapping[str, Content]) -> bool:
    """Make a directory that does not exist; False where another save was faster."""
    start = f".{target.name[:40]}."
    _tidy_beside(target, start)
    work = target.with_name(start + secrets.token_hex(8))
    try:
        work.mkdir()
        for name, content in files.items():
            write_new(work / name, [content])
        try:
            os.rename(work, target)
        except OSError:
            if target.is_dir():
                return False
            raise
    finally:
        _remove(work)
    return True


def _tidy_beside(target: Path, start: str) -> None:
    """Remove what killed saves left beside a directory that they were to make."""
    pattern = re.compile(re.escape(start) + SAVE)
    for name in filter(pattern.fullmatch, os.listdir(target.parent)):
        found, gone = target.with_name(name), target.with_name(start + secrets.token_hex(8))
        with contextlib.suppress(OSError):
            if not found.is_symlink() and set(os.listdir(found)) <= set(NAMES):
                # Renamed first, so that a save that lives after all finds nothing, not a part.
                os.rename(found, gone)
                _remove(gone)


def _remove(work: Path) -> None:
    """Remove a folder, also while others remove it too or a last file appears in it."""
    for _ in range(TRIES):
        shutil.rmtree(work, ignore_errors=True)
        if not os.path.lexists(work):
            return
        time.sleep(0.001)


@contextlib.contextmanager
def _alone(target: Path) -> Iterator[None]:
    """Wait for other saves, but not for ever, and not where locks are refused."""
    descriptor, until = None, time.monotonic() + PATIENCE
    try:
        with contextlib.suppress(OSError, AttributeError):
            descriptor = os.open(target, os.O_RDONLY)
            while not _locked(descriptor) and time.monotonic() < until:
                time.sleep(0.01)
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _locked(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _replace(
    target: Path, files: Mapping[str, Content], save: str, there: Iterable[str] = ()
) -> None:
    """Write files under hidden names into a directory, and rename them, certificate.json first.

    Those that are ``there`` have been written under these names.
    """
    _tidy(target, save)
    hidden = {name: target / f".{name}.{save}" for name in (COMMIT, *files, *there)}
    try:
        for name, content in files.items():
            write_new(hidden[name], [content])
        for name, path in hidden.items():
            os.replace(path, target / name)
        for name in set(NAMES) - set(hidden):
            with contextlib.suppress(FileNotFoundError):
                (target / name).unlink()
    finally:
        _tidy(target)


def _tidy(target: Path, spared: str = "") -> None:
    """Remove hidden files that the certificate in place does not name, nor are of a save."""
    with contextlib.suppress(OSError, BadInput):
        kept = stored(target).get("save") if os.path.lexists(target / COMMIT) else None
        for name in os.listdir(target):
            found = _HIDDEN.fullmatch(name)
            if found and found[2] not in (kept, spared) and not (target / name).is_dir():
                with contextlib.suppress(OSError):  # another save removes the same
                    os.unlink(target / name)


def _intact(target: Path) -> bool:
    """Return whether a directory holds the files of one save, whoever made it."""

    def open_all(files: Reading) -> None:
        for name in files.digests:
            files.open(name)

    try:
        read(target, open_all)
    except Mixture:
        return False
    except BadInput:  # written, and not to be read by us
        return True
    return True
