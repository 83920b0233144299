"""``check``, ``gamma-max``, ``explain``: what looks wrong, what can be stabilized, why not all."""

from lmdsl.cli.output import (
    Arguments,
    Command,
    ProgressLine,
    answer,
    print_json,
    problem_at,
    shared,
)
from lmdsl.cli.streams import say


def add(command: Command) -> None:
    """Add the commands of this module."""
    check = command("check", _check, "Say what looks wrong with a problem before the long run.")
    shared(check, "file", "--time-limit", "--json")

    limit = command("gamma-max", _gamma_max, "Enclose the largest feasible gamma.")
    shared(limit, "file", "--time-limit")
    limit.add_argument("--width", type=float, default=1e-6, metavar="W",
                       help="relative width asked for, 1e-8 to 1 (1e-6)")  # fmt: skip
    shared(limit, "--json")

    explain = command("explain", _explain, "Say which cells cannot be stabilized, why, and what "
                      "would help.")  # fmt: skip
    shared(explain, "file")
    explain.add_argument("--phase-one", action="store_true",
                         help="phase-one LP: how much mass cannot be stabilized")  # fmt: skip
    shared(explain, "--time-limit", "--json")


def _check(parsed: Arguments) -> int:
    from lmdsl.advice.checking import check

    problem = problem_at(parsed.file)
    with ProgressLine() as progress:
        found = check(problem, time_limit=parsed.time_limit, progress=progress)
    answer(parsed, found)
    return int(bool(found))


def _gamma_max(parsed: Arguments) -> int:
    from lmdsl.optimize.feasibility.gamma_bar import gamma_max

    problem = problem_at(parsed.file)
    with ProgressLine() as progress:
        found = gamma_max(problem, progress, parsed.time_limit, parsed.width)
    answer(parsed, found)
    return 0 if found.stabilizable else 3


def _explain(parsed: Arguments) -> int:
    from lmdsl.explanation.causes import explain

    problem = problem_at(parsed.file)
    with ProgressLine() as progress:
        limit = parsed.time_limit
        found = explain(problem, phase_one=parsed.phase_one, time_limit=limit, progress=progress)
        text = "" if parsed.json else found.text()
    if parsed.json:
        print_json(found.to_dict())
    else:
        say(text)
    return 0
