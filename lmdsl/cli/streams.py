"""The standard streams of a command: answers go to standard output, and nothing else does.

A command keeps standard output for itself: descriptor 1 leads to stderr while it runs, and so does
``sys.stdout``, so that nothing that solvers, libraries or child processes print gets between the
answers. A stream that cannot be written to (closed, full, or its reader gone) takes whatever comes
from then on and loses it: it changes no exit status.
"""

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

from lmdsl.errors import printable
from lmdsl.machine import quiet


class Stream:
    """A text stream whose loss is no error: what comes after it is lost too."""

    def __init__(self, stream: Any) -> None:
        self.stream, self.fault = stream, ""

    def write(self, text: str) -> int:
        """Write text, at once where it ends a line."""
        self._try("write", text)
        if text.endswith("\n"):
            self.flush()
        return len(text)

    def flush(self) -> None:
        """Write out what is held back."""
        self._try("flush")

    def _try(self, method: str, *arguments: Any) -> None:
        try:
            getattr(self.stream, method)(*arguments)
        except (OSError, ValueError) as error:  # ValueError: it is closed
            if getattr(error, "errno", None) != errno.EPIPE:
                self.fault = str(getattr(error, "strerror", None) or error).lower()
            number = quiet.descriptor(self.stream)
            if number is not None:  # else Python tries once more when it ends
                with contextlib.suppress(OSError, ValueError):
                    _to_nowhere(number)
                    self.stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


_answers: ContextVar[Stream | None] = ContextVar("answers", default=None)


def say(text: str) -> None:
    """Print an answer on standard output, with control characters escaped."""
    print(_escaped(text), file=_answers.get() or sys.stdout)


@contextlib.contextmanager
def muted() -> Iterator[None]:
    """Lose answers."""
    with open(os.devnull, "w") as nowhere:
        token = _answers.set(Stream(nowhere))
        try:
            yield
        finally:
            _answers.reset(token)


def tell(log: str) -> None:
    """Print what a solver printed on stderr."""
    if log:
        print(_escaped(log.rstrip("\n")), file=sys.stderr)


def _escaped(text: str) -> str:
    return "\n".join(map(printable, text.split("\n")))


@contextlib.contextmanager
def kept() -> Iterator[Stream]:
    """Keep standard output for answers, and let nothing fail because a stream is lost."""
    for number in (0, 1, 2):  # the next file that is opened would get the number of a closed one
        with contextlib.suppress(OSError):
            _open_if_closed(number)
    before = sys.stdout, sys.stderr
    for stream in before:
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    quiet.flush()
    number = os.dup(1)
    apart = sys.stdout is None or quiet.descriptor(sys.stdout) == 1
    answers = Stream(quiet.twin(sys.stdout, os.dup(number)) if apart else sys.stdout)
    errors = Stream(os.fdopen(2, "w", closefd=False) if sys.stderr is None else sys.stderr)
    sys.stdout = sys.stderr = errors
    os.dup2(2, 1)
    token = _answers.set(answers)
    try:
        yield answers
        answers.flush()
        if answers.fault:
            print(f"lmdsl: cannot write to standard output: {answers.fault}", file=sys.stderr)
    finally:
        _answers.reset(token)
        errors.flush()
        sys.stdout, sys.stderr = before
        quiet.flush()
        os.dup2(number, 1)
        os.close(number)
        if apart:
            answers.close()


def _open_if_closed(number: int) -> None:
    try:
        os.fstat(number)
    except OSError:
        _to_nowhere(number)


def _to_nowhere(number: int) -> None:
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != number:
        os.dup2(nowhere, number)
        os.close(nowhere)
