"""``solve`` and ``compare``."""

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lmdsl.cli.output import (
    Arguments,
    Command,
    ProgressLine,
    answer,
    print_json,
    problem_at,
    shared,
)
from lmdsl.cli.streams import say, tell
from lmdsl.errors import LmdslError, plain_text, printable
from lmdsl.results.status import Status

if TYPE_CHECKING:
    from lmdsl.results.summary import Coverage

OPTIONS = (
    "tolerance",
    "time_limit",
    "max_iterations",
    "require_all",
    "restrict_to_gamma",
    "proved",
    "rows_on_disk",
    "checkpoint",
    "resume",
)
# Runs of the true map that follow a solve: how many, how long, and how long all together.
STARTS, STEPS, SECONDS = 1_000, 10_000, 10.0


def add(command: Command) -> None:
    """Add the commands of this module."""
    solve = command("solve", _solve, "Solve a problem and verify the answer.")
    _problem_options(solve)
    solve.add_argument("--backend", default="policy-iteration", metavar="B",
                       help="backend, or backend:algorithm (see `lmdsl backends`)")  # fmt: skip
    solve.add_argument("--max-iterations", type=int, metavar="K", help="iterations of the backend")
    solve.add_argument("--require-all", action="store_true",
                       help="refuse a problem with a cell that cannot be stabilized")  # fmt: skip
    solve.add_argument("--restrict-to-gamma", action="store_true",
                       help="solve on the cells for which gamma is feasible")  # fmt: skip
    solve.add_argument("--proved", type=float, metavar="T",
                       help="repair until this share of cells is proved to arrive")  # fmt: skip
    solve.add_argument("--checkpoint", metavar="DIR",
                       help="keep the policy at hand in DIR every minute")  # fmt: skip
    solve.add_argument("--resume", metavar="DIR",
                       help="begin with the policy that was kept in DIR")  # fmt: skip
    shared(solve, "--rows-on-disk")
    solve.add_argument("--out", metavar="DIR", help="write controller and certificate to DIR")
    solve.add_argument("--no-simulate", dest="simulate", action="store_false",
                       help="make no runs of the true map")  # fmt: skip
    shared(solve, "--json")

    compare = command("compare", _compare, "Solve with several backends and compare.")
    _problem_options(compare)
    compare.add_argument("--backends", default="policy-iteration,highs,clarabel,cvxpy",
                         metavar="A,B", help="comma-separated backends")  # fmt: skip
    shared(compare, "--json")


def _problem_options(sub: argparse.ArgumentParser) -> None:
    shared(sub, "file")
    sub.add_argument("--gamma", type=float, metavar="G", help="override gamma")
    sub.add_argument("--tolerance", type=float, default=1e-6, metavar="T",
                     help="largest gap that counts as verified (default 1e-6)")  # fmt: skip
    sub.add_argument("--time-limit", type=float, metavar="S",
                     help="seconds for compiling and solving")  # fmt: skip


def problem_asked(parsed: Arguments) -> Any:
    """Return the problem that a command names, its gamma as asked for."""
    problem = problem_at(parsed.file)
    return problem if parsed.gamma is None else problem.replaced(gamma=parsed.gamma)


def _solve(parsed: Arguments) -> int:
    if parsed.out is not None:
        from lmdsl.results.directory.writing import refuse_unless_free

        refuse_unless_free(parsed.out)
        parsed.place = Path(parsed.out).absolute()  # a solver may change the current directory
    problem = problem_asked(parsed)
    from lmdsl.results.solving import solve

    with ProgressLine() as progress:
        options = {name: getattr(parsed, name) for name in OPTIONS}
        result = solve(problem, parsed.backend, progress=progress, **options)
    tell(result.log)
    if not parsed.json:  # reported first: whatever saving meets, the answer was given
        say(summary(result))
    status = int(result.exit_status)
    try:  # what is known by now is known whatever becomes of saving and simulation
        if parsed.out is not None and result.lp is not None:  # else no time to compile
            status = _saved(result, parsed)
        if parsed.simulate:
            result = _simulated(result)
    finally:
        if parsed.json:
            print_json(result.to_dict())
    if result.simulation and not parsed.json:
        word = "verified" if result.verified else "not verified"
        say(f"{word} on the finite model; {result.simulation.sentence()}")
    return status


def _saved(result: Any, parsed: Arguments) -> int:
    """Save a result, elsewhere if it cannot be at its place; return the exit status."""
    from lmdsl.results.directory.archive import rescue

    try:
        result.save(parsed.place)
    except (LmdslError, MemoryError) as error:
        found = rescue(result, parsed.place)
        where = "nothing was saved" if found is None else f"the result was saved in {found}"
        print(printable(f"lmdsl: {str(error) or 'out of memory'}; {where}"), file=sys.stderr)
        return 2
    if not parsed.json:
        say(f"written to {printable(parsed.out)}")
    return int(result.exit_status)


def _simulated(result: Any) -> Any:
    """Return a result with runs of the true map, where there is a controller."""
    if (result.control_index < 0).all():
        return result
    try:
        with ProgressLine() as progress:
            progress("simulate", -1.0)
            runs = result.simulate(STARTS, STEPS, time_limit=SECONDS)
    except Exception as error:
        print(f"lmdsl: not simulated: {plain_text(error)}", file=sys.stderr)
        return result
    return replace(result, simulation=runs)


def _compare(parsed: Arguments) -> int:
    problem = problem_asked(parsed)
    from lmdsl.results.comparison import compare

    names = [name.strip() for name in parsed.backends.split(",") if name.strip()]
    with ProgressLine() as progress:
        comparison = compare(
            problem, names, tolerance=parsed.tolerance, time_limit=parsed.time_limit,
            progress=progress,
        )  # fmt: skip
    for result in comparison.results:
        tell(result.log)
    answer(parsed, comparison)
    return comparison.exit_status


