"""The command line under a launcher that started several ranks.

Every rank runs the same command; rank 0 alone talks. An error that all meet alike is said by it,
any other one by the rank that met it, which ends all.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from lmdsl import cli
from lmdsl.cli.output import Arguments, ProgressLine, answer, narrated, print_json
from lmdsl.cli.solving import problem_asked, simulated, summary
from lmdsl.cli.streams import kept, muted, say
from lmdsl.errors import BadInput, MissingDependency, printable
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
    known: dict[str, Callable[[Ranks, Arguments], int]] = {"solve": _solve, "verify": _verify}
    return known.get(parsed.command, _refuse)


def _by_first(ranks: Ranks, parsed: Arguments) -> int:
    status = ranks.agreed(lambda: int(parsed.run(parsed)) if ranks.rank == 0 else 0)
    return ranks.share(status)


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
    status, result = int(found.exit_status), found
    try:
        if parsed.out is not None and found.model_sha256:  # else no time to compile
            saving.save(ranks, found, parsed.out)
            if not parsed.json:
                say(f"written to {printable(parsed.out)}")
        if parsed.simulate and found.model_sha256:
            result = simulated_by_first(ranks, found)
    finally:
        if parsed.json:
            print_json(result.to_dict())
    if result.simulation and not parsed.json:
        word = "verified" if found.verified else "not verified"
        say(f"{word} on the finite model; {result.simulation.sentence()}")
    return status


def _verify(ranks: Ranks, parsed: Arguments) -> int:
    from lmdsl.distributed.verifying import verify

    with ProgressLine() as progress:
        found = verify(
            parsed.dir, exact=parsed.exact, progress=progress, time_limit=parsed.time_limit,
            ranks=ranks,
        )  # fmt: skip
    answer(parsed, found)
    return 0 if found.holds else 1


def simulated_by_first(ranks: Ranks, answer: Any) -> Any:
    """Return an answer with the runs that rank 0 makes, on rank 0."""
    from lmdsl.distributed.using import in_use

    whole = in_use(ranks, answer)
    found = ranks.agreed(lambda: None if whole is None else simulated(whole))
    return answer if found is None else answer.with_runs(found.simulation)


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
