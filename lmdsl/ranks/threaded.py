"""Ranks as threads of one process: for tests, and for the memory of one machine.

They talk over boards: every rank puts on the board what it says, all meet, and each reads what is
for it. A rank that ends early breaks the meeting, so that none waits for it.
"""

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lmdsl.ranks.verbs import Item, RankError, Ranks, require_expected

Outcome = TypeVar("Outcome")


class Left(RankError):
    """Another rank has ended; what it raised is the reason."""


class Board:
    """Where ranks meet."""

    def __init__(self, count: int) -> None:
        self.meeting = threading.Barrier(count)
        self.said: list[Any] = [None] * count
        self.failed = 0  # number of the verb before which a rank failed


class ThreadRanks(Ranks):
    """A rank that is a thread."""

    def __init__(self, rank: int, board: Board) -> None:
        super().__init__(rank, len(board.said))
        self.board = board

    def trouble(self) -> bool:
        """Return whether another rank has failed in the work that is agreed now."""
        return self.board.failed > self.traffic.calls

    def _warn(self) -> None:
        self.board.failed = self.traffic.calls + 1

    def _calm(self, failed: list[int]) -> None:
        pass  # later work has a later number

    def _met(self, verb: str, item: Any) -> list[Any]:
        """Say something; return what all said. It is read before anybody says more."""
        board = self.board
        board.said[self.rank] = verb, self.traffic.calls, item
        try:
            board.meeting.wait()
            said = list(board.said)
            board.meeting.wait()
        except threading.BrokenBarrierError:
            raise Left(f"rank {self.rank} waits for a rank that has ended") from None
        for other, (its, calls, _) in enumerate(said):
            if (its, calls) != (verb, self.traffic.calls):
                raise RankError(
                    f"rank {self.rank} says {verb!r} as its verb number {self.traffic.calls}, rank "
                    f"{other} {its!r} as number {calls}"
                )
        return [item for *_, item in said]

    def _exchange(
        self, parcels: dict[int, NDArray[Any]], more: bool
    ) -> tuple[dict[int, NDArray[Any]], bool]:
        # A copy: whoever sends may write to its own array from here on.
        said = self._met("exchange", ({to: array.copy() for to, array in parcels.items()}, more))
        came = {k: own[self.rank] for k, (own, _) in enumerate(said) if self.rank in own}
        return came, any(its for _, its in said)

    def _swap(
        self, parcels: dict[int, NDArray[Any]], expected: dict[int, int], kind: np.dtype[Any]
    ) -> dict[int, NDArray[Any]]:
        came, _ = self._exchange(parcels, False)
        require_expected(self.rank, came, expected)
        return came

    def _collect(self, item: Item) -> list[Item]:
        return self._met("collect", item)


def as_threads(count: int, program: Callable[[Ranks], Outcome]) -> list[Outcome]:
    """Return what a program returns on every rank.

    Where ranks raise, all end; the error of the rank that did not just miss another one is raised.
    """
    board = Board(count)
    outcomes: list[Any] = [None] * count
    errors: dict[int, BaseException] = {}

    def run(rank: int) -> None:
        try:
            outcomes[rank] = program(ThreadRanks(rank, board))
        except BaseException as error:
            errors[rank] = error
            board.meeting.abort()

    threads = [threading.Thread(target=run, args=(rank,), daemon=True) for rank in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise min(errors.items(), key=lambda found: (isinstance(found[1], Left), found[0]))[1]
    return outcomes
