"""The compiled model as plain arrays: what every rival gets. Imports nothing of lmdsl."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Arrays:
    """A finite model, and the certified bounds of its value.

    Attributes
    ----------
    name, gamma, digest
        Model, its weight, and lmdsl's SHA-256 of it.
    pair_pointer
        Shape (n + 1,): the pairs of cell i are ``pair_pointer[i]:pair_pointer[i + 1]``.
    control
        Control index of each pair, shape (K,), ascending within a cell.
    pointer, target, share
        Rows of P in compressed form, targets ascending; target n is the attractor.
    cost
        Shape (K,).
    lower, upper
        Certified bounds of V, shape (n,).
    """

    name: str
    gamma: float
    digest: str
    pair_pointer: NDArray[np.int64]
    control: NDArray[np.int32]
    pointer: NDArray[np.int64]
    target: NDArray[np.int32]
    share: Floats
    cost: Floats
    lower: Floats
    upper: Floats

    @property
    def n(self) -> int:
        """Number of cells."""
        return len(self.pair_pointer) - 1

    @property
    def K(self) -> int:
        """Number of pairs."""
        return len(self.cost)

    @property
    def cell(self) -> NDArray[np.int64]:
        """The cell of every pair, shape (K,)."""
        return np.repeat(np.arange(self.n), np.diff(self.pair_pointer))

    @cached_property
    def precision(self) -> float:
        """The absolute precision asked of rivals that know no relative one: 1e-9 of the mean V."""
        return 1e-9 * float(self.upper.mean())

    @property
    def P(self) -> Any:
        """Transition rows without the attractor, SciPy CSR of shape (K, n)."""
        return self._rows()[:, : self.n]

    @property
    def A(self) -> Any:
        """(E - gamma P)', SciPy CSC of shape (n, K)."""
        from scipy.sparse import csr_array

        E = csr_array((np.ones(self.K), self.cell, np.arange(self.K + 1)), shape=(self.K, self.n))
        return (E - self.gamma * self.P).T.tocsc()

    def _rows(self) -> Any:
        from scipy.sparse import csr_array

        return csr_array((self.share, self.target, self.pointer), shape=(self.K, self.n + 1))

    def error(self, V: Floats) -> float:
        """Return the largest relative distance of V to the certified bounds."""
        V = np.asarray(V, dtype=np.float64)
        if V.shape != self.upper.shape or not np.isfinite(V).all():
            return float("inf")
        scale = np.maximum(self.upper, 1e-12 * self.upper.max(initial=0.0) + 1e-300)
        outside = np.maximum(np.maximum(V - self.upper, self.lower - V), 0.0)
        return float((outside / scale).max(initial=0.0))

    def save(self, path: Path) -> None:
        """Write all arrays into one file."""
        with open(path, "wb") as file:
            np.savez(file, **asdict(self))

    @classmethod
    def load(cls, path: Path) -> Arrays:
        """Read what ``save`` wrote."""
        with np.load(path) as data:
            found = {name: data[name] for name in data.files}
        for name, kind in (("name", str), ("gamma", float), ("digest", str)):
            found[name] = kind(found[name])
        return cls(**found)


def with_attractor(model: Arrays) -> tuple[NDArray[np.int64], NDArray[np.int32], Floats]:
    """Return pointer, target and share with one more row: the attractor stays where it is."""
    return (
        np.append(model.pointer, model.pointer[-1] + 1),
        np.append(model.target, np.int32(model.n)),
        np.append(model.share, 1.0),
    )
