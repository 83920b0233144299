"""What solvers print is kept off the standard output of the program that uses lmdsl.

Solvers print from Python, from C and from processes of their own. While foreign code runs, file
descriptor 1 leads into a temporary file, and so do ``sys.stdout`` and ``sys.stderr`` of the thread
that runs it; ``print`` in any other thread reaches the user as ever. What other threads write to
descriptor 1 by other ways meanwhile ends up in the log too, so this is done only where it is
needed: a backend that is silent by its own options says so (``Capabilities.silent``).
"""

import contextlib
import ctypes
import io
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from typing import Any

from lmdsl.machine import forking

KEPT = 65_536  # number of bytes of a log above which only the last ones are kept

_lock = threading.RLock()
# Held while the streams are diverted or put back: no fork may happen in the middle.
_turn = threading.RLock()
forking.hold(_turn)
_here = threading.local()
_diverted: "_Diverted | None" = None
_users = 0


@contextlib.contextmanager
def foreign() -> Iterator[Callable[[], str]]:
    """Run foreign code: nothing that it prints reaches standard output.

    Yields what returns the last 64 KiB of what was printed, also after the end.
    """
    diverted = _enter()
    printed: list[str] = []
    start = diverted.size()
    _here.depth = _depth() + 1
    try:
        yield lambda: printed[0] if printed else diverted.since(start)
    finally:
        _here.depth -= 1
        printed.append(diverted.since(start))
        _leave()


def ours(call: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of the user's that prints where it would outside foreign code."""

    def called(*arguments: Any) -> Any:
        depth, _here.depth = _depth(), 0
        try:
            return call(*arguments)
        finally:
            _here.depth = depth

    return called


def flush() -> None:
    """Write out what Python and C hold back for standard output."""
    for stream in (sys.stdout, sys.__stdout__):
        with contextlib.suppress(Exception):  # none, closed, or without a reader
            stream.flush()  # type: ignore[union-attr]
    for name in ("stdout", "__stdoutp"):
        with contextlib.suppress(Exception):  # not the C library's name here
            libc = ctypes.CDLL(None)
            libc.fflush(ctypes.c_void_p.in_dll(libc, name))


def descriptor(stream: Any) -> int | None:
    """Return the file descriptor of a stream, None where it has none."""
    try:
        return int(stream.fileno())
    except Exception:
        return None


def twin(stream: Any, number: int) -> io.TextIOWrapper:
    """Return a stream that writes as another does, to another descriptor, which it owns."""
    return io.TextIOWrapper(
        os.fdopen(number, "wb"),
        encoding=getattr(stream, "encoding", None) or "utf-8",
        errors=getattr(stream, "errors", None) or "backslashreplace",
        line_buffering=True,
    )


class _Diverted:
    """Descriptor 1, ``sys.stdout`` and ``sys.stderr`` lead into one temporary file."""

    def __init__(self) -> None:
        self.kept: int | None = None
        self.file = _file()
        # foreign code may close what it is given to write to
        given = os.fdopen(os.dup(self.file.fileno()), "wb", buffering=0)
        self.log = io.TextIOWrapper(given, "utf-8", "backslashreplace", write_through=True)
        self.streams = {"stdout": sys.stdout, "stderr": sys.stderr}
        self.split: dict[str, _Split] = {}
        try:
            self._divert()
        except BaseException:
            self.end()
            raise

    def _divert(self) -> None:
        users: dict[str, Any] = dict(self.streams)
        if sys.__stdout__ is not None:  # else descriptor 1 is closed, or somebody's file
            flush()
            with contextlib.suppress(OSError):
                self.kept = os.dup(1)
                os.dup2(self.file.fileno(), 1)
        for name, stream in self.streams.items():
            if self.kept is not None and descriptor(stream) == 1:
                users[name] = twin(stream, os.dup(self.kept))
            self.split[name] = _Split(stream, users[name])
            setattr(sys, name, self.split[name])

    def end(self) -> None:
        """Put everything back in its place."""
        for name, split in self.split.items():
            if self._is_ours(getattr(sys, name), split):  # else another thread put one there
                setattr(sys, name, split.stream)
            split.end()
        if self.kept is not None:
            flush()
            os.dup2(self.kept, 1)
            os.close(self.kept)
            self.kept = None
        for file in (self.log, self.file):
            with contextlib.suppress(OSError, ValueError):
                file.close()

    def _is_ours(self, stream: Any, split: "_Split") -> bool:
        """Return whether a standard stream is no use when this ends: whose it is, or was."""
        if stream is split or stream is None or getattr(stream, "closed", False) is True:
            return True
        number = descriptor(stream)
        return number is not None and _same(number, self.file.fileno())

    def size(self) -> int:
        """Return how much was printed."""
        if self.kept is not None:
            flush()
        return os.fstat(self.file.fileno()).st_size

    def since(self, start: int) -> str:
        """Return what was printed since, the last part of it."""
        end = self.size()
        first = max(start, end - KEPT)
        if first >= end or not hasattr(os, "pread"):
            return ""
        found = os.pread(self.file.fileno(), end - first, first)
        return found.decode("utf-8", "backslashreplace")


class _Split:
    """Stands for a standard stream: foreign code's goes to the log, the user's to the user."""

    def __init__(self, stream: Any, user: Any) -> None:
        self.stream, self.user = stream, user

    def _target(self) -> tuple[Any, contextlib.AbstractContextManager[None]]:
        """Return the stream meant, and what to do where it fails."""
        if _depth() and _diverted is not None:  # no room for the log, or somebody closed it
            return _diverted.log, contextlib.suppress(OSError, ValueError)
        return self.user, contextlib.nullcontext()

    def write(self, text: str) -> int:
        with _lock:
            target, guarded = self._target()
            if target is not None:
                with guarded:
                    return int(target.write(text))
            return len(text)

    def flush(self) -> None:
        with _lock:
            target, guarded = self._target()
            if target is not None:
                with guarded:
                    target.flush()

    def close(self) -> None:
        """Close nothing: the stream stood for is not the caller's."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target()[0], name)

    def end(self) -> None:
        """Be the stream stood for from now on: somebody may have kept this object."""
        with _lock:
            user, self.user = self.user, self.stream
            if user is not self.stream:
                with contextlib.suppress(Exception):
                    user.close()


def _file() -> Any:
    try:
        return tempfile.TemporaryFile(buffering=0)
    except OSError:  # nowhere to write
        return open(os.devnull, "w+b", buffering=0)


def _same(one: int, other: int) -> bool:
    try:
        return os.path.samestat(os.fstat(one), os.fstat(other))
    except OSError:
        return False


def _depth() -> int:
    return getattr(_here, "depth", 0)


def _enter() -> _Diverted:
    global _diverted, _users
    with _turn, _lock:
        if _diverted is None:
            _diverted = _Diverted()
        _users += 1
        return _diverted


def _leave() -> None:
    global _diverted, _users
    with _turn, _lock:
        _users -= 1
        if not _users and _diverted is not None:
            _diverted.end()
            _diverted = None


def _forked() -> None:
    """Of the threads that were in foreign code the child has at most the one that forked."""
    global _diverted, _users, _lock
    _lock = threading.RLock()
    _users = min(_depth(), 1)
    if not _users and _diverted is not None:
        _diverted.end()
        _diverted = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
