"""Random states of proved boxes, followed by the true map: what is proved of them must happen.

``python tests/helpers/proved_points.py DIR [POINTS]`` does so for a directory that holds a proof.
"""

from __future__ import annotations

import itertools
import sys
import time

import numpy as np

import lmdsl as lm
from lmdsl.machine.deadline import Deadline

ARRIVES, LOST, STAYS = 1, 2, 3
WATCHED = 200  # steps for which boxes that stay are watched


def boxes_of(proof, cells):
    """The boxes of each cell: a dictionary of positions."""
    found = {}
    for i, cell in enumerate(proof.cell.tolist()):
        found.setdefault(cell, []).append(i)
    return found


def box_at(proof, partition, x):
    """The box of a state, by its cell and its place there; -1 outside C."""
    state, cell = partition.enter(x[None])
    of_cell = np.flatnonzero(proof.cell == cell[0])
    t = (state[0] - partition.low) / partition.width - np.ravel(partition.multi_index(cell))
    t = np.where(partition.periodic & (t > partition.cells / 2), 0.0, t)
    where = np.floor(np.clip(t, 0, 1 - 2.0**-33) * 2.0 ** proof.split[of_cell])
    at = of_cell[(where == proof.place[of_cell]).all(axis=1)]
    return at[0] if len(at) else -1


def drawn(proof, partition, count, rng):
    """Random states of random boxes, by volume and by number, and their boxes."""
    volume = 2.0 ** -proof.split.sum(axis=1, dtype=float)
    by_volume = rng.choice(proof.boxes, size=count // 2, p=volume / volume.sum())
    box = np.concatenate([by_volume, rng.integers(proof.boxes, size=count - count // 2)])
    index = np.stack(partition.multi_index(proof.cell[box]), axis=-1)
    part = (proof.place[box] + rng.random((count, partition.dimension))) / 2.0 ** proof.split[box]
    return partition.low + (index + part) * partition.width, box


def exceptions(result, proof, count, seed=0, x=None, box=None):
    """Count states that do something else than is proved of them, by what is proved."""
    rng = np.random.default_rng(seed)
    if x is None:
        x, box = drawn(proof, result.partition, count, rng)
    loop, wrong = result.closed_loop.compiled, {}
    for kind, name in ((ARRIVES, "arrives"), (LOST, "lost"), (STAYS, "stays")):
        on = np.flatnonzero(proof.kind[box] == kind)
        b = box[on]
        if not len(on):
            wrong[name] = 0
            continue
        steps = WATCHED if kind == STAYS else int(proof.level[b].max())
        runs = loop.run(x[on], steps, rng, Deadline())
        bad = runs.outcome != {ARRIVES: 0, LOST: 1, STAYS: 2}[kind]
        if kind != STAYS:
            bad |= runs.taken > proof.level[b]
        if kind == ARRIVES:
            slack = 1e-9 * (1 + np.abs(runs.cost))
            bad |= runs.cost > proof.cost_above[b] + slack
            bad |= runs.cost < proof.cost_below[b] - slack
            if proof.above is not None:
                most = above_at(proof, result.partition, x[on])
                bad |= runs.cost > most + 1e-6 * (1 + np.abs(runs.cost))
        wrong[name] = int(bad.sum())
    return wrong


def above_at(proof, partition, x):
    """The upper bound of the part of each state; at faces the largest of the parts that meet."""
    split = proof.above.split.astype(int)
    shape = partition.cells << split
    bound = proof.above.bound.reshape(tuple(shape))
    most = np.full(len(x), -np.inf)
    for sides in itertools.product((-2e-9, 2e-9), repeat=partition.dimension):
        t = ((x - partition.low) / partition.width + sides) / partition.cells
        t = np.where(partition.periodic, t % 1.0, np.clip(t, 0.0, 1.0))
        index = np.minimum((t * shape).astype(int), shape - 1)
        most = np.maximum(most, bound[tuple(index.T)])
    return most.astype(float)


def proof_of(path):
    """The result and the proof that a directory holds."""
    from lmdsl.proof.bounds.flights.refining import Above
    from lmdsl.proof.record import Proof
    from lmdsl.results.directory import archive, proved

    stored = archive.read(path)
    result, said = stored.result, stored.certificate.proof
    arrays = proved.read(path, result, said)
    above = None if said.followed is None else Above(arrays["above_split"], arrays["above"])
    return result, Proof.of(arrays, proved.loop_of(result), seconds=said.seconds, holds=said.holds,
                            target=said.target, above=above)  # fmt: skip


if __name__ == "__main__":
    result, proof = proof_of(sys.argv[1])
    wanted = int(float(sys.argv[2])) if len(sys.argv) > 2 else 10**6
    began, total = time.monotonic(), {}
    for part in range(-(-wanted // 10**6)):
        for name, bad in exceptions(result, proof, min(wanted, 10**6), part).items():
            total[name] = total.get(name, 0) + bad
    print(f"lmdsl {lm.__version__}: {wanted} states in {time.monotonic() - began:.0f} s, "
          f"of which do otherwise: {total}")  # fmt: skip
