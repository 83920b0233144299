"""``study``: variants of a problem in turn."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from lmdsl.cli.output import Arguments, Command, ProgressLine, answer, problem_at, shared
from lmdsl.cli.streams import say
from lmdsl.cli.values import counts, numbers
from lmdsl.errors import printable


def add(command: Command) -> None:
    """Add the commands of this module."""
    study = command("study", _study, "Solve variants of a problem in turn, and compare them.")
    shared(study, "file")
    study.add_argument("--cells", metavar="N,N", help="cells of every axis, or 12x24 of each")
    study.add_argument("--samples", metavar="K,K",
                       help="sample points, of a grid on each axis")  # fmt: skip
    study.add_argument("--step", metavar="H,H", help="sampling times")
    study.add_argument("--gamma", metavar="G,G", help="values of gamma")
    study.add_argument("--backends", metavar="A,B", help="backends")
    study.add_argument("--starts", type=int, default=1000, metavar="N",
                       help="runs of the true map for each variant (default 1000)")  # fmt: skip
    study.add_argument("--tolerance", type=float, default=1e-6, metavar="T",
                       help="largest gap that counts as verified (default 1e-6)")  # fmt: skip
    study.add_argument("--out", metavar="DIR", help="keep every variant in DIR, and go on there")
    shared(study, "--time-limit", "--json")


def _study(parsed: Arguments) -> int:
    given: dict[str, Any] = {
        "cells": None if parsed.cells is None else counts(parsed.cells, "--cells"),
        "backends": None if parsed.backends is None else parsed.backends.split(","),
    }
    for name in ("samples", "step", "gamma"):
        text = getattr(parsed, name)
        given[name] = None if text is None else numbers(text, f"--{name}", name == "samples")
    problem = problem_at(parsed.file)
    from lmdsl.advice.studies.running import study

    with ProgressLine() as progress:
        found = study(
            problem, **given, out=parsed.out, starts=parsed.starts, tolerance=parsed.tolerance,
            time_limit=parsed.time_limit, progress=progress,
        )  # fmt: skip
    answer(parsed, found)
    if parsed.out is not None:
        _drawn(found, parsed)
    return int(any(row.status != "verified" for row in found.rows))


def _drawn(found: Any, parsed: Arguments) -> None:
    """Draw the study into its folder, where matplotlib is installed."""
    names = ["study.json", "study.csv"]
    if find_spec("matplotlib") is not None:
        from lmdsl import plotting

        plotting.study(found, Path(parsed.out) / "study.png")
        names.append("study.png")
    text = f"written to {printable(parsed.out)}: {', '.join(names)}, and a result of each variant"
    if parsed.json:
        print(f"lmdsl: {text}", file=sys.stderr)
    else:
        say(text)
