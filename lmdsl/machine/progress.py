"""Progress for people: a line on stderr that overwrites itself, with the time that is left.

What is told is a stage and the fraction of it that is done, or -1 where that is not known.
"""

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Self

from lmdsl.errors import printable

Clock = Callable[[], float]

SOON = 2.0  # seconds of a stage before which it is not said how long it takes
OFTEN, SELDOM = 0.1, 10.0  # seconds between two lines, where they replace each other and elsewhere


def spoken(seconds: float) -> str:
    """Return a time in the words of people."""
    for unit, size, most in (("s", 1, 90), ("min", 60, 90), ("h", 3600, 48)):
        if seconds < size * most:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400:.0f} days"


def family(stage: str) -> str:
    """Return the name of a stage, without what changes as it goes on."""
    return stage.split(",")[0].split(" (")[0]


class Pace:
    """How fast a stage goes, and how long it will take at this rate."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self.clock, self.stage = clock, ""
        self.began = self.first = self.last = 0.0

    def left(self, stage: str, fraction: float) -> float | None:
        """Return seconds left of a stage; None where that is not known, or too early to say."""
        now, name = self.clock(), family(stage)
        if name != self.stage or fraction < self.last:  # it begins, or begins again
            self.stage, self.began, self.first = name, now, max(fraction, 0.0)
        self.last = max(fraction, 0.0)
        spent, done = now - self.began, fraction - self.first
        if done <= 0 or spent < SOON:
            return None
        return spent * (1 - min(fraction, 1.0)) / done


class ProgressLine:
    """One line on stderr that overwrites itself.

    Only on a terminal; or, where it ``always`` has to be shown, in notebooks too, and as a line
    every ten seconds where nothing can be overwritten.
    """

    def __init__(self, always: bool = False, clock: Clock = time.monotonic) -> None:
        self.stream, self.clock, self.pace = sys.stderr, clock, Pace(clock)
        self.terminal = bool(self.stream is not None and self.stream.isatty())
        self.notebook = not self.terminal and notebook() is not None
        self.shown = self.terminal or (always and self.stream is not None)
        self.last, self.stage, self.width = 0.0, "", 0

    def __call__(self, stage: str, fraction: float) -> None:
        """Show a stage and the fraction done (-1: unknown)."""
        left, name = self.pace.left(stage, fraction), family(stage)
        now, over = self.clock(), self.terminal or self.notebook
        rarely = OFTEN if over else SELDOM
        if not self.shown or (name == self.stage and now - self.last < rarely):
            return
        self.last, self.stage = now, name
        text = f"{stage} {100 * fraction:3.0f} %" if fraction >= 0 else f"{stage} ..."
        if left is not None and " left" not in stage:
            text += f", about {spoken(left)} left"
        self._print(text)

    def _print(self, text: str) -> None:
        if self.terminal:
            line, end = f"\r\x1b[K{text}", ""
        elif self.notebook:
            line, end = f"\r{text.ljust(self.width)}", ""
            self.width = len(text)
        else:
            line, end = f"lmdsl: {text}", "\n"
        print(line, end=end, file=self.stream, flush=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.shown and self.stage and (self.terminal or self.notebook):
            self._print("")
            print("\r" * self.notebook, end="", file=self.stream, flush=True)


class Forecast:
    """Tells how far a proof is in time: how much is decided says little, the last share takes long.

    What is open falls like a power of the time spent, as far as is seen. What is told is the part
    of the time, until as much is decided as wanted or the limit is reached, that is over.
    """

    def __init__(
        self, tell: Callable[[str, float], None], target: float, limit: float | None,
        clock: Clock = time.monotonic,
    ) -> None:  # fmt: skip
        self.tell, self.limit, self.clock = tell, limit, clock
        self.goal, self.began = max(1.0 - target, 1e-6), clock()
        self.seen: list[tuple[float, float]] = []  # time spent, and what was open

    def __call__(self, stage: str, fraction: float) -> None:
        """Tell a stage; of ``prove`` the fraction is what is decided."""
        spent = max(self.clock() - self.began, 1e-9)
        whole = self.limit
        if stage == "prove":
            stage = f"prove ({100 * fraction:.4g} % decided)"
            self.seen.append((spent, max(1.0 - fraction, 1e-12)))
            expected = self._whole()
            whole = expected if whole is None or (expected and expected < whole) else whole
        self.tell(stage, -1.0 if whole is None else min(spent / whole, 1.0))

    def _whole(self) -> float | None:
        """Return the time after which little enough is open; None where nothing points there."""
        now, open_ = self.seen[-1]
        if open_ <= self.goal:
            return now
        before = next((each for each in reversed(self.seen) if each[0] < now / 2), None)
        if before is None or before[1] <= open_:
            return None
        power = math.log(before[1] / open_) / math.log(now / before[0])
        doublings = math.log(open_ / self.goal) / power
        return now * math.exp(doublings) if doublings < 50 else None


class Counted:
    """A guard that tells how far the work is by how often it was called, of so many times."""

    def __init__(
        self, guard: Callable[[], object], tell: Callable[[str, float], None], times: int
    ) -> None:
        self.guard, self.tell, self.times, self.calls = guard, tell, max(times, 1), 0
        tell("verify", -1.0)

    def __call__(self) -> None:
        """Call the guard, and tell."""
        self.guard()
        self.calls += 1
        self.tell("verify", min(self.calls / self.times, 1.0))


def notebook() -> Any:
    """Return the shell of the notebook that runs, None elsewhere; nothing is imported for it."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell if hasattr(shell, "kernel") else None


class Narrator(logging.Handler):
    """What lmdsl logs, on stderr: its warnings; on a terminal, while kernels are compiled, that."""

    compiled = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Show a record; a line about kernels goes when they are done."""
        busy, text = getattr(record, "busy", None), f"lmdsl: {printable(record.getMessage())}\n"
        if busy is not None:
            text = f"compiling kernels, once ({self.compiled} done) ..." if busy else ""
            self.compiled += not busy
        with suppress(OSError, ValueError, AttributeError):  # stderr may be closed, or None
            terminal = sys.stderr.isatty()
            if busy is None or terminal:
                sys.stderr.write("\r\x1b[K" * terminal + text)
                sys.stderr.flush()


@contextmanager
def narrated() -> Iterator[None]:
    """Show what lmdsl logs while something runs; inside another one nothing is shown twice."""
    log, narrator = logging.getLogger("lmdsl"), Narrator()
    if any(isinstance(handler, Narrator) for handler in log.handlers):
        yield
        return
    level = log.level
    log.addHandler(narrator)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.setLevel(level)
        log.removeHandler(narrator)


@contextmanager
def followed() -> Iterator[Any]:
    """Show the progress of a call, and what it logs: for ``progress=True``."""
    with narrated(), ProgressLine(always=True) as line:
        yield line
