"""The command line under a launcher that started several ranks.

Every rank runs the same command; rank 0 alone talks. An error that all meet alike is said by it,
any other one by the rank that met it, which ends all.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lmdsl import cli
from lmdsl.cli.output import Arguments, ProgressLine, answer, narrated, print_json
from lmdsl.cli.results import tell_runs
from lmdsl.cli.solving import SECONDS, STARTS, STEPS, problem_asked, summary
from lmdsl.cli.streams import kept, muted, say
from lmdsl.errors import BadInput, LmdslError, MissingDependency, plain_text, printable
from lmdsl.ranks.ending import together
from lmdsl.ranks.launchers import Launched
from lmdsl.ranks.mpi import at_hand
from lmdsl.ranks.verbs import Ranks

# Commands that take a moment and need no other rank.
BY_FIRST = ("schema", "systems", "init", "backends", "completion")


def main(arguments: Sequence[str] | None, launched: Launched) -> int:
    """Run the command line on this rank and return its exit status."""
    with kept() as answers:
        with silent(launched.rank > 0):
            try:
                with contextlib.redirect_stdout(answers if launched.rank == 0 else sys.stdout):
                    parsed = cli.parser().parse_args(arguments)
            except SystemExit as stop:
                return int(stop.code or 0)
            try:
                ranks = at_hand()
            except MissingDependency as error:
                return cli.failed(parsed, error)
        given = sys.argv[1:] if arguments is None else arguments
        return together(ranks, lambda ranks: _run(ranks, parsed, given))


@contextlib.contextmanager
def silent(asked: bool) -> Iterator[None]:
    """Let nothing be said, where that is asked for."""
    if not asked:
        yield
        return
    with (
        open(os.devnull, "w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
        muted(),
    ):
        yield


def _run(ranks: Ranks, parsed: Arguments, given: Sequence[str]) -> int:
    """Run a command on this rank; an error of all is an exit status."""
    with silent(ranks.rank > 0):
        try:
            with narrated():
                ranks.alike(" ".join(given), "commands")
                ranks.alike(os.getcwd(), "folders")
                return _command(parsed)(ranks, parsed)
        except (Exception, KeyboardInterrupt) as error:
            if not getattr(error, "agreed", False):
                raise
            return cli.failed(parsed, error)


def _command(parsed: Arguments) -> Callable[[Ranks, Arguments], int]:
    """Return what runs a command over ranks."""
    if parsed.command in BY_FIRST:
        return _by_first
    known = {"solve": _solve, "verify": _verify, "simulate": _simulate}
    return known.get(parsed.command, _refuse)


def _by_first(ranks: Ranks, parsed: Arguments) -> int:
    return ranks.by_first(lambda: int(parsed.run(parsed)))


def _refuse(ranks: Ranks, parsed: Arguments) -> int:
    message = f"lmdsl {parsed.command} does not run over several ranks; start one process"

    def refuse() -> int:
        raise BadInput(message)

    return ranks.agreed(refuse)


def _solve(ranks: Ranks, parsed: Arguments) -> int:
    from lmdsl.distributed import saving, solving

    ranks.agreed(lambda: _require_supported(parsed))
    if parsed.out is not None:
        saving.require_place(ranks, parsed.out)
    problem = ranks.agreed(lambda: problem_asked(parsed))
    names = ("tolerance", "time_limit", "require_all", "restrict_to_gamma", *solving.FOLDERS)
    options = {name: getattr(parsed, name) for name in names}
    wanted = ranks.agreed(lambda: solving.asked(problem, **options))
    with ProgressLine() as progress:
        found = solving.solved(ranks, problem, wanted, progress if ranks.rank == 0 else None)
    if not parsed.json:  # reported first: whatever saving meets, the answer was given
        say(summary(found))
    status, result, saved = int(found.exit_status), found, False
    try:
        if parsed.out is not None and found.model_sha256:  # else no time to compile
            saved = _saved(ranks, found, parsed)
            status = status if saved else 2
        if parsed.simulate and found.model_sha256:
            result = _with_runs(ranks, found, parsed, saved)
    finally:
        if parsed.json:
            print_json(result.to_dict())
    if result.simulation and not parsed.json:
        word = "verified" if found.verified else "not verified"
        say(f"{word} on the finite model; {result.simulation.sentence()}")
    return status


def _saved(ranks: Ranks, found: Any, parsed: Arguments) -> bool:
    """Save an answer; return whether that was possible: what is known is known all the same."""
    from lmdsl.distributed import saving

    try:
        saving.save(ranks, found, parsed.out)
    except (LmdslError, MemoryError) as error:
        if not getattr(error, "agreed", False):
            raise
        text = f"lmdsl: {str(error) or 'out of memory'}; nothing was saved"
        print(printable(text), file=sys.stderr)
        return False
    if not parsed.json:
        say(f"written to {printable(parsed.out)}")
    return True


def _verify(ranks: Ranks, parsed: Arguments) -> int:
    from lmdsl.distributed.verifying import verify

    with ProgressLine() as progress:
        found = verify(
            parsed.dir, exact=parsed.exact, progress=progress, time_limit=parsed.time_limit,
            rows_on_disk=parsed.rows_on_disk, ranks=ranks,
        )  # fmt: skip
    answer(parsed, found)
    return 0 if found.holds else 1


def _simulate(ranks: Ranks, parsed: Arguments) -> int:
    """Make runs, divided among the ranks; those that are asked for otherwise by rank 0 alone."""
    from lmdsl.distributed import loading, simulating

    if parsed.given or parsed.parameter or parsed.interpolated or parsed.as_compiled:
        return _by_first(ranks, parsed)
    law = simulating.stored(loading.read(ranks, parsed.dir).result)
    with ProgressLine() as progress:
        progress("simulate", -1.0)
        runs = simulating.simulated(ranks, law, parsed.starts, parsed.steps, parsed.seed,
                                    parsed.hold, parsed.time_limit)  # fmt: skip
    tell_runs([runs], parsed.json)
    return 0


def _with_runs(ranks: Ranks, found: Any, parsed: Arguments, saved: bool) -> Any:
    """Return an answer with runs of the true map, where there is a controller."""
    from lmdsl.distributed import simulating

    if not ranks.any(bool((found.control_index >= 0).any())):
        return found
    law = simulating.gathered(ranks, found) if not saved else ranks.agreed(
        lambda: simulating.saved(found, Path(parsed.out))
    )  # fmt: skip
    try:
        with ProgressLine() as progress:
            progress("simulate", -1.0)
            runs = simulating.simulated(ranks, law, STARTS, STEPS, time_limit=SECONDS)
    except Exception as error:
        if not getattr(error, "agreed", False):
            raise
        print(f"lmdsl: not simulated: {plain_text(error)}", file=sys.stderr)
        return found
    return found.with_runs(runs)


def _require_supported(parsed: Arguments) -> None:
    """Refuse options that do not run over ranks."""
    given = {
        "--backend": parsed.backend != "policy-iteration",
        "--max-iterations": parsed.max_iterations is not None,
        "--proved": parsed.proved is not None,
    }
    for name, asked in given.items():
        if asked:
            message = "does not run over several ranks; leave it out, or start one process"
            raise BadInput(message, name)
