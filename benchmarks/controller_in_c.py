"""What a call of the exported C controller takes: size of the table, usual and worst time.

``python -m benchmarks.controller_in_c [EXAMPLE ...]`` solves examples by name (all of them by
default), compiles their headers with gcc -O2, and asks each state for its control CALLS times in a
row, ROUNDS times over. The time of a state is the least of these by call, less what reading the
clock takes, so that it is the controller's and not that of an interrupt; the worst is the largest
over all states. Half of the
states lie in the box, a quarter near edges of cells, some off the box, and some are no numbers.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import lmdsl as lm
from lmdsl.results.exports.c import codes, table

ROOT = Path(__file__).resolve().parent.parent
STATES, ROUNDS, CALLS = 1_000_000, 9, 16
FLAGS = ("-std=gnu99", "-O2", "-ffp-contract=off", "-shared", "-fPIC")
MAIN = """
#include <time.h>
#include "controller.h"
static long now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000L + t.tv_nsec;
}
void timed(const double *x, double *least, long n)
{
    double u[LMDSL_CONTROLS + 1];
    for (long i = 0; i < n; i++) {
        const long start = now();
        for (int k = 0; k < CALLS; k++) {
            volatile int index = lmdsl_control(x + i * LMDSL_STATES, u);
            (void)index;
        }
        const long end = now();
        if (end - start < least[i])
            least[i] = (double)(end - start);
    }
}
void empty(double *least, long n)
{
    for (long i = 0; i < n; i++) {
        const long start = now(), end = now();
        if (end - start < least[i])
            least[i] = (double)(end - start);
    }
}
"""


def states(result: lm.Result, count: int = STATES, seed: int = 0) -> np.ndarray:
    """Return states in the box and around it, near edges of cells, and some that are no numbers."""
    rng, partition = np.random.default_rng(seed), result.partition
    span, d = partition.high - partition.low, partition.dimension
    x = partition.low - 0.5 * span + 2 * span * rng.random((count, d))
    x[: count // 2] = partition.low + span * rng.random((count // 2, d))
    edges = rng.integers(0, partition.cells + 1, (count // 4, d))
    x[: count // 4] = partition.low + (edges + rng.choice([0, 1e-9, -1e-9], edges.shape)) * (
        partition.width
    )
    x[-100:, 0] = np.resize([np.nan, np.inf, -np.inf, 1e300], 100)
    return rng.permutation(x)


def times(result: lm.Result, x: np.ndarray, rounds: int = ROUNDS) -> np.ndarray:
    """Return the least time of every state in nanoseconds, shape (r,)."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lm.exports.export_c(result, folder / "controller.h")
        (folder / "main.c").write_text(MAIN)
        library = folder / "controller.so"
        subprocess.run(
            ["gcc", *FLAGS, f"-DCALLS={CALLS}", "-o", library, folder / "main.c", "-lm"], check=True
        )
        code = ctypes.CDLL(str(library))
    least, clock = np.full(len(x), np.inf), np.full(10_000, np.inf)
    x = np.ascontiguousarray(x)
    for _ in range(rounds):
        code.timed(ctypes.c_void_p(x.ctypes.data), ctypes.c_void_p(least.ctypes.data), len(x))
        code.empty(ctypes.c_void_p(clock.ctypes.data), len(clock))
    return np.maximum(least - clock.min(), 0) / CALLS


def main(names: list[str]) -> None:
    """Print a row for each example."""
    print("| example | cells | table, bytes | kind | median ns | 99.9 % | worst |")
    print("|---" * 7 + "|")
    for name in names or sorted(path.stem for path in (ROOT / "examples").glob("*.json")):
        result = lm.solve(lm.load(ROOT / f"examples/{name}.json"))
        codes_ = table(codes(result.controller))
        found = times(result, states(result))
        median, most = np.quantile(found, [0.5, 0.999])
        print(
            f"| {name} | {result.cells:,} | {codes_.bytes:,} | {codes_.name} | {median:.0f} | "
            f"{most:.0f} | {found.max():.0f} |"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
