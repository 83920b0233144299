"""Compact transition rows: 32-bit targets and small codes instead of doubles.

A row is a list of (target, code). The code stands for the share of the samples that land in the
target: ``share[code]`` as a double, ``numerator[code] / total`` exactly. Without noise code
``c - 1`` stands for ``c`` of the S samples. With noise, samples are counted apart for each group
of nodes of equal weight; a target may then occur several times in a row, and no rounding enters.
Rows that are given and not counted have no denominator in common: each code has its own.

The last target, ``columns``, is the attractor: a vector multiplied with the rows has one more
entry, 0 there. With a discount the end of the run is the same target, by a code of its own. Every
row sums to exactly 1 with it.
"""

import hashlib
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.records import Frozen
from lmdsl.common.types import Floats, Guard, Indices
from lmdsl.machine import threads
from lmdsl.machine.kernels import ONE, kernel
from lmdsl.model.discretization import Nodes

# Number of ranges for threads, and number of rows from which on they are made.
PARTS, PARALLEL_FROM = 8, 10_000


@dataclass(frozen=True, eq=False)
class Shares(Frozen):
    """What the codes of a set of rows stand for."""

    numerator: Sequence[int]  # exact integers, one per code
    # exact integer; ``numerator[code] / total`` is the exact share. None: see denominator
    total: int | None
    value: Floats  # the same as doubles, shape (codes,), each correctly rounded
    merged: bool = False  # every target but the attractor occurs at most once in a row
    denominator: Sequence[int] = ()  # one per code where they have no total in common
    # code of the share with which a run ends, the last entry of every row; None: no discount
    ended: int | None = None

    @classmethod
    def of(cls, points: int, nodes: Nodes, guard: Guard | None = None) -> Self:
        """Return the codes of ``points`` sample points times noise nodes."""
        if len(nodes.weights) == 1:
            codes = points
            return cls(range(1, codes + 1), codes, np.arange(1, codes + 1) / codes, merged=True)
        weights, sizes = nodes.exact_weights(guard)
        total = points * sum(w * size for w, size in zip(weights, sizes, strict=True))
        numerator: list[int] = []
        value: list[float] = []
        for weight, size in zip(weights, sizes, strict=True):
            if guard is not None:
                guard()
            own = [weight * count for count in range(1, points * size + 1)]
            numerator += own
            value += [n / total for n in own]  # whole numbers, so that it is correctly rounded
        return cls(numerator=tuple(numerator), total=total, value=np.array(value))

    def discounted(self, b: float) -> "Shares":
        """Return b times the shares, and as the last code 1 - b: the share of runs that end."""
        p, q = b.as_integer_ratio()
        numerator = [n * p for n in self.numerator]
        last = (q - p) * (1 if self.total is None else self.total)
        total = None if self.total is None else self.total * q
        denominator = [] if self.total is not None else [*(d * q for d in self.denominator), q]
        below = denominator if total is None else itertools.repeat(total)
        numerator.append(last)
        return replace(
            self,
            numerator=tuple(numerator),
            total=total,
            value=np.array([n / d for n, d in zip(numerator, below, strict=False)]),
            denominator=tuple(denominator),
            ended=len(self.numerator),
        )

    def over(self, codes: Sequence[int]) -> tuple[list[int], int]:
        """Return the shares of some codes as numerators of one denominator."""
        if self.total is not None:
            return [self.numerator[c] for c in codes], self.total
        total = math.lcm(*{self.denominator[c] for c in codes})
        return [self.numerator[c] * (total // self.denominator[c]) for c in codes], total


class RowArrays(NamedTuple):
    """Rows as compiled loops read them.

    Unsigned indices spare Numba the test for negative ones, which costs as much as the sum.
    """

    pointer: NDArray[np.uint64]
    target: NDArray[np.uint32]
    code: NDArray[np.unsignedinteger]
    share: Floats


@dataclass(frozen=True, eq=False)
class Rows(Frozen):
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

    pointer: Indices
    target: NDArray[np.int32]
    code: NDArray[np.unsignedinteger]
    shares: Shares
    columns: int

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.pointer) - 1

    @property
    def kernel(self) -> RowArrays:
        """The rows as compiled loops read them."""
        pointer, target = self.pointer.view(np.uint64), self.target.view(np.uint32)
        return RowArrays(pointer, target, self.code, self.shares.value)

    def exact(self, k: int) -> list[tuple[int, int]]:
        """Return row k as (target, numerator); the numerators sum to ``total(k)``."""
        span = slice(self.pointer[k], self.pointer[k + 1])
        numerators, _ = self.shares.over(self.code[span].tolist())
        return list(zip(self.target[span].tolist(), numerators, strict=True))

    def total(self, k: int) -> int:
        """Return the denominator of row k."""
        if self.shares.total is not None:
            return self.shares.total
        return self.shares.over(self.code[self.pointer[k] : self.pointer[k + 1]].tolist())[1]

    def without_end(self) -> "Rows":
        """Return the pattern of the rows as if no run ended by discount."""
        if self.shares.ended is None:
            return self
        kept = self.code != self.shares.ended
        before = np.concatenate([[0], np.cumsum(kept)])
        return replace(
            self, pointer=before[self.pointer], target=self.target[kept], code=self.code[kept]
        )

    def take(self, rows: NDArray[np.integer]) -> "Rows":
        """Return some of the rows, in the given order."""
        chosen = np.ascontiguousarray(rows, dtype=np.int64).view(np.uint64)
        pointer = np.zeros(len(chosen) + 1, dtype=np.int64)
        over_rows(len(chosen), _lengths, chosen, self.kernel.pointer, pointer[1:])
        np.cumsum(pointer, out=pointer)
        target = np.empty(int(pointer[-1]), dtype=np.int32)
        code = np.empty(int(pointer[-1]), dtype=self.code.dtype)
        over_rows(len(chosen), _take, chosen, self.kernel, pointer, target, code)
        return Rows(pointer, target, code, self.shares, self.columns)

    def matrix(self, rows: NDArray[np.integer] | None = None):  # type: ignore[no-untyped-def]
        """Return rows as a SciPy CSR array of doubles, shape (len(rows), columns).

        The attractor's share is left out: what a row lacks to 1 is absorbed.
        """
        from scipy.sparse import csr_array

        chosen = np.arange(self.count) if rows is None else np.asarray(rows, dtype=np.int64)
        length = self.pointer[chosen + 1] - self.pointer[chosen]
        pointer = np.zeros(len(chosen) + 1, dtype=np.int64)
        np.cumsum(length, out=pointer[1:])
        small = pointer[-1] < 2**31  # SciPy converts other mixtures of types again and again
        indptr = np.empty(len(chosen) + 1, dtype=np.int32 if small else np.int64)
        indices = np.empty(int(pointer[-1]), dtype=indptr.dtype)
        data = np.empty(int(pointer[-1]))
        columns = np.uint32(self.columns)
        used = _gather(chosen.view(np.uint64), self.kernel, columns, indptr, indices, data)
        matrix = csr_array((data[:used], indices[:used], indptr), shape=(len(chosen), self.columns))
        if not self.shares.merged:
            matrix.sum_duplicates()
        return matrix


def append_end(
    end: Indices, target: NDArray[np.int32], code: NDArray[Any], columns: int, ended: int
) -> tuple[Indices, NDArray[np.int32], NDArray[Any]]:
    """Return rows, given by their ends, with the end of the run by discount as last entries."""
    longer = end + np.arange(1, len(end) + 1)
    return longer, np.insert(target, end, np.int32(columns)), np.insert(code, end, ended)


def over_rows(count: int, loop: Callable[..., object], *arguments: Any) -> None:
    """Call ``loop(first, last, *arguments)`` on ranges of rows, in threads where they are many."""
    ranges = threads.ranges(count, PARTS if count >= PARALLEL_FROM else 1)
    threads.each(lambda span: loop(*span, *arguments), ranges)


@kernel
def _take(first, last, chosen, rows, out_pointer, out_target, out_code):  # type: ignore[no-untyped-def]
    pointer, target, code = rows.pointer, rows.target, rows.code
    for r in range(np.uint64(first), np.uint64(last)):
        shift = np.uint64(out_pointer[r]) - pointer[chosen[r]]
        for e in range(pointer[chosen[r]], pointer[chosen[r] + ONE]):
            out_target[e + shift] = target[e]
            out_code[e + shift] = code[e]


@kernel
def _lengths(first, last, chosen, pointer, length):  # type: ignore[no-untyped-def]
    for r in range(np.uint64(first), np.uint64(last)):
        length[r] = pointer[chosen[r] + ONE] - pointer[chosen[r]]


@kernel
def _gather(chosen, rows, columns, indptr, indices, data):  # type: ignore[no-untyped-def]
    """Copy rows without the attractor's share into the arrays of a CSR matrix."""
    pointer, target, code, share = rows
    used = np.uint64(0)
    indptr[0] = 0
    for r in range(np.uint64(len(chosen))):
        k = chosen[r]
        for e in range(pointer[k], pointer[k + ONE]):
            if target[e] < columns:
                indices[used] = target[e]
                data[used] = share[code[e]]
                used += ONE
        indptr[r + ONE] = used
    return used


def code_type(codes: int) -> type[np.unsignedinteger]:
    """Return the narrowest unsigned type for that many codes."""
    if codes <= 2**8:
        return np.uint8
    return np.uint16 if codes <= 2**16 else np.uint32


Typed = tuple[NDArray[Any], str]  # an array, and as what its entries count


def digest_of(rows: Rows, gamma: float, before: Iterable[Typed], after: Iterable[Typed]) -> str:
    """Return the SHA-256 of a model: gamma, and the rows between arrays of the pairs."""
    sha, shares = hashlib.sha256(b"lmdsl model 1\n"), rows.shares
    below = [*shares.denominator] if shares.total is None else shares.total
    sha.update(repr((below, [*shares.numerator])).encode())
    sha.update(np.array([gamma], dtype="<f8").tobytes())
    own = (rows.pointer, "<i8"), (rows.target, "<i4"), (rows.code, "<u4")
    for array, kind in (*before, *own, *after):
        for part in np.array_split(array.ravel(), max(1, array.size // 2**22)):
            sha.update(np.ascontiguousarray(part, dtype=kind).tobytes())
    return sha.hexdigest()
