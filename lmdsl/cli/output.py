"""What the commands share: options, one JSON object, a line of progress."""

import argparse
import json
from collections.abc import Callable
from typing import Any

from lmdsl.cli.streams import say
from lmdsl.machine.progress import Narrator as Narrator
from lmdsl.machine.progress import ProgressLine as ProgressLine
from lmdsl.machine.progress import narrated as narrated

Arguments = argparse.Namespace
Run = Callable[[Arguments], int]
# Adds a command: its name, what runs it, its help.
Command = Callable[[str, Run, str], argparse.ArgumentParser]

AS_STORED = "the result as stored, not re-checked; see lmdsl verify"

SHARED: dict[str, dict[str, Any]] = {
    "file": {"metavar": "FILE", "help": "problem file, or a result directory: its problem"},
    "dir": {"metavar": "DIR", "help": "result directory"},
    "--time-limit": {"type": float, "metavar": "S", "help": "seconds"},
    "--rows-on-disk": {"metavar": "DIR", "help": "keep rows in files of DIR instead of memory"},
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
