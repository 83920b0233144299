"""Compact transition rows: 32-bit targets and small codes instead of doubles.

A row is a list of (target, code). The code stands for the share of the samples that land in the
target: ``share[code]`` as a double, ``numerator[code] / total`` exactly. Without noise code
``c - 1`` stands for ``c`` of the S samples. With noise, samples are counted apart for each group
of nodes of equal weight; a target may then occur several times in a row, and no rounding enters.

The last target, ``columns``, is the attractor: a vector multiplied with the rows has one more
entry, 0 there. Every row sums to exactly 1 with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.sampling import Nodes


@dataclass(frozen=True)
class Shares:
    """What the codes of a set of rows stand for.

    Attributes
    ----------
    numerator
        Exact integers, one per code.
    total
        Exact integer; ``numerator[code] / total`` is the exact share.
    value
        The same as doubles, shape (codes,), each correctly rounded.
    """

    numerator: Sequence[int]
    total: int
    value: NDArray[np.float64]

    def __post_init__(self) -> None:
        freeze(self.value)

    @classmethod
    def of(cls, points: int, nodes: Nodes) -> Shares:
        """Return the codes of ``points`` sample points times noise nodes."""
        if len(nodes.weights) == 1:
            codes = points
            return cls(range(1, codes + 1), codes, np.arange(1, codes + 1) / codes)
        exact: list[Fraction] = []
        sizes = np.bincount(nodes.group)
        for weight, size in zip(nodes.group_weights(), sizes, strict=True):
            exact += [Fraction(weight) * count for count in range(1, points * int(size) + 1)]
        total = points * nodes.exact_total()
        scale = total.denominator
        for share in {f.denominator for f in exact}:
            scale = max(scale, share)  # all are powers of two
        return cls(
            numerator=tuple(int(f * scale) for f in exact),
            total=int(total * scale),
            value=np.array([float(f / total) for f in exact]),
        )


@dataclass(frozen=True)
class Rows:
    """Transition rows in compressed form.

    Attributes
    ----------
    pointer
        Shape (rows + 1,), int64: row k is ``pointer[k]:pointer[k + 1]``.
    target
        int32; ``columns`` stands for the attractor.
    code
        uint8, uint16 or uint32, an index into ``shares``.
    shares
        What the codes stand for.
    columns
        Number of cells a row can reach besides the attractor.
    """

    pointer: NDArray[np.int64]
    target: NDArray[np.int32]
    code: NDArray[np.unsignedinteger]
    shares: Shares
    columns: int

    def __post_init__(self) -> None:
        freeze(self.pointer, self.target, self.code)

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.pointer) - 1

    @cached_property
    def longest(self) -> int:
        """Largest number of entries of a row."""
        return int(np.diff(self.pointer).max(initial=0))

    def exact(self, k: int) -> list[tuple[int, int]]:
        """Return row k as (target, numerator); the numerators sum to ``shares.total``."""
        span = slice(self.pointer[k], self.pointer[k + 1])
        return [
            (int(j), self.shares.numerator[int(c)])
            for j, c in zip(self.target[span], self.code[span], strict=True)
        ]

    def take(self, rows: NDArray[np.integer]) -> Rows:
        """Return some of the rows, in the given order."""
        length = self.pointer[rows + 1] - self.pointer[rows]
        pointer = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
        entry = np.repeat(self.pointer[rows] - pointer[:-1], length) + np.arange(pointer[-1])
        return Rows(pointer, self.target[entry], self.code[entry], self.shares, self.columns)

    def matrix(self, rows: NDArray[np.integer] | None = None):  # type: ignore[no-untyped-def]
        """Return rows as a SciPy CSR array of doubles, shape (len(rows), columns).

        The attractor's share is left out: what a row lacks to 1 is absorbed.
        """
        from scipy.sparse import csr_array

        chosen = self if rows is None else self.take(rows)
        target, value = chosen.target, self.shares.value[chosen.code]
        inside = target < self.columns
        pointer = chosen.pointer
        kept = np.concatenate([[0], np.cumsum(inside)])[pointer]
        matrix = csr_array(
            (value[inside], target[inside], kept), shape=(len(pointer) - 1, self.columns)
        )
        matrix.sum_duplicates()
        return matrix


def freeze(*arrays: NDArray[Any]) -> None:
    """Make arrays read-only: a certificate must be about the model that was compiled."""
    for array in arrays:
        array.setflags(write=False)


def code_type(codes: int) -> type[np.unsignedinteger]:
    """Return the narrowest unsigned type for that many codes."""
    if codes <= 2**8:
        return np.uint8
    return np.uint16 if codes <= 2**16 else np.uint32
