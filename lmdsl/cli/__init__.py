"""The command line: ``lmdsl solve FILE`` and its companions.

Exit status, the first that applies: 2 bad input or usage; 3 not stabilizable; 0 verified; 4 a
solver failed or hit its limit; 1 solved but not verified. Results go to stdout, everything else
(progress, errors) to stderr; an error is one message, never a traceback. Each group of commands has
its module; what a command needs is imported when it runs.
"""

import argparse
import contextlib
import os
import sys
from collections.abc import Sequence
from typing import Any

from lmdsl.cli import feasibility, listing, results, solving, studies
from lmdsl.cli.output import Arguments, Run, narrated, print_json
from lmdsl.cli.streams import kept
from lmdsl.errors import LmdslError, printable, shown
from lmdsl.machine.deadline import TimeLimitReached
from lmdsl.ranks.launchers import launched
from lmdsl.results.status import Status


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    under = launched()
    if under.ranks > 1:
        from lmdsl.cli import ranks

        return ranks.main(arguments, under)
    with kept() as answers:
        try:
            with contextlib.redirect_stdout(answers):  # for --help
                parsed = parser().parse_args(arguments)
        except SystemExit as stop:
            return int(stop.code or 0)
        return _run(parsed)


def _run(parsed: Arguments) -> int:
    try:
        with narrated():
            return int(parsed.run(parsed))
    except (Exception, KeyboardInterrupt) as error:
        return failed(parsed, error)


def failed(parsed: Arguments, error: BaseException) -> int:
    """Say why a command failed, and return its exit status."""
    if isinstance(error, KeyboardInterrupt):
        return _fail("interrupted", 130)
    if isinstance(error, MemoryError):
        return _bad(parsed, "out of memory; use fewer cells, controls or sample points")
    if isinstance(error, TimeLimitReached):
        return _bad(parsed, str(error), Status.SOLVER_FAILED)
    if isinstance(error, LmdslError):
        return _bad(parsed, str(error))
    if os.environ.get("LMDSL_DEBUG"):
        raise error
    what = f"internal error: {type(error).__name__}: {shown(str(error), 200)}"
    return _fail(f"{what}; please report it (LMDSL_DEBUG=1 shows where)", 4)


def _fail(message: str, status: int) -> int:
    print(f"lmdsl: {printable(message)}", file=sys.stderr)
    return status


def _bad(parsed: Arguments, message: str, status: Status = Status.BAD_INPUT) -> int:
    if getattr(parsed, "json", False):
        from lmdsl.results.summary import Summary

        report: dict[str, Any] = Summary(status=status, message=message).to_dict()
        if parsed.command == "compare":
            report = {"results": [report], "agreement": None}
        elif parsed.command != "solve":
            report = {"status": status, "message": message}
        print_json(report)
    return _fail(message, status.exit_status)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    from lmdsl import __version__

    found = argparse.ArgumentParser(
        prog="lmdsl",
        description="Optimal stabilization with Lyapunov measures, verified.",
        epilog="Exit status: 0 verified, 1 not verified, 2 bad input, 3 not stabilizable, "
        "4 a solver failed or hit its limit.",
        allow_abbrev=False,
    )
    found.add_argument("--version", action="version", version=f"lmdsl {__version__}")
    commands = found.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, run: Run, text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
        sub.set_defaults(run=run)
        return sub

    for group in (solving, results, feasibility, studies, listing):
        group.add(command)
    return found
