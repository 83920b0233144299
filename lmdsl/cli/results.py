"""What is done with a result directory: ``verify``, ``simulate``, ``prove`` and others."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

from lmdsl.cli import plotting
from lmdsl.cli.output import AS_STORED, Arguments, Command, ProgressLine, answer, print_json, shared
from lmdsl.cli.streams import say
from lmdsl.cli.values import parameters, states
from lmdsl.errors import printable
from lmdsl.results.formats import FORMATS

if TYPE_CHECKING:
    from lmdsl.control.simulation import Simulation


def add(command: Command) -> None:
    """Add the commands of this module."""
    verify = command("verify", _verify, "Recompile a saved result and check every claim.")
    shared(verify, "dir")
    verify.add_argument("--exact", action="store_true",
                        help="judge in rational arithmetic, without tolerance")  # fmt: skip
    shared(verify, "--time-limit", "--rows-on-disk", "--json")

    _add_simulate(command)

    prove = command("prove", _prove, "Prove what the controller does on the true map, by volume.")
    shared(prove, "dir")
    prove.add_argument("--target", type=float, default=0.999, metavar="T",
                       help="share that is to arrive (default 0.999)")  # fmt: skip
    prove.add_argument("--bracket", action="store_true",
                       help="bound what any control law costs, too")  # fmt: skip
    shared(prove, "--time-limit", "--json")

    plot = command("plot", plotting.run, "Draw the figures of a saved result.")
    shared(plot, "dir")
    plotting.add(plot)

    _add_report(command)
    export = command("export", _export, "Write a saved result in a format for other readers.")
    shared(export, "dir")
    uses = "; ".join(f"{name}: {use}" for name, use in FORMATS.items())
    export.add_argument("--format", required=True, choices=FORMATS, help=uses)
    export.add_argument("--out", required=True, metavar="FILE", help="file to write")
    shared(export, "--time-limit")


def _add_report(command: Command) -> None:
    report = command("report", _report, "Write one page about a saved result: HTML, no network.")
    shared(report, "dir")
    report.add_argument("--out", metavar="FILE", help="file ending in .html (DIR/report.html)")
    report.add_argument("--verify", dest="check", action="store_true",
                        help="check every claim again, and say on the page what holds")  # fmt: skip
    report.add_argument("--backends", default="", metavar="A,B",
                        help="compare these backends on the page")  # fmt: skip
    report.add_argument("--seed", type=int, default=0, metavar="S", help="of the runs shown")
    shared(report, "--time-limit")


def _add_simulate(command: Command) -> None:
    sub = command("simulate", _simulate, "Run the true map under a saved controller.")
    shared(sub, "dir")
    sub.add_argument("--starts", type=int, default=10_000, metavar="N",
                     help="random runs (default 10000)")  # fmt: skip
    sub.add_argument("--from", dest="given", action="append", metavar="X,Y",
                     help="a state to start from, instead; may be repeated")  # fmt: skip
    sub.add_argument("--parameter", action="append", default=[], metavar="NAME=VALUE",
                     help="another value of a parameter; may be repeated")  # fmt: skip
    sub.add_argument("--steps", type=int, default=10_000, metavar="T",
                     help="steps of each run at most (default 10000)")  # fmt: skip
    sub.add_argument("--seed", type=int, default=0, metavar="S",
                     help="of starts and noise (default 0)")  # fmt: skip
    sub.add_argument("--hold", type=int, default=1_000, metavar="T",
                     help="with a local controller, steps after the arrival")  # fmt: skip
    sub.add_argument("--interpolated", action="store_true",
                     help="also under the controller interpolated between cells")  # fmt: skip
    sub.add_argument("--as-compiled", action="store_true",
                     help="follow the compiled steps and noise nodes")  # fmt: skip
    shared(sub, "--time-limit", "--json")


def _verify(parsed: Arguments) -> int:
    from lmdsl.results.verification import verify

    with ProgressLine() as progress:
        found = verify(
            parsed.dir, exact=parsed.exact, progress=progress, time_limit=parsed.time_limit,
            rows_on_disk=parsed.rows_on_disk,
        )  # fmt: skip
    answer(parsed, found)
    return 0 if found.holds else 1


def _simulate(parsed: Arguments) -> int:
    from lmdsl.control.controller import Law
    from lmdsl.results.result import Result

    result = Result.load(parsed.dir)
    laws: list[Law] = ["constant", "interpolated"]
    with ProgressLine() as progress:
        progress("simulate", -1.0)
        found = [
            result.simulate(
                parsed.starts if parsed.given is None else [states(text) for text in parsed.given],
                parsed.steps, parsed.seed, parsed.hold, parsed.time_limit,
                as_compiled=parsed.as_compiled, parameters=parameters(parsed.parameter), mode=law,
            )
            for law in laws[: 1 + parsed.interpolated]
        ]  # fmt: skip
    tell_runs(found, parsed.json)
    return 0


def tell_runs(found: Sequence[Simulation], as_json: bool) -> None:
    """Say what became of runs, by each law of the controller."""
    if as_json:
        report, *others = (runs.to_dict() for runs in found)
        print_json({**report, "interpolated": others[0] if others else None})
        print(f"lmdsl: {AS_STORED}", file=sys.stderr)
        return
    say("\n".join([*(runs.text() for runs in found), f"({AS_STORED})"]))


def _prove(parsed: Arguments) -> int:
    from lmdsl.results.directory import proved
    from lmdsl.results.result import Result

    result = Result.load(parsed.dir)
    with ProgressLine() as progress:
        proof = result.prove(
            parsed.target, parsed.time_limit, bracket=parsed.bracket, progress=progress
        )
    proved.add(parsed.dir, result, proof)
    answer(parsed, proof)
    return 0 if proof.reached else 1


def _report(parsed: Arguments) -> int:
    from lmdsl.report.writing import write_directory

    names = tuple(name.strip() for name in parsed.backends.split(",") if name.strip())
    with ProgressLine() as progress:
        path, found = write_directory(
            parsed.dir, parsed.out, check=parsed.check, backends=names, seed=parsed.seed,
            time_limit=parsed.time_limit, progress=progress,
        )  # fmt: skip
    checked = AS_STORED if found is None else "every claim holds"
    if found is not None and not found.holds:
        checked = "NOT confirmed: " + "; ".join(map(printable, found.reasons))
    say(f"written to {printable(str(path))} ({checked})")
    return int(found is not None and not found.holds)


def _export(parsed: Arguments) -> int:
    from lmdsl.results.directory.writing import refuse_own_file
    from lmdsl.results.result import Result
    from lmdsl.results.verification import recompiled

    refuse_own_file(parsed.out)
    result = Result.load(parsed.dir)
    with ProgressLine() as progress:
        lp = recompiled(parsed.dir, result, progress, parsed.time_limit)
    import_module(f"lmdsl.results.exports.{parsed.format}").write(result, lp, parsed.out)
    say(f"written to {printable(parsed.out)}")
    return 0