def summary(result: Any) -> str:
    """Return what a result says to people, whether of one process or of all ranks."""

    def number(value: float | None, digits: str = ".9g") -> str:
        return "not established" if value is None else format(value, digits)

    seconds = result.seconds
    about = [] if result.data is None else result.data.rows()
    rows = [
        ("problem", printable(result.problem.name) or "(no name)"),
        ("status", result.status),
        ("backend", printable(f"{result.backend} ({result.solver_status or '-'})")),
        ("cells", f"{result.cells} = {result.attractor_cells} attractor + "
                  f"{result.stabilizable_cells} stabilizable + {_others(result)}"),
        ("coverage", str(result.coverage)),
        ("pairs", f"{result.pairs} usable (cell, control), {result.controls} controls"),
        ("gamma", f"{result.gamma!r}"),
    ]  # fmt: skip
    if result.problem.discount is not None:
        rows.append(("discount", _discount(result)))
    if result.pairs is None:  # there was no time to compile
        rows[3:6] = [("cells", str(result.cells)), ("controls", str(result.controls))]
    elif result.status != Status.NOT_STABILIZABLE:
        rows += [
            ("cost", f"{number(result.cost)} (lower bound {number(result.lower_bound)})"),
            *([("reward", number(result.reward))] if result.reward is not None else []),
            ("gap", f"{number(result.gap, '.2g')} (tolerance {number(result.tolerance, '.2g')})"),
            ("contraction", number(result.contraction)),
            ("improved", _improved(result.polish_steps)),
        ]
    if result.sure_cells is not None:
        rows.append(("enclosed", _enclosed(result)))
    rows += about
    rows += _ranks(result)
    if result.local_controller:
        rows.append(("local", result.local_controller.sentence()))
    if result.integration_error:
        rows.append(("integration", result.integration_error.sentence()))
    if result.gamma_bar:
        rows.append(("gamma_bar", "{:.9g} to {:.9g}".format(*result.gamma_bar)))
    stages = (("compile", seconds.compile), ("solve", seconds.solve), ("verify", seconds.verify))
    spent = [f"{name} {value:.3f}" for name, value in stages if value is not None]
    rows.append(("seconds", ", ".join(spent) or "-"))
    width = max(len(name) for name, _ in rows)
    lines = [f"{name.ljust(width)}  {value}" for name, value in rows]
    return "\n".join([*_first(result.coverage), *lines, "", printable(result.message)])


def _first(found: "Coverage | None") -> list[str]:
    """Return what is said before all else: that little can be stabilized, where that is so."""
    from lmdsl.results.job import LITTLE

    if found is None or not 0 < found.stabilizable < LITTLE * found.free:
        return []
    return [f"only {found.stabilizable} of {found.free} free cells can be stabilized", ""]


def _improved(steps: int | None) -> str:
    if steps is None:
        return "not established"
    return f"{steps} time{'s' * (steps != 1)} after the backend"


def _enclosed(result: Any) -> str:
    sure = f"some controller surely arrives from {result.sure_cells} cells"
    if result.sure_cells and result.proved is None:
        sure += " (perhaps another one than this: --proved T looks for it)"
    safe = result.claims.get("safe")
    if safe is None:
        return sure
    claim = "no run of the map as compiled is lost (claim 7)" if safe else "claim 7 is not proved"
    if safe == "assumed":
        claim = "no run is lost, assuming the Lipschitz constants (claim 7 is assumed, not proved)"
    missed = _missed(result) if safe else ""
    return f"{claim}{missed}; {sure}; the lower bound speaks of usable pairs"


def _missed(result: Any) -> str:
    """Return how likely noise is that enclosures do not cover; nothing where they cover all."""
    from lmdsl.problem.noise import NoiseNormal

    noise = (result.problem.noise or {}).values()
    share = sum(each.missed() for each in noise if isinstance(each, NoiseNormal))
    if not share:
        return ""
    unit = 10.0 ** (math.floor(math.log10(share)) - 1)
    return (
        " while noise stays within the standard deviations that are covered, which a step leaves "
        f"with probability {math.ceil(share / unit) * unit:.1e} at most"
    )


def _discount(result: Any) -> str:
    text, ended = f"{result.problem.discount!r}", result.ended_by_discount
    if result.problem.attractor.empty:
        return f"{text}: discounted, no target"
    if ended is None:
        return text
    return f"{text}: {100 * (1 - ended):.4g} % end in the attractor, {100 * ended:.4g} % before"


def _ranks(result: Any) -> list[tuple[str, str]]:
    """Return how many ranks there are, and how much they ask each other, where there are some."""
    ghosts = getattr(result, "ghosts", None)
    if ghosts is None:
        return []
    count = len(result.starts) - 1
    return [("ranks", f"{count}, which keep values of {ghosts:.2g} cells of others for each of C")]


def _others(result: Any) -> str:
    from lmdsl.model.stabilizable_set import CellStatus

    named = {
        CellStatus.ESCAPES: "escaping",
        CellStatus.TRAPPED: "trapped",
        CellStatus.LEADS_TO_THESE: "leading to lost cells",
        CellStatus.AVOID: "avoid",
        CellStatus.BEYOND_GAMMA: "beyond gamma",
    }
    counted = result.counted
    parts = [f"{counted[code]} {text}" for code, text in named.items() if counted[code]]
    return " + ".join(parts) or "0 others"
