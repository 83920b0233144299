"""The one command: ``python -m benchmarks``."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from benchmarks import models, ranks, rivals, targets
from benchmarks.measure import Rules
from benchmarks.run import Run

SUITES = ("targets", "rivals", "micro", "scaling", "ranks")


def main() -> int:
    """Measure what was asked for and write the report."""
    options = _options()
    try:
        names = options.models.split(",") if options.models else None
        for name in names or ():
            models.get(name)
        contestants = rivals.chosen(options.rivals.split(",") if options.rivals else None)
    except ValueError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2
    rules = Rules(options.repeats, options.limit, options.budget)
    if options.smoke:
        rules = Rules(1, min(options.limit, 60.0), options.budget, at_once=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # end the contestants, too
    run = Run(options.out, rules, contestants, log=lambda text: print(text, flush=True))
    suites = SUITES if options.suite == "all" else (options.suite,)
    if "ranks" in suites and not options.smoke:
        sizes = ranks.QUICK if options.quick else ranks.SIZES
        ranks.measure(run, _whole(options.cells, sizes), _whole(options.ranks, ranks.COUNTS),
                      options.by_all)  # fmt: skip
        ranks.agree(run, options.quick)
    if options.smoke:
        _smoke(run, names or list(models.SMOKE))
    else:
        _full(run, suites, names, options.largest)
    run.save()
    print(f"written to {options.out / 'results.md'} and {options.out / 'results.json'}")
    return 0


def _whole(text: str | None, default: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(map(int, text.split(","))) if text else default


def _full(run: Run, suites: tuple[str, ...], names: list[str] | None, largest: int) -> None:
    if "rivals" in suites:
        for name in names or models.MODELS:
            run.rivals(name)
    if "micro" in suites:
        for name in names or ("standard-map-200", "standard-map-500", "standard-map-1000"):
            run.stages(name)
    if "scaling" in suites:
        for cells in (cells for cells in targets.SIZES if cells <= largest):
            processes = run.rules.repeats if cells <= 1000 else 1
            run.pipeline(f"standard-map-{cells}", 1.02, processes=processes)
    if "targets" in suites:
        targets.measure(run, largest)


def _smoke(run: Run, names: list[str]) -> None:
    """Run everything once on a tiny model: does it run, do the values agree."""
    for name in names:
        run.rivals(name)
    run.stages(names[0])
    run.pipeline(names[0])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--suite", choices=("all", *SUITES), default="all")
    parser.add_argument("--models", metavar="NAME,...", help="such as standard-map-200")
    parser.add_argument(
        "--rivals", metavar="WORD,...", help="only contestants with these words in their names"
    )
    parser.add_argument("--repeats", type=int, default=5, help="timed solves of each contestant")
    parser.add_argument("--limit", type=float, default=600.0, help="seconds for one solve")
    parser.add_argument(
        "--budget", type=float, default=120.0, help="seconds for all timed solves of a contestant"
    )
    parser.add_argument(
        "--largest", type=int, default=3162, help="most cells an axis in scaling and targets"
    )
    parser.add_argument("--cells", metavar="N,...", help="cells an axis in ranks")
    parser.add_argument("--ranks", metavar="R,...", help="numbers of ranks in ranks")
    parser.add_argument("--by-all", action="store_true", help="in ranks: all evaluate policies")
    parser.add_argument("--quick", action="store_true", help="in ranks: little")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--smoke", action="store_true", help="tiny models, once, under a minute")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
