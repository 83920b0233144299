"""All shipped systems and 50 random problems over ranks, beside one process.

Run:  python tests/helpers/matrix.py [--ranks 1,2,3,4,7] [--mpi 2,4] [--dozen] [NAME ...]

Prints what is not alike, and how many problems are; the exit status is 1 where one is not.
"""

import argparse
import hashlib
import json
import sys
from pathlib import Path

import numpy as np
from alike import WHOLE, alike
from launching import launch
from random_problems import random_problem

import lmdsl as lm
from lmdsl.distributed.answering import answer
from lmdsl.ranks.mpi import at_hand
from lmdsl.ranks.threaded import as_threads

EXAMPLES = Path(__file__).parents[2] / "examples"
SHIPPED = [path.stem for path in sorted(EXAMPLES.glob("*.json"))]
ZOO = [f"zoo/{path.stem}" for path in sorted((EXAMPLES / "zoo").glob("*.json"))]
RANDOM = [f"random {seed}" for seed in range(50)]
# Verified and unverified; beyond gamma_bar; nothing to stabilize; noise, paths, orbits, enclosures.
DOZEN = [
    "standard_map", "standard_map_held", "double_integrator", "logistic_map", "zoo/circle_map",
    "zoo/inventory", "random 1", "random 7", "random 8", "random 12", "random 15", "random 45",
]  # fmt: skip
COUNTS, PROCESSES = (1, 2, 3, 4, 7), (2, 4)
TOGETHER = 10  # problems of one launch: to start processes takes longer than to solve most of them


def problem(name):
    """A problem by its name."""
    if name.startswith("random "):
        seed = int(name.removeprefix("random "))
        return lm.Problem.model_validate(random_problem(np.random.default_rng(seed)))
    return lm.load(EXAMPLES / f"{name}.json")


def prints(ranks, *names):
    """What tells the answers to problems apart, the same on every rank."""
    return [_print(ranks, name) for name in names]


def _print(ranks, name):
    found = answer(ranks, problem(name))
    arrays = {}
    for each in (*WHOLE, "value", "lower", "witness"):
        own = getattr(found, each)
        every = None if own is None else np.concatenate(ranks.collect(own)).tobytes()
        arrays[each] = every and hashlib.sha256(every).hexdigest()
    return {"status": found.status, "cause": found.cause, "message": found.message,
            "model": found.model_sha256, **arrays}  # fmt: skip


def as_processes(count, names):
    """What MPI processes answer, where threads answer something else; nothing if they agree."""
    done = launch(count, "prints", *names, script="matrix.py", limit=300 + 60 * len(names))
    if done.returncode:
        return [f"{names}: {done.stderr[-500:]}"]
    found = json.loads(done.stdout.splitlines()[-1])
    expected = as_threads(count, lambda ranks: prints(ranks, *names))[0]
    return [
        f"{name} as {count} processes: {what} is {one[what]!r}, as threads {other[what]!r}"
        for name, one, other in zip(names, found, json.loads(json.dumps(expected)), strict=True)
        for what in one
        if one[what] != other[what]
    ]


def faults(names, counts=COUNTS, processes=()):
    """Yield every problem by its name with what is not alike, nothing where all is."""
    for at in range(0, len(names), TOGETHER):
        some = names[at : at + TOGETHER]
        launched = [fault for count in processes for fault in as_processes(count, some)]
        for name in some:
            said = [fault for fault in launched if fault.startswith((f"{name} as", str(some)))]
            try:
                alike(problem(name), counts)
            except AssertionError as error:
                said.append(str(error).splitlines()[0] if str(error) else "not alike")
            yield name, said


def main():
    """Compare, and say how many are alike."""
    if sys.argv[1:2] == ["prints"]:  # started by a launcher
        ranks = at_hand()
        found = prints(ranks, *sys.argv[2:])
        if ranks.rank == 0:
            print(json.dumps(found))
        return 0
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ranks", default=",".join(map(str, COUNTS)))
    parser.add_argument("--mpi", default="")
    parser.add_argument("--dozen", action="store_true", help="a dozen of each kind")
    parser.add_argument("names", nargs="*")
    asked = parser.parse_args()
    counts, processes = (
        [int(n) for n in text.split(",") if n] for text in (asked.ranks, asked.mpi)
    )
    names, bad = asked.names or (DOZEN if asked.dozen else [*SHIPPED, *ZOO, *RANDOM]), 0
    for name, said in faults(names, counts, processes):
        bad += bool(said)
        print(f"{name}: {'; '.join(said) or 'alike'}", flush=True)
    print(f"{len(names) - bad} of {len(names)} problems alike")
    return bool(bad)


if __name__ == "__main__":
    sys.exit(main())
