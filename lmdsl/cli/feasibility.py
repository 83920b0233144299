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
from lmdsl.errors import BadInput


def add(command: Command) -> None:
    """Add the commands of this module."""
    check = command("check", _check, "Say what looks wrong with a problem before the long run.")
    shared(check, "file")
    check.add_argument("--suggest", action="store_true",
                       help="try step, cells and samples that fit each other")  # fmt: skip
    check.add_argument("--out", metavar="FILE",
                       help="write the problem with what is suggested to FILE")  # fmt: skip
    shared(check, "--time-limit", "--json")

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
    from lmdsl.common.records import jsonable
    from lmdsl.machine.deadline import Deadline

    if parsed.out is not None and not parsed.suggest:
        raise BadInput("there is nothing to write without --suggest", "--out")
    problem, better = problem_at(parsed.file), None
    deadline = Deadline.of(parsed.time_limit)
    with ProgressLine() as progress:
        found = check(problem, time_limit=Deadline(deadline.left), progress=progress)
        if parsed.suggest:
            from lmdsl.advice.suggesting.search import suggest

            better = suggest(problem, time_limit=Deadline(deadline.left), progress=progress)
    if parsed.json:
        print_json({**found.to_dict(), "suggestion": jsonable(better)})
    else:
        say(f"{found}\n\n{better}" if better else str(found))
    if better and parsed.out is not None:
        better.problem.save(parsed.out)
    return int(bool(found) or bool(better and better.better))


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
