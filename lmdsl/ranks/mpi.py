"""Ranks under MPI, by mpi4py: ``mpiexec -n R ...``.

Nothing here is imported unless the program was started by a launcher. Messages are arrays as they
lie in memory; what is small and of any kind is pickled: it comes from the same program.
"""

import pickle
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import MissingDependency
from lmdsl.machine import memory, threads
from lmdsl.ranks.launchers import launched
from lmdsl.ranks.verbs import Alone, Item, RankError, Ranks, require_expected

# Of messages between two ranks, of those that one has failed, and that one ends all.
TAG, TROUBLE, ENDING = 7, 8, 9
KINDS = "?bhilqBHILQfd"  # types of arrays, by NumPy's character
SMALL = 512  # bytes up to which all that is collected goes in one round

# Seconds for which a rank waits attentively, then asleep: at first, at most. MPI alone keeps a
# processor busy, which others need that share it.
ATTENTIVE, NAP, LONGEST_NAP = 1e-4, 2e-5, 1e-3


class MpiRanks(Ranks):
    """A rank that is a process of MPI."""

    def __init__(self, world: Any) -> None:
        self.world = world.Dup()  # apart from what others send
        super().__init__(self.world.Get_rank(), self.world.Get_size())
        self._told: list[Any] = []  # messages of trouble that are on their way

    def trouble(self) -> bool:
        """Return whether another rank has failed in the work that is agreed now."""
        from mpi4py import MPI

        return bool(self.world.Iprobe(MPI.ANY_SOURCE, TROUBLE))

    def _warn(self) -> None:
        others = [k for k in range(self.count) if k != self.rank]
        self._told = [self.world.Isend(np.empty(0, np.uint8), k, TROUBLE) for k in others]

    def _calm(self, failed: list[int]) -> None:
        for k in failed:
            if k != self.rank:
                self.world.Recv(np.empty(0, np.uint8), k, TROUBLE)
        while self._told:
            self._told.pop().Wait()

    def _exchange(
        self, parcels: dict[int, NDArray[Any]], more: bool
    ) -> tuple[dict[int, NDArray[Any]], bool]:
        # Of every array: its place in the series, type and size, -1 where none is sent; more.
        head = np.full((self.count, 4), -1, dtype=np.int64)
        head[:, 0], head[:, 3] = self.traffic.calls, more
        for to, array in parcels.items():
            head[to, 1:3] = KINDS.index(array.dtype.char), len(array)
        heads = np.empty_like(head)
        waited(self.world.Ialltoall(head, heads).Test)
        self._require_alike(heads[:, 0])
        came = {
            int(k): np.empty(heads[k, 2], dtype=KINDS[heads[k, 1]])
            for k in np.flatnonzero(heads[:, 2] >= 0)
        }
        self._move(parcels, came)
        return came, bool(heads[:, 3].any())

    def _swap(
        self, parcels: dict[int, NDArray[Any]], expected: dict[int, int], kind: np.dtype[Any]
    ) -> dict[int, NDArray[Any]]:
        # One number more, so that an array that is too long is seen.
        came = {k: np.empty(n + 1, dtype=kind) for k, n in expected.items()}
        sizes = self._move(parcels, came)
        came = {k: array[: sizes[k]] for k, array in came.items()}
        require_expected(self.rank, came, expected)
        return came

    def _move(
        self, parcels: dict[int, NDArray[Any]], into: dict[int, NDArray[Any]]
    ) -> dict[int, int]:
        """Send arrays, and receive others; return the sizes of those that came."""
        from mpi4py import MPI

        some = {k: a for k, a in into.items() if len(a)}
        requests = [self.world.Irecv(as_bytes(a), k, TAG) for k, a in some.items()]
        requests += [self.world.Isend(as_bytes(a), k, TAG) for k, a in parcels.items() if len(a)]
        statuses = [MPI.Status() for _ in requests]
        waited(lambda: MPI.Request.Testall(requests, statuses))
        sizes = dict.fromkeys(into, 0)
        for (k, array), status in zip(some.items(), statuses, strict=False):
            sizes[k] = status.Get_count(MPI.BYTE) // array.itemsize
        return sizes

    def _collect(self, item: Item) -> list[Item]:
        text = pickle.dumps((self.traffic.calls, item), pickle.HIGHEST_PROTOCOL)
        own = np.zeros(SMALL, dtype=np.uint8)
        own[:8] = np.array([len(text)], dtype=np.int64).view(np.uint8)
        start = np.frombuffer(text, dtype=np.uint8)[: SMALL - 8]
        own[8 : 8 + len(start)] = start
        every = np.empty((self.count, SMALL), dtype=np.uint8)
        waited(self.world.Iallgather(own, every).Test)
        sizes = every[:, :8].copy().view(np.int64)[:, 0]
        texts = [row[8:] for row in every]
        if sizes.max() > SMALL - 8:
            whole = np.empty(int(sizes.sum()), dtype=np.uint8)
            ends = np.cumsum(sizes)
            parts = [whole, sizes.tolist(), (ends - sizes).tolist(), as_byte_type()]
            waited(self.world.Iallgatherv(np.frombuffer(text, dtype=np.uint8), parts).Test)
            texts = np.split(whole, ends[:-1])
        found = [pickle.loads(text.tobytes()) for text in texts]  # of the same program
        self._require_alike(np.array([calls for calls, _ in found]))
        return [its for _, its in found]

    def _require_alike(self, calls: NDArray[np.int64]) -> None:
        odd = np.flatnonzero(calls != self.traffic.calls)
        if len(odd):
            raise RankError(
                f"rank {self.rank} is at its verb number {self.traffic.calls}, rank {odd[0]} at "
                f"number {calls[odd[0]]}"
            )

    def tell_ending(self) -> None:
        """Tell all others that this rank says why, and ends all."""
        others = [k for k in range(self.count) if k != self.rank]
        self._told += [self.world.Isend(np.empty(0, np.uint8), k, ENDING) for k in others]

    def ending(self) -> bool:
        """Return whether another rank has told that it ends all."""
        from mpi4py import MPI

        for _ in range(10):  # what has come is not seen at once
            if self.world.Iprobe(MPI.ANY_SOURCE, ENDING):
                return True
            time.sleep(0.005)
        return False

    def abort(self, status: int) -> None:
        """End all ranks, whatever they are doing."""
        sys.stdout.flush()
        sys.stderr.flush()
        self.world.Abort(status)


