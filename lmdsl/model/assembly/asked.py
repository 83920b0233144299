"""A user's own functions while they are sampled: audits, the time they take, who calls them."""

import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

from lmdsl.common.types import Floats, Guard
from lmdsl.machine import threads
from lmdsl.machine.progress import spoken
from lmdsl.systems.black_box.audit import Audit
from lmdsl.systems.black_box.function_map import FunctionMap
from lmdsl.systems.black_box.scalar_map import ScalarMap

Part = TypeVar("Part")
Outcome = TypeVar("Outcome")

log = logging.getLogger(__name__)

# Seconds of calls from which the caller is told beforehand.
LONG = 60.0

# Seconds that the calls of a block may take: progress is told after each.
BLOCK = 0.25


class Asked:
    """The functions among a map and its cost.

    Attributes
    ----------
    maps
        The functions, as maps; none where all is formulas.
    singles
        Those of them that are called sample by sample.
    """

    def __init__(self, *maps: Any) -> None:
        self.maps = [each for each in maps if isinstance(each, FunctionMap)]
        self.singles = [each for each in self.maps if isinstance(each, ScalarMap)]
        self._audits: dict[int, Audit] = {}
        self._calls, self._begun = 0, 0.0

    def audit(self, values: Mapping[str, Floats], guard: Guard) -> None:
        """Ask about some samples, before all; from then on some of every block again."""
        self._audits = {id(each): each.audit(values, guard) for each in self.maps}

    def alone(self, asked: Any, values: Mapping[str, Floats], found: Sequence[Floats]) -> None:
        """Ask for some of the samples that have these results one by one."""
        if id(asked) in self._audits:
            self._audits[id(asked)].alone(asked.taken(values), found)

    def again(self) -> None:
        """Ask once more what was asked before all."""
        for audit in self._audits.values():
            audit.again()

    @contextmanager
    def helped(self) -> Iterator[None]:
        """Keep the processes that make the calls, where some are asked for."""
        with ExitStack() as stack:
            for each in self.maps:
                stack.enter_context(each.helped())
            yield

    def in_order(
        self,
        work: Callable[[Part], Outcome],
        parts: Iterable[Part],
        cancel: Callable[[], object],
    ) -> Iterator[Outcome]:
        """Yield ``work(part)`` in order; only what several threads may call is shared by them."""
        if self.singles:
            return map(work, parts)
        return threads.in_order(work, parts, cancel)

    @property
    def pace(self) -> float:
        """Seconds that a sample takes, as far as it is known; else infinite, or 0."""
        return sum(each.pace / (each.processes or 1) for each in self.singles)

    def chunk(self, most: int) -> int:
        """Return how many samples to take at a time."""
        return most if not 0 < self.pace < math.inf else min(most, int(BLOCK / self.pace) + 1)

    def announce(self, samples: int) -> None:
        """Say how long the calls for so many samples take, where that is long."""
        self._calls, self._begun = samples * len(self.singles), time.perf_counter()
        seconds = self.pace * samples
        if self.singles and LONG < seconds < math.inf:
            fields = " and ".join(each.results.where for each in self.singles)
            log.warning(
                "%s: %s calls of the function take about %s; fewer cells, controls or sample "
                "points need fewer calls, and processes= shares them",
                fields, f"{self._calls:,}", spoken(seconds),
            )  # fmt: skip

    def stage(self, done: float) -> str:
        """Return what is being done, for who is told the progress: part of it is ``done``."""
        if not self.singles or not 0 < done <= 1:
            return "transitions"
        left = (time.perf_counter() - self._begun) * (1 - done) / done
        return f"transitions, {self._calls:,} calls, about {spoken(left)} left"
