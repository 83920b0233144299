"""What the commands share: one JSON object, a line of progress."""

import argparse
import json
import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Self

from lmdsl.cli.streams import say
from lmdsl.errors import printable

Arguments = argparse.Namespace
Run = Callable[[Arguments], int]
# Adds a command: its name, what runs it, its help.
Command = Callable[[str, Run, str], argparse.ArgumentParser]

AS_STORED = "the result as stored, not re-checked; see lmdsl verify"

SHARED: dict[str, dict[str, Any]] = {
    "file": {"metavar": "FILE", "help": "problem file, or a result directory: its problem"},
    "dir": {"metavar": "DIR", "help": "result directory"},
    "--time-limit": {"type": float, "metavar": "S", "help": "seconds"},
    "--json": {"action": "store_true", "help": "print one JSON object on stdout"},
}


def shared(sub: argparse.ArgumentParser, *options: str) -> None:
    """Add options that several commands have."""
    for option in options:
        sub.add_argument(option, **SHARED[option])


def problem_at(path: str) -> Any:
    """Return the problem of a file, or of a result directory."""
    from lmdsl.common import inputs

    if inputs.path(path).is_dir():
        from lmdsl.results.directory.archive import problem_of

        return problem_of(path)
    from lmdsl.problem.problem import load

    return load(path)


def print_json(data: Any, indent: int | None = None) -> None:
    """Print strict JSON."""
    say(json.dumps(data, allow_nan=False, indent=indent))


def answer(parsed: Arguments, found: Any) -> None:
    """Print what was found, as JSON where that was asked for."""
    if parsed.json:
        print_json(found.to_dict())
    else:
        say(str(found))


class ProgressLine:
    """One line on stderr that overwrites itself, only on a terminal."""

    def __init__(self) -> None:
        self.shown, self.last, self.stage = sys.stderr.isatty(), 0.0, ""

    def __call__(self, stage: str, fraction: float) -> None:
        """Show a stage and the fraction done (-1: unknown)."""
        now = time.monotonic()
        if not self.shown or (stage == self.stage and now - self.last < 0.1):
            return
        self.last, self.stage = now, stage
        percent = f" {100 * fraction:3.0f} %" if fraction >= 0 else " ..."
        print(f"\r\x1b[K{stage}{percent}", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.shown and self.stage:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


class Narrator(logging.Handler):
    """What lmdsl logs, on stderr: its warnings; on a terminal, while kernels are compiled, that."""

    compiled = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Show a record; a line about kernels goes when they are done."""
        busy, text = getattr(record, "busy", None), f"lmdsl: {printable(record.getMessage())}\n"
        if busy is not None:
            text = "\r\x1b[K"
            if busy:
                text += f"compiling kernels, once ({self.compiled} done) ..."
            self.compiled += not busy
        with suppress(OSError, ValueError, AttributeError):  # stderr may be closed, or None
            if busy is None or sys.stderr.isatty():
                sys.stderr.write(text)
                sys.stderr.flush()


@contextmanager
def narrated() -> Iterator[None]:
    """Show what lmdsl logs while a command runs."""
    log, narrator = logging.getLogger("lmdsl"), Narrator()
    level = log.level
    log.addHandler(narrator)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.setLevel(level)
        log.removeHandler(narrator)
