"""The rows of a finite model as they are kept: exact shares by code, and what each pair costs."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.records import Frozen
from lmdsl.common.types import Floats, Indices
from lmdsl.errors import BadInput
from lmdsl.systems.matrices.exact import ESCAPES, ExactShares

LIMB = 32
"""Bits of a digit in which large integers are stored."""
MOST_LIMBS = 4096
KINDS = {
    "cell": ("pairs", "<i4"),
    "control": ("pairs", "<i4"),
    "cost": ("pairs", "<f8"),
    "pointer": ("ends", "<i8"),
    "target": ("entries", "<i4"),
    "code": ("entries", "<u4"),
}


@dataclass(frozen=True, eq=False)
class GivenRows(Frozen):
    """The pairs of a finite model by cell, then control, and their exact rows."""

    cells: int
    controls: int
    cell: NDArray[np.int32]  # of each pair, shape (K,)
    control: NDArray[np.int32]
    cost: Floats  # of each pair, finite and >= 0
    pointer: Indices  # row k is ``pointer[k]:pointer[k + 1]``
    target: NDArray[np.int32]  # a cell, each once in a row; -1 where the run escapes
    code: NDArray[np.uint32]  # ``numerator[code] / denominator[code]`` is the exact share
    numerator: tuple[int, ...]
    denominator: tuple[int, ...]

    @classmethod
    def of(
        cls,
        cells: int,
        controls: int,
        pairs: tuple[Indices, Indices],
        shares: ExactShares,
        cost: Floats,
    ) -> Self:
        """Give every different share a code; pairs without transitions are left out."""
        kept = np.flatnonzero(np.diff(shares.pointer))
        below = np.repeat(shares.total, np.diff(shares.pointer))
        code, numerator, denominator = _codes(shares.numerator, below)
        ends = shares.pointer[1:][kept]
        return cls(
            cells,
            controls,
            pairs[0][kept].astype(np.int32),
            pairs[1][kept].astype(np.int32),
            cost[kept],
            np.concatenate([[0], ends]).astype(np.int64),
            shares.target.astype(np.int32),
            code,
            numerator,
            denominator,
        )

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return len(self.cell)

    def values(self) -> Floats:
        """Return the shares as doubles, each correctly rounded, shape (codes,)."""
        both = zip(self.numerator, self.denominator, strict=True)
        return np.array([n / d for n, d in both], dtype=np.float64)

    def owner(self) -> Indices:
        """Return the pair of every transition, shape (E,)."""
        return np.repeat(np.arange(self.pairs), np.diff(self.pointer))

    # As arrays of a file ----------------------------------------------------------------------

    def sizes(self) -> dict[str, int]:
        """Return what says the shapes of :meth:`arrays`."""
        largest = max((*self.numerator, *self.denominator), default=1)
        return {
            "cells": self.cells,
            "controls": self.controls,
            "pairs": self.pairs,
            "entries": len(self.target),
            "codes": len(self.numerator),
            "limbs": -(-largest.bit_length() // LIMB),
        }

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the content as plain arrays; integers of any size as their digits."""
        limbs = self.sizes()["limbs"]
        held = {name: getattr(self, name).astype(kind) for name, (_, kind) in KINDS.items()}
        for name in ("numerator", "denominator"):
            held[name] = _digits(getattr(self, name), limbs)
        return held

    @staticmethod
    def expected(sizes: Mapping[str, int]) -> dict[str, tuple[tuple[int, ...], str]]:
        """Return shape and type of each array."""
        length = {**sizes, "ends": sizes["pairs"] + 1}
        shapes = {name: ((length[of],), kind) for name, (of, kind) in KINDS.items()}
        digits = ((sizes["codes"], sizes["limbs"]), "<u4")
        return {**shapes, "numerator": digits, "denominator": digits}

    @classmethod
    def read(cls, sizes: Mapping[str, int], held: Mapping[str, NDArray[Any]]) -> Self:
        """Return the rows that arrays of a file hold.

        Raises
        ------
        BadInput
            They contradict each other, or a row does not sum to 1.
        """
        shape = sizes["codes"], sizes["limbs"]
        numerator = _whole(held["numerator"].reshape(shape))
        denominator = _whole(held["denominator"].reshape(shape))
        rows = cls(
            sizes["cells"],
            sizes["controls"],
            held["cell"],
            held["control"],
            held["cost"],
            held["pointer"],
            held["target"],
            held["code"],
            numerator,
            denominator,
        )
        rows.require_sound()
        return rows

    def require_sound(self) -> None:
        """Refuse rows that are none."""
        pointer = self.pointer
        ends = pointer[0], pointer[-1]
        if ends != (0, len(self.target)) or not (np.diff(pointer) > 0).all():
            raise BadInput("the rows are inconsistent", "model.npz.pointer")
        first = np.diff(self.owner(), prepend=-1) != 0
        key = self.cell.astype(np.int64) * self.controls + self.control
        sound = (
            ((self.cell >= 0) & (self.cell < self.cells)).all()
            and ((self.control >= 0) & (self.control < self.controls)).all()
            and (np.diff(key) > 0).all()
            and ((self.target >= ESCAPES) & (self.target < self.cells)).all()
            and (first[1:] | (np.diff(self.target) > 0)).all()
            and (self.code < len(self.numerator)).all()
            and (np.isfinite(self.cost) & (self.cost >= 0)).all()
            and all(self.numerator)
            and all(self.denominator)
        )
        if not sound:
            raise BadInput("the rows are inconsistent", "model.npz")
        for k, (a, b) in enumerate(zip(pointer[:-1].tolist(), pointer[1:].tolist(), strict=True)):
            row = self.code[a:b].tolist()
            total = self.denominator[row[0]]
            same = all(self.denominator[c] == total for c in row)
            if not (same and sum(self.numerator[c] for c in row) == total):
                raise BadInput(f"row {k} does not sum to 1 over one denominator", "model.npz")


def _codes(
    numerator: NDArray[Any], denominator: NDArray[Any]
) -> tuple[NDArray[np.uint32], tuple[int, ...], tuple[int, ...]]:
    """Number the different fractions; those of a row keep its denominator."""
    if numerator.dtype == object or denominator.dtype == object:
        seen: dict[tuple[int, int], int] = {}
        both = zip(numerator.tolist(), denominator.tolist(), strict=True)
        found = [seen.setdefault(fraction, len(seen)) for fraction in both]
        return np.array(found, dtype=np.uint32), *_unzipped(list(seen))
    order = np.lexsort((numerator, denominator))
    n, d = numerator[order], denominator[order]
    new = np.ones(len(order), dtype=np.bool_)
    new[1:] = (np.diff(n) != 0) | (np.diff(d) != 0)
    code = np.empty(len(order), dtype=np.uint32)
    code[order] = np.cumsum(new) - 1
    return code, tuple(n[new].tolist()), tuple(d[new].tolist())


def _unzipped(pairs: list[tuple[int, int]]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    return tuple(n for n, _ in pairs), tuple(d for _, d in pairs)


def _digits(values: tuple[int, ...], limbs: int) -> NDArray[np.uint32]:
    raw = b"".join(value.to_bytes(4 * limbs, "little") for value in values)
    return np.frombuffer(raw, dtype="<u4").reshape(len(values), limbs)


def _whole(digits: NDArray[np.uint32]) -> tuple[int, ...]:
    return tuple(int.from_bytes(row.astype("<u4").tobytes(), "little") for row in digits)
