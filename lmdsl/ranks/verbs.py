"""The verbs of ranks: the same program runs on every rank, and says them in the same order.

A *rank* is one of ``count`` runs of one program, each with cells of its own. Every verb is
*collective*: all ranks say it, and none goes on before it has what it needs of the others. Two
verbs are made by each way of running (alone, threads, MPI): ``exchange`` and ``collect``; the
others follow from them. What must hold:

1. Of the same arguments every way of running makes the same outcome, to the bit: sums are folded
   in the order of the parts, never in that of arrival.
2. An error on one rank ends all. One raised within ``agreed`` is raised on every rank: that of the
   lowest rank, as one process would meet it first. Any other ends the program of all ranks.
3. Ranks that say different verbs, or the same ones different numbers of times, are told apart: each
   message bears its place in the series.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import TimeUp
from lmdsl.errors import LmdslError

Item = TypeVar("Item")

Parcels = Mapping[int, NDArray[Any]]  # an array of one axis for each rank that gets one


class RankError(LmdslError, RuntimeError):
    """Ranks do not fit together: what one said is not what another one expects."""


class Elsewhere(RankError):
    """The work was ended because another rank has failed: a consequence, not a reason."""


@dataclass
class Traffic:
    """What a rank has said so far."""

    calls: int = 0  # number of verbs
    sent: int = 0  # bytes of arrays for other ranks


class Ranks(ABC):
    """One rank among all.

    Attributes
    ----------
    rank, count
        Which one, 0..count-1, of how many.
    traffic
        What it has said so far.
    """

    def __init__(self, rank: int, count: int) -> None:
        self.rank, self.count = rank, count
        self.traffic = Traffic()

    def exchange(
        self, parcels: Parcels, expected: Mapping[int, int] | None = None, kind: Any = np.float64
    ) -> dict[int, NDArray[Any]]:
        """Send arrays to other ranks, and return those that they sent here, by rank.

        ``expected`` are the sizes of those that come, by rank, where they are known: then ranks
        that send each other nothing need not wait for each other, all are of one ``kind``, and a
        parcel of another size is refused. An array for this rank itself comes back as it is.
        """
        others = self._others(parcels)
        if expected is None:
            came, _ = self._exchange(others, False)
        else:
            if any(array.dtype != kind for array in others.values()):
                raise RankError(f"rank {self.rank} sends numbers that are not {np.dtype(kind)}")
            waited = {k: n for k, n in expected.items() if k != self.rank}
            came = self._swap(others, waited, np.dtype(kind))
        if self.rank in parcels:
            came[self.rank] = parcels[self.rank]
        return dict(sorted(came.items()))

    def exchange_news(self, parcels: Parcels) -> tuple[dict[int, NDArray[Any]], bool]:
        """Exchange arrays, none for this rank itself; return whether any rank sent one, too."""
        others = self._others(parcels)
        came, more = self._exchange(others, bool(others))
        return dict(sorted(came.items())), more

    def _others(self, parcels: Parcels) -> dict[int, NDArray[Any]]:
        """Return what goes to other ranks, counted as a verb."""
        wrong = [to for to in parcels if not 0 <= to < self.count]
        if wrong:
            raise RankError(f"rank {self.rank} sends to rank {wrong[0]} of {self.count}")
        others = {to: np.ascontiguousarray(a) for to, a in parcels.items() if to != self.rank}
        self.traffic.calls += 1
        self.traffic.sent += sum(array.nbytes for array in others.values())
        return others

    def collect(self, item: Item) -> list[Item]:
        """Return what every rank gives, in the order of ranks, on every rank."""
        self.traffic.calls += 1
        return self._collect(item)

    def gather(self, item: Item) -> list[Item] | None:
        """Return what every rank gives, in the order of ranks, on rank 0; None on the others."""
        found = self.collect(item)
        return found if self.rank == 0 else None

    def gathered(self, array: NDArray[Any]) -> NDArray[Any] | None:
        """Return the arrays of all ranks one after the other, on rank 0; None on the others."""
        came = self.exchange({0: array})
        return np.concatenate([came[k] for k in range(self.count)]) if self.rank == 0 else None

    def scatter(self, arrays: Iterable[NDArray[Any]] | None) -> NDArray[Any]:
        """Return the array that rank 0 has for this rank; the others give None."""
        parcels = {} if arrays is None or self.rank else dict(enumerate(arrays))
        came = self.exchange(parcels)
        if [*came] != [0]:
            raise RankError(f"rank {self.rank} got no part of what rank 0 scatters")
        return came[0]

    def share(self, item: Item | None) -> Item:
        """Return what rank 0 gives, on every rank."""
        found: Any = self.collect(item if self.rank == 0 else None)[0]
        return found  # type: ignore[no-any-return]

    def reduce(
        self, parts: Iterable[Item], fold: Callable[[Item, Item], Item], empty: Item | None = None
    ) -> Item:
        """Fold the parts of all ranks, in order; ``empty`` begins, where it is given.

        A rank gives one part for each of its ranges of cells, so that the outcome depends on the
        ranges, not on which rank has them.
        """
        every = [part for own in self.collect([*parts]) for part in own]
        found, rest = (every[0], every[1:]) if empty is None else (empty, every)
        for part in rest:
            found = fold(found, part)
        return found

    def any(self, holds: bool) -> bool:
        """Return whether it holds on any rank, on every rank."""
        return any(self.collect(bool(holds)))

    def all(self, holds: bool) -> bool:
        """Return whether it holds on all ranks, on every rank."""
        return all(self.collect(bool(holds)))

    def time_up(self, own: TimeUp) -> TimeUp:
        """Return a question that all ranks ask together, and that all answer alike."""
        return Together(self, own)

    def agreed(self, work: Callable[[], Item]) -> Item:
        """Return ``work()``, in which no verb is said; its error is raised on every rank.

        Of several errors it is that of the lowest rank, of those that are no consequence of
        another. Long work asks a :class:`~lmdsl.ranks.watching.Watched` deadline, which ends it
        once another rank has failed.
        """
        outcome, error = self._tried(work)
        self._end(self.collect(error))
        return outcome

    def told(self, work: Callable[[], Item]) -> list[Item]:
        """Return what ``work()`` returns on every rank, in order, on all; as :meth:`agreed`."""
        every = self.collect(self._tried(work))
        self._end([error for _, error in every])
        return [outcome for outcome, _ in every]

    def by_first(self, work: Callable[[], Item]) -> Item:
        """Return what ``work()`` returns on rank 0, which alone does it, on every rank; as told."""
        found: Any = self.told(lambda: None if self.rank else work())[0]
        return found  # type: ignore[no-any-return]

    def _tried(self, work: Callable[[], Item]) -> tuple[Item, Exception | None]:
        """Return what work returns, or the error that it raises, of which others are warned."""
        outcome: Any = None
        try:
            return work(), None
        except Exception as error:
            if not isinstance(error, Elsewhere):
                self._warn()
            return outcome, error

    def _end(self, every: list[Exception | None]) -> None:
        """Raise the error that is to be raised on all ranks, if any."""
        failed = [k for k, e in enumerate(every) if e is not None and not isinstance(e, Elsewhere)]
        self._calm(failed)
        first = next((every[k] for k in failed), None)
        if first is not None:
            vars(first)["agreed"] = True  # see :func:`lmdsl.ranks.ending.together`
            raise first

    def alike(self, item: Any, what: str) -> None:
        """Refuse ranks that do not all have the same item: files, versions, sizes."""
        every = self.collect(item)
        odd = [k for k, other in enumerate(every) if other != every[0]]
        if odd:
            error = RankError(
                f"ranks see different {what}: rank {odd[0]} has {every[odd[0]]!r}, rank 0 "
                f"{every[0]!r}; start all of them from the same folder, file and installation"
            )
            vars(error)["agreed"] = True  # each has found the same
            raise error

    @abstractmethod
    def trouble(self) -> bool:
        """Return whether another rank has failed in the work that is agreed now."""

    @abstractmethod
    def _warn(self) -> None:
        """Tell the others, in their work, that this rank has failed in the same."""

    @abstractmethod
    def _calm(self, failed: list[int]) -> None:
        """Note which ranks had failed, once all have ended their work."""

    @abstractmethod
    def _exchange(
        self, parcels: dict[int, NDArray[Any]], more: bool
    ) -> tuple[dict[int, NDArray[Any]], bool]: ...

    @abstractmethod
    def _swap(
        self, parcels: dict[int, NDArray[Any]], expected: dict[int, int], kind: np.dtype[Any]
    ) -> dict[int, NDArray[Any]]: ...

    @abstractmethod
    def _collect(self, item: Item) -> list[Item]: ...


@dataclass(frozen=True)
class Together:
    """A question that all ranks ask together, and that all answer alike."""

    ranks: Ranks
    own: TimeUp  # what this rank asks for itself

    def __call__(self) -> bool:
        """Return whether any rank answers yes."""
        return self.ranks.any(self.own())


class Alone(Ranks):
    """The only rank: nobody to talk to."""

    def __init__(self) -> None:
        super().__init__(0, 1)

    def trouble(self) -> bool:
        """Return False: there is no other rank."""
        return False

    def _warn(self) -> None:
        pass

    def _calm(self, failed: list[int]) -> None:
        pass

    def _exchange(
        self, parcels: dict[int, NDArray[Any]], more: bool
    ) -> tuple[dict[int, NDArray[Any]], bool]:
        return {}, more

    def _swap(
        self, parcels: dict[int, NDArray[Any]], expected: dict[int, int], kind: np.dtype[Any]
    ) -> dict[int, NDArray[Any]]:
        if expected:
            raise RankError(f"rank 0 is alone, and expects an array of rank {min(expected)}")
        return {}

    def _collect(self, item: Item) -> list[Item]:
        return [item]


def require_expected(
    rank: int, came: Mapping[int, NDArray[Any]], expected: Mapping[int, int]
) -> None:
    """Refuse arrays that are not those that were to come."""
    for other in sorted({*came, *expected}):
        size = len(came[other]) if other in came else 0
        if size != expected.get(other, 0):
            raise RankError(
                f"rank {rank} expects {expected.get(other, 0)} numbers of rank {other}, and got "
                f"{size}"
            )