def waited(ended: Callable[[], bool]) -> None:
    """Return once messages have ended: soon after, and at little cost where it takes long."""
    if ended():
        return
    since, nap = time.perf_counter(), NAP
    while not ended():
        if time.perf_counter() - since < ATTENTIVE:
            time.sleep(0)  # for others that share this processor
            continue
        time.sleep(nap)
        nap = min(1.5 * nap, LONGEST_NAP)


def as_byte_type() -> Any:
    """Return the type of a byte."""
    from mpi4py import MPI

    return MPI.BYTE


def as_bytes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the memory of an array."""
    return array.view(np.uint8)


def at_hand() -> Ranks:
    """Return this rank: alone where no launcher started several.

    Raises
    ------
    MissingDependency
        A launcher started several, and mpi4py is not installed: each would do all the work.
    """
    count, _, exact = launched()
    if count <= 1:
        return Alone()
    try:
        from mpi4py import MPI
    except (ImportError, RuntimeError) as error:
        raise MissingDependency(
            f"a launcher started {count} ranks, and mpi4py cannot be imported ({error}): each "
            "would do all the work; pip install 'lmdsl[mpi]', or start one process"
        ) from None
    found = MpiRanks(MPI.COMM_WORLD)
    if found.count < count or (exact and found.count != count):
        raise MissingDependency(
            f"the launcher started {count} ranks, and MPI sees {found.count}: mpi4py and the "
            "launcher are of different MPIs; use the mpiexec that belongs to mpi4py's (of Slurm, "
            "srun --mpi=pmi2 or pmix)"
        )
    _share_processors(found)
    return found


def _share_processors(ranks: MpiRanks) -> None:
    """Let ranks of a machine, or of the same processors, use each a share of what they share."""
    processors = threads.processors()
    here = socket.gethostname(), processors
    every = ranks.world.allgather(here)
    threads.limit(len(processors) // every.count(here))
    memory.share(sum(name == here[0] for name, _ in every))
