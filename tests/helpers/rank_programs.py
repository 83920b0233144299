"""Programs for ranks, and what runs one under MPI: ``mpiexec -n R python rank_programs.py NAME``.

Each returns plain data that is to be the same however it is run; rank 0 prints what all returned.
"""

import errno
import itertools
import json
import os
import signal
import sys
import time

import numpy as np

from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline
from lmdsl.ranks.ending import together
from lmdsl.ranks.mesh import Mesh
from lmdsl.ranks.mpi import at_hand
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.watching import Watched


def verbs(ranks):
    """Every verb, of data that depend on the ranks in a way that can be told beforehand."""
    me, count = ranks.rank, ranks.count
    to = {k: np.arange(10 * me + k, 10 * me + k + me + 1) for k in range(count) if (me + k) % 3}
    came = ranks.exchange(to)
    sizes = {k: k + 1 for k in came}
    again = ranks.exchange(to, sizes, np.int64)
    assert [*again] == [*came]
    assert all((again[k] == came[k]).all() for k in came)
    own = np.full(me + 1, float(me))
    whole = ranks.gathered(own)
    parts = None if me else [np.full(k + 1, k, dtype=np.uint8) for k in range(count)]
    return {
        "came": {str(k): array.tolist() for k, array in came.items()},
        "collected": ranks.collect({"rank": me}),
        "gathered": None if whole is None else whole.tolist(),
        "listed": ranks.gather(me),
        "scattered": ranks.scatter(parts).tolist(),
        "shared": ranks.share(None if me else "of rank 0"),
        "any": ranks.any(me == 1),
        "all": ranks.all(me < 3),
        "agreed": ranks.agreed(lambda: me * me),
    }


def sums(ranks):
    """A sum of twelve parts that depends on their order: to be the same for every count."""
    parts = [1e16, 1.0, -1e16, 3.0, 1e-3, 7e15, -1.0, 0.1, -7e15, 0.2, 0.3, 1.0]
    bounds = [12 * k // ranks.count for k in range(ranks.count + 1)]
    own = parts[bounds[ranks.rank] : bounds[ranks.rank + 1]]
    return ranks.reduce(own, lambda a, b: a + b, 0.0).hex()


def agreed_error(ranks):
    """An error of the last ranks: that of the lowest of them is everybody's."""

    def work():
        if ranks.rank >= ranks.count // 2:
            raise BadInput(f"the cost of rank {ranks.rank} is nan", "stage_cost")

    try:
        ranks.agreed(work)
    except BadInput as error:
        return [type(error).__name__, str(error), error.where, error.agreed]
    return None


def lonely_error(ranks):
    """An error that one rank meets while the others wait for it."""
    if ranks.rank == ranks.count - 1:
        raise ValueError("met by the last rank")
    return ranks.collect(1)


def lonely_memory(ranks):
    """The same, an error that is no Exception of ours."""
    if ranks.rank == ranks.count - 1:
        raise KeyboardInterrupt
    return ranks.any(False)


def early(ranks):
    """One rank fails in work that takes the others long: how long all take, and what is raised."""
    began, found = time.monotonic(), []
    for fails in (0, ranks.count - 1):

        def work(rank=fails):
            if ranks.rank == rank:
                raise BadInput(f"met by rank {rank}")
            deadline = Watched(ranks, Deadline(30.0))
            while True:
                deadline.raise_if_over("testing")
                time.sleep(0.01)

        try:
            ranks.agreed(work)
        except BadInput as error:
            found.append(str(error))
        ranks.agreed(lambda: None)  # which the trouble before does not end
    return found, time.monotonic() - began < 15


def killed(ranks):
    """The last rank is killed while the others wait for it."""
    if ranks.rank == ranks.count - 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return ranks.collect(1)


def full_disk(ranks):
    """One rank cannot write; all are told."""

    def write():
        if ranks.rank == ranks.count - 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "V.npy")

    try:
        ranks.agreed(write)
    except OSError as error:
        return [error.errno == errno.ENOSPC, error.filename]


def deadline(ranks):
    """One rank's time is up after a while: all stop in the same round."""
    until = time.monotonic() + (0.05 if ranks.rank == ranks.count - 1 else 1e9)
    time_up, rounds = ranks.time_up(lambda: time.monotonic() > until), 0
    while not time_up():
        rounds += 1
    return rounds == ranks.collect(rounds)[0] and rounds > 0


def out_of_step(ranks):
    """One rank says a verb more than the others."""
    if ranks.rank == 0:
        ranks.traffic.calls += 1
    return ranks.collect(1)


def graph(seed=0, cells=101):
    """Rows of a model of a few cells: entries by cell, targets (the last: attractor), shares."""
    random = np.random.default_rng(seed)
    length = random.integers(0, 6, cells)
    pointer = np.concatenate([[0], np.cumsum(length)])
    far = random.integers(0, cells + 1, pointer[-1])
    near = np.clip(np.repeat(np.arange(cells), length) + random.integers(-3, 4, len(far)), 0, cells)
    target = np.where(random.random(len(far)) < 0.8, near, far)
    return pointer, target, random.random(len(far)), length


def own_rows(ranks, seed=0, cells=101):
    """The mesh of a rank, and its rows in local numbers."""
    pointer, target, share, length = graph(seed, cells)
    division = Division.cut(length, ranks.count)
    first, last = division.own(ranks.rank)
    own = slice(pointer[first], pointer[last])
    mesh = Mesh.of(ranks, division, target[own])
    return mesh, pointer[first : last + 1] - pointer[first], mesh.local(target[own]), share[own]


def products(pointer, target, share, x):
    """The sum over every row, entry by entry."""
    return [
        sum((share[e] * x[target[e]] for e in range(a, b)), 0.0)
        for a, b in itertools.pairwise(pointer)
    ]


def rows_times_values(ranks):
    """P x of three x one after the other, as rank 0 collects it, to the bit."""
    mesh, pointer, target, share = own_rows(ranks)
    first, last = mesh.division.own(ranks.rank)
    found = []
    for seed in range(3):
        values = np.random.default_rng(seed).random(mesh.division.cells)[first:last]
        own = np.array(products(pointer, target, share, mesh.spread(values)))
        found.append(np.concatenate(ranks.collect(own)).tobytes().hex())
    return found


PROGRAMS = {
    f.__name__: f
    for f in (
        verbs,
        sums,
        agreed_error,
        lonely_error,
        lonely_memory,
        early,
        killed,
        full_disk,
        deadline,
        out_of_step,
        rows_times_values,
    )
}


def main(programs=PROGRAMS):
    ranks, (name, *arguments) = at_hand(), sys.argv[1:]
    found = together(ranks, lambda ranks: ranks.collect(programs[name](ranks, *arguments)))
    if ranks.rank == 0:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
