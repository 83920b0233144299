"""The exported C header, compiled, beside the controller in Python."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np

import lmdsl as lm
from lmdsl.results.exports.c import export_c

COMPILER = shutil.which("gcc") or shutil.which("cc")
STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")

MAIN = """
#include "controller.h"
void many(const double *x, double *u, int *index, long n)
{
    for (long i = 0; i < n; i++)
        index[i] = lmdsl_control(x + i * LMDSL_STATES, u + i * LMDSL_CONTROLS);
}
long table(void) { return (long)sizeof lmdsl_code; }
"""


class CompiledController:
    """Compiles the header of a result into a folder, and calls it."""

    def __init__(self, result: lm.Result, folder: Path) -> None:
        export_c(result, folder / "controller.h")
        (folder / "main.c").write_text(MAIN)
        library = folder / "controller.so"
        subprocess.run(
            [COMPILER, *STRICT, "-shared", "-fPIC", "-o", library, folder / "main.c", "-lm"],
            check=True,
        )
        self.p = len(result.problem.controls)
        self.many = ctypes.CDLL(str(library)).many
        self.many.argtypes = [ctypes.c_void_p] * 3 + [ctypes.c_long]

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return controls, shape (r, p), and indices, shape (r,)."""
        x = np.ascontiguousarray(x, dtype=np.float64)
        u, index = np.empty((len(x), self.p)), np.empty(len(x), dtype=np.int32)
        self.many(x.ctypes.data, u.ctypes.data, index.ctypes.data, len(x))
        return u, index


def states(result: lm.Result, count: int, seed: int = 0) -> np.ndarray:
    """Return states in the box and around it, on edges and near them, and some that are none."""
    rng, partition = np.random.default_rng(seed), result.controller.partition
    low, high, d = partition.low, partition.high, partition.dimension
    x = low - 0.5 * (high - low) + 2 * (high - low) * rng.random((count, d))
    x[: count // 2] = low + (high - low) * rng.random((count // 2, d))
    edge = low + rng.integers(-1, partition.cells + 2, (count // 4, d)) * partition.width
    near = edge + partition.width * rng.choice([0, 0, 1e-9, -1e-9, 2e-9, -2e-9, 1e-16], edge.shape)
    x[: len(near)] = near
    x[-40:, 0] = np.resize([np.nan, np.inf, -np.inf, 1e300, -1e30, 2.0**40, 0.0, -0.0], 40)
    return x
