"""The command line: ``lmdsl solve FILE`` and its companions.

Exit status, the first that applies: 2 bad input or usage; 3 not stabilizable; 0 verified; 4 a
solver failed or hit its limit; 1 solved but not verified. Results go to stdout, everything else
(progress, errors) to stderr; an error is one message, never a traceback.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lmdsl.errors import BadInput, LmdslError, shown

Arguments = argparse.Namespace


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    try:
        parsed = _parser().parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        status = int(parsed.run(parsed))
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        # The reader of our output went away: not an error of ours, and nobody to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return int(getattr(parsed, "status", 0))
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    except MemoryError:
        return _bad(parsed, "out of memory; use fewer cells, controls or sample points")
    except LmdslError as error:
        return _bad(parsed, str(error))
    except Exception as error:
        if os.environ.get("LMDSL_DEBUG"):
            raise
        what = f"internal error: {type(error).__name__}: {shown(str(error), 200)}"
        return _fail(f"{what}; please report it (LMDSL_DEBUG=1 shows where)", 4)


def _fail(message: str, status: int) -> int:
    print(f"lmdsl: {message}", file=sys.stderr)
    return status


def _bad(parsed: Arguments, message: str) -> int:
    if getattr(parsed, "json", False):
        from lmdsl.result import Report

        report: dict[str, Any] = Report(status="bad_input", message=message).to_dict()
        if parsed.command == "compare":
            report = {"results": [report], "agreement": None}
        elif parsed.command != "solve":
            report = {"status": "bad_input", "message": message}
        _print_json(report)
    return _fail(message, 2)


def _parser() -> argparse.ArgumentParser:
    from lmdsl import __version__

    parser = argparse.ArgumentParser(
        prog="lmdsl",
        description="Optimal stabilization with Lyapunov measures, verified.",
        epilog="Exit status: 0 verified, 1 not verified, 2 bad input, 3 not stabilizable, "
        "4 a solver failed or hit its limit.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"lmdsl {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, run: Callable[[Arguments], int], text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
        sub.set_defaults(run=run)
        return sub

    def as_json(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("--json", action="store_true", help="print one JSON object on stdout")

    def problem_options(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("file", metavar="FILE", help="problem file")
        sub.add_argument("--gamma", type=float, metavar="G", help="override gamma")
        sub.add_argument("--tolerance", type=float, default=1e-6, metavar="T",
                         help="largest gap that counts as verified (default 1e-6)")  # fmt: skip
        sub.add_argument("--time-limit", type=float, metavar="S", help="seconds for the backend")

    solve = command("solve", _solve, "Solve a problem and verify the answer.")
    problem_options(solve)
    solve.add_argument("--backend", default="policy-iteration", metavar="B",
                       help="backend, or backend:algorithm (see `lmdsl backends`)")  # fmt: skip
    solve.add_argument("--max-iterations", type=int, metavar="K", help="iterations of the backend")
    solve.add_argument("--require-all", action="store_true",
                       help="refuse a problem with a cell that cannot be stabilized")  # fmt: skip
    solve.add_argument("--restrict-to-gamma", action="store_true",
                       help="solve on the cells for which gamma is feasible")  # fmt: skip
    solve.add_argument("--out", metavar="DIR", help="write controller and certificate to DIR")
    as_json(solve)

    compare = command("compare", _compare, "Solve with several backends and compare.")
    problem_options(compare)
    compare.add_argument("--backends", default="policy-iteration,highs,clarabel,cvxpy",
                         metavar="A,B", help="comma-separated backends")  # fmt: skip
    as_json(compare)

    verify = command("verify", _verify, "Recompile a saved result and check every claim.")
    verify.add_argument("dir", metavar="DIR", help="result directory")
    verify.add_argument("--exact", action="store_true",
                        help="judge in rational arithmetic, without tolerance")  # fmt: skip
    as_json(verify)

    simulate = command("simulate", _simulate, "Run the true map under a saved controller.")
    simulate.add_argument("dir", metavar="DIR", help="result directory")
    simulate.add_argument("--starts", type=int, default=10_000, metavar="N")
    simulate.add_argument("--steps", type=int, default=10_000, metavar="T")
    simulate.add_argument("--seed", type=int, default=0, metavar="S")
    as_json(simulate)

    plot = command("plot", _plot, "Draw the figures of a saved result.")
    plot.add_argument("dir", metavar="DIR", help="result directory")
    plot.add_argument("--out", metavar="FILE", help="PNG, PDF or SVG (default DIR/figures.png)")

    export = command("export", _export, "Write a saved result in a format for other readers.")
    export.add_argument("dir", metavar="DIR", help="result directory")
    export.add_argument("--format", required=True, choices=("certificate", "drn"),
                        help="certificate: to be checked alone; drn: for Storm")  # fmt: skip
    export.add_argument("--out", required=True, metavar="FILE", help="file to write")

    limit = command("gamma-max", _gamma_max, "Enclose the largest feasible gamma.")
    limit.add_argument("file", metavar="FILE", help="problem file")
    as_json(limit)

    explain = command("explain", _explain, "Say which cells cannot be stabilized, why, and what "
                      "would help.")  # fmt: skip
    explain.add_argument("file", metavar="FILE", help="problem file")
    explain.add_argument("--phase-one", action="store_true",
                         help="phase-one LP: how much mass cannot be stabilized")  # fmt: skip
    explain.add_argument("--time-limit", type=float, metavar="S", help="seconds for that LP")
    as_json(explain)

    command("schema", _schema, "Print the JSON Schema of the problem file.")
    as_json(command("systems", _systems, "List the systems known by name."))
    init = command("init", _init, "Write the default problem of a named system.")
    init.add_argument("name", metavar="NAME", help="a system (see `lmdsl systems`)")
    init.add_argument("--out", metavar="FILE", help="file to write (default NAME.json)")
    as_json(command("backends", _backends, "List the backends."))
    return parser


# The commands -------------------------------------------------------------------------------


def _problem(parsed: Arguments) -> Any:
    from lmdsl.problem import load

    problem = load(parsed.file)
    return problem if parsed.gamma is None else problem.replaced(gamma=parsed.gamma)


def _solve(parsed: Arguments) -> int:
    if parsed.out is not None:
        from lmdsl.archive import refuse_unless_free

        refuse_unless_free(parsed.out)
    problem = _problem(parsed)
    from lmdsl.stabilize import solve

    with _Progress() as progress:
        result = solve(
            problem,
            parsed.backend,
            tolerance=parsed.tolerance,
            time_limit=parsed.time_limit,
            max_iterations=parsed.max_iterations,
            require_all=parsed.require_all,
            restrict_to_gamma=parsed.restrict_to_gamma,
            progress=progress,
        )
    parsed.status = result.exit_status
    if parsed.out is not None:
        result.save(parsed.out)
    if parsed.json:
        _print_json(result.to_dict())
    else:
        print(_summary(result))
        if parsed.out is not None:
            print(f"written to {safe(parsed.out)}")
    return result.exit_status


def _compare(parsed: Arguments) -> int:
    problem = _problem(parsed)
    from lmdsl.comparison import compare

    names = [name.strip() for name in parsed.backends.split(",") if name.strip()]
    with _Progress() as progress:
        comparison = compare(
            problem,
            names,
            tolerance=parsed.tolerance,
            time_limit=parsed.time_limit,
            progress=progress,
        )
    parsed.status = comparison.exit_status
    if parsed.json:
        _print_json(comparison.to_dict())
    else:
        print(comparison.table())
    return comparison.exit_status


def _verify(parsed: Arguments) -> int:
    from lmdsl.verification import verify

    with _Progress() as progress:
        found = verify(parsed.dir, parsed.exact, progress)
    parsed.status = 0 if found.holds else 1
    if parsed.json:
        _print_json(found.to_dict())
    else:
        print(f"{found.status}: " + ("every claim holds" if found.holds else "NOT confirmed"))
        gap = found.certificate.gap
        if gap is not None:
            print(f"  gap {gap:.2g}, tolerance {found.certificate.tolerance:.2g}")
        for sentence in (*found.reasons, *found.notes):
            print(f"  {safe(sentence)}")
        print("  (claims speak of the finite model: cells and sampled transitions)")
    return 0 if found.holds else 1


def _simulate(parsed: Arguments) -> int:
    from lmdsl.result import Result

    result = Result.load(parsed.dir)
    with _Progress() as progress:
        progress("simulate", -1.0)
        runs = result.simulate(parsed.starts, parsed.steps, parsed.seed)
    if parsed.json:
        _print_json(runs.to_dict())
        return 0
    low, high = runs.interval
    print(f"{runs.starts} runs of the true map from random starts")
    print(f"  reached the attractor  {runs.reached}  ({100 * runs.reached / runs.starts:.4g} %; "
          f"95 % interval {100 * low:.4g} to {100 * high:.4g} %)")  # fmt: skip
    print(f"  lost                   {runs.lost}")
    print(f"  cycling                {runs.cycling}")
    if runs.steps:
        print("  steps                  " + ", ".join(f"{k} {v}" for k, v in runs.steps.items()))
    return 0


def _plot(parsed: Arguments) -> int:
    from lmdsl import plotting
    from lmdsl.result import Result

    result = Result.load(parsed.dir)
    path = Path(parsed.out) if parsed.out is not None else Path(parsed.dir) / "figures.png"
    plotting.figure(result, path)
    print(f"written to {safe(str(path))}")
    return 0


def _export(parsed: Arguments) -> int:
    from lmdsl.exports import export_certificate, export_drn
    from lmdsl.result import Result
    from lmdsl.verification import recompiled

    result = Result.load(parsed.dir)
    with _Progress() as progress:
        lp = recompiled(parsed.dir, result, progress)
    if parsed.format == "drn":
        export_drn(lp, parsed.out)
    else:
        export_certificate(result, parsed.out, lp)
    print(f"written to {safe(parsed.out)}")
    return 0


def _gamma_max(parsed: Arguments) -> int:
    from lmdsl.gamma import gamma_max
    from lmdsl.problem import load

    problem = load(parsed.file)
    with _Progress() as progress:
        found = gamma_max(problem, progress)
    if parsed.json:
        _print_json(found.to_dict())
    else:
        print(found.text())
    return 0 if found.stabilizable else 3


def _explain(parsed: Arguments) -> int:
    from lmdsl.explanation import explain
    from lmdsl.problem import load

    problem = load(parsed.file)
    with _Progress() as progress:
        found = explain(
            problem,
            phase_one=parsed.phase_one,
            time_limit=parsed.time_limit,
            progress=progress,
        )
        text = "" if parsed.json else found.text()
    if parsed.json:
        _print_json(found.to_dict())
    else:
        print("\n".join(safe(line) for line in text.splitlines()))
    return 0


def _schema(parsed: Arguments) -> int:
    from lmdsl.problem import json_schema

    _print_json(json_schema(), indent=2)
    return 0


def _systems(parsed: Arguments) -> int:
    from lmdsl.systems import NAMED

    if parsed.json:
        entries = {
            name: {"summary": s.summary, "source": s.source, "parameters": dict(s.defaults)}
            for name, s in NAMED.items()
        }
        _print_json(entries, indent=2)
        return 0
    width = max(map(len, NAMED))
    for name, system in NAMED.items():
        print(f"{name.ljust(width)}  {system.summary}")
        print(f"{' ' * width}    {system.source}")
    return 0


def _init(parsed: Arguments) -> int:
    from lmdsl.files import write_whole
    from lmdsl.problem import Problem
    from lmdsl.systems import NAMED

    if parsed.name not in NAMED:
        raise BadInput(f"{shown(parsed.name)} is not a system; known: {', '.join(NAMED)}", "NAME")
    path = Path(parsed.out if parsed.out is not None else f"{parsed.name}.json")
    if path.exists():
        raise BadInput(f"{shown(str(path), 200)} exists; remove it or choose another name", "out")
    problem: Problem = Problem.model_validate(NAMED[parsed.name].problem)
    write_whole(path, problem.to_json().encode())
    print(f"written to {safe(str(path))}; next: lmdsl solve {safe(str(path))} --out out")
    return 0


def _backends(parsed: Arguments) -> int:
    from lmdsl import backends

    listed: dict[str, dict[str, Any]] = {}
    for name in backends.names():
        try:
            backend = backends.get(name)
            listed[name] = {
                "available": True,
                "algorithms": list(backend.capabilities.algorithms),
                "not_installed": backends.missing(backend),
            }
        except BadInput as error:
            listed[name] = {"available": False, "reason": error.message}
    if parsed.json:
        _print_json(listed, indent=2)
        return 0
    width = max(map(len, listed))
    for name, entry in listed.items():
        if entry["available"]:
            missing = entry["not_installed"]
            shown_names = [
                f"{algorithm} (not installed: {missing[algorithm]})"
                if algorithm in missing
                else algorithm
                for algorithm in entry["algorithms"]
            ]
            text = ", ".join(shown_names) or "any"
            mark = " (default)" if name == backends.DEFAULT else ""
            print(f"{name.ljust(width)}  algorithms: {text}{mark}")
        else:
            print(f"{name.ljust(width)}  not available: {entry['reason']}")
    return 0


# Output -------------------------------------------------------------------------------------


def safe(text: str) -> str:
    """Return text without control characters, for a terminal."""
    return "".join(ch if ch.isprintable() else "\N{REPLACEMENT CHARACTER}" for ch in text)


def _print_json(data: Any, indent: int | None = None) -> None:
    print(json.dumps(data, allow_nan=False, indent=indent))


def _summary(result: Any) -> str:
    def number(value: float | None, digits: str = ".9g") -> str:
        return "not established" if value is None else format(value, digits)

    seconds = result.seconds
    rows = [
        ("problem", safe(result.problem.name) or "(no name)"),
        ("status", result.status),
        ("backend", f"{result.backend} ({result.solver_status or '-'})"),
        ("cells", f"{result.cells} = {result.attractor_cells} attractor + "
                  f"{result.stabilizable_cells} stabilizable + {_others(result)}"),
        ("pairs", f"{result.pairs} surviving, {result.controls} controls"),
        ("gamma", f"{result.gamma!r}"),
    ]  # fmt: skip
    if result.status != "not_stabilizable":
        rows += [
            ("cost", f"{number(result.cost)} (lower bound {number(result.lower_bound)})"),
            ("gap", f"{number(result.gap, '.2g')} (tolerance {number(result.tolerance, '.2g')})"),
            ("contraction", number(result.contraction)),
            ("polish steps", str(result.polish_steps)),
        ]
    if result.gamma_bar:
        rows.append(("gamma_bar", "{:.9g} to {:.9g}".format(*result.gamma_bar)))
    stages = (("compile", seconds.compile), ("solve", seconds.solve), ("verify", seconds.verify))
    spent = [f"{name} {value:.3f}" for name, value in stages if value is not None]
    rows.append(("seconds", ", ".join(spent) or "-"))
    width = max(len(name) for name, _ in rows)
    lines = [f"{name.ljust(width)}  {value}" for name, value in rows]
    return "\n".join([*lines, "", safe(result.message)])


def _others(result: Any) -> str:
    from lmdsl.graph import CellStatus

    named = {
        CellStatus.ESCAPES: "escaping",
        CellStatus.TRAPPED: "trapped",
        CellStatus.LEADS_TO_THESE: "leading to these",
        CellStatus.AVOID: "avoid",
        CellStatus.BEYOND_GAMMA: "beyond gamma",
    }
    parts = [
        f"{count} {text}"
        for code, text in named.items()
        if (count := int((result.cell_status == code).sum()))
    ]
    return " + ".join(parts) or "0 others"


class _Progress:
    """One line on stderr that overwrites itself, only on a terminal."""

    def __init__(self) -> None:
        self.shown, self.last, self.stage = sys.stderr.isatty(), 0.0, ""

    def __call__(self, stage: str, fraction: float) -> None:
        now = time.monotonic()
        if not self.shown or (stage == self.stage and now - self.last < 0.1):
            return
        self.last, self.stage = now, stage
        percent = f" {100 * fraction:3.0f} %" if fraction >= 0 else " ..."
        print(f"\r\x1b[K{stage}{percent}", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self.shown and self.stage:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
