"""Ranks under MPI, by mpi4py: ``mpiexec -n R ...``.

Nothing here is imported unless the program was started by a launcher. Messages are arrays as they
lie in memory; what is small and of any kind is pickled: it comes from the same program.
"""

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import MissingDependency
from lmdsl.ranks.launchers import launched
from lmdsl.ranks.verbs import Alone, Item, RankError, Ranks, require_expected

TAG, TROUBLE = 7, 8  # of messages between two ranks, and of those that one has failed
KINDS = "?bhilqBHILQfd"  # types of arrays, by NumPy's character


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

    def _exchange(self, parcels: dict[int, NDArray[Any]]) -> dict[int, NDArray[Any]]:
        # Of every array: its place in the series, type and size; -1 where none is sent.
        head = np.full((self.count, 3), -1, dtype=np.int64)
        head[:, 0] = self.traffic.calls
        for to, array in parcels.items():
            head[to, 1:] = KINDS.index(array.dtype.char), len(array)
        heads = np.empty_like(head)
        self.world.Alltoall(head, heads)
        self._require_alike(heads[:, 0])
        came = {
            int(k): np.empty(heads[k, 2], dtype=KINDS[heads[k, 1]])
            for k in np.flatnonzero(heads[:, 2] >= 0)
        }
        self._move(parcels, came)
        return came

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

        asked = {k: self.world.Irecv(as_bytes(a), k, TAG) for k, a in into.items() if len(a)}
        sent = [self.world.Isend(as_bytes(a), k, TAG) for k, a in parcels.items() if len(a)]
        sizes = dict.fromkeys(into, 0)
        for k, request in asked.items():
            status = MPI.Status()
            request.Wait(status)
            sizes[k] = status.Get_count(MPI.BYTE) // into[k].itemsize
        MPI.Request.Waitall(sent)
        return sizes

    def _collect(self, item: Item) -> list[Item]:
        found = self.world.allgather((self.traffic.calls, item))
        self._require_alike(np.array([calls for calls, _ in found]))
        return [its for _, its in found]

    def _require_alike(self, calls: NDArray[np.int64]) -> None:
        odd = np.flatnonzero(calls != self.traffic.calls)
        if len(odd):
            raise RankError(
                f"rank {self.rank} is at its verb number {self.traffic.calls}, rank {odd[0]} at "
                f"number {calls[odd[0]]}"
            )

    def abort(self, status: int) -> None:
        """End all ranks, whatever they are doing."""
        sys.stdout.flush()
        sys.stderr.flush()
        self.world.Abort(status)


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
    return found
