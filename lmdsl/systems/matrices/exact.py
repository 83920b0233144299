"""Probabilities as given become exact rows: integers over a denominator of each row's own.

Fractions stay what they are and have to sum to exactly 1. A row of doubles that sums to 1 within
1e-9 is divided by its sum, exactly: a double is an integer times a power of two. What a row lacks
by more escapes; what it has too much is refused.
"""

import math
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Indices
from lmdsl.errors import BadInput
from lmdsl.systems.matrices.listing import Listing

NEAR = Fraction(1, 10**9)
ESCAPES = -1
"""The target of what a row lacks."""


class ExactShares(NamedTuple):
    """Transitions by pair, then target, each target once: integers over the total of the pair."""

    pointer: Indices  # shape (K + 1,)
    target: Indices  # -1 where the run escapes
    numerator: NDArray[Any]  # int64, or Python's integers where these are too large
    total: NDArray[Any]  # of each pair


def exact(listing: Listing, discount: float | None) -> ExactShares:
    """Return the exact shares of an ordered listing; with a discount, of the rows without it."""
    K = len(listing.state)
    pointer = np.searchsorted(listing.pair, np.arange(K + 1)).astype(np.int64)
    filled = np.flatnonzero(np.diff(pointer))  # a pair without transitions is no pair
    numerator, total = _integers(listing, pointer[filled])
    sums = np.add.reduceat(numerator, pointer[filled]) if len(filled) else numerator
    missing = _judged(listing, filled, sums, total, discount)
    divided = np.where(missing == 0, sums, total)
    return _merged(listing, filled, numerator, missing, divided, K)


def _integers(listing: Listing, start: Indices) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return shares as integers over a total of each row: power of two, or common denominator."""
    length = np.diff(start, append=len(listing.pair))
    if listing.share.dtype != np.float64:
        return _of_fractions(listing.share, start, length)
    mantissa, exponent = np.frexp(listing.share)
    whole = (mantissa * 2.0**53).astype(np.int64)
    trailing = np.log2((whole & -whole).astype(np.float64)).astype(np.int64)
    whole >>= trailing
    exponent = exponent.astype(np.int64) - 53 + trailing
    least = np.minimum.reduceat(exponent, start) if len(start) else exponent
    least = np.minimum(least, 0)
    shift = exponent - np.repeat(least, length)
    bits = shift + np.frexp(whole.astype(np.float64))[1] + np.frexp(np.repeat(length, length))[1]
    if bits.max(initial=0) <= 61 and least.min(initial=0) >= -61:
        return whole << shift, np.left_shift(np.int64(1), -least)
    large = whole.astype(object) << shift.astype(object)
    return large, np.array([1 << -e for e in least.tolist()], dtype=object)


def _of_fractions(
    share: NDArray[Any], start: Indices, length: Indices
) -> tuple[NDArray[Any], NDArray[Any]]:
    numerator, total = np.empty(len(share), dtype=object), np.empty(len(start), dtype=object)
    for r, (first, count) in enumerate(zip(start.tolist(), length.tolist(), strict=True)):
        row = share[first : first + count]
        total[r] = math.lcm(*(x.denominator for x in row))
        numerator[first : first + count] = [x.numerator * (total[r] // x.denominator) for x in row]
    return numerator, total


def _judged(
    listing: Listing,
    filled: Indices,
    sums: NDArray[Any],
    total: NDArray[Any],
    discount: float | None,
) -> NDArray[Any]:
    """Return what each row lacks, as a numerator: 0 where it is divided by its sum."""
    rounded = listing.share.dtype == np.float64 or listing.decimal
    off = _off(sums, total, Fraction(1), rounded)
    if discount is not None and len(off):
        b = Fraction(discount)
        if not len(_off(sums, total, b, rounded)):
            return np.zeros_like(total)  # every row is multiplied by it already
    missing = np.zeros_like(total)
    for r in off.tolist():
        x, where = Fraction(int(sums[r]), int(total[r])), listing.name(filled[r])
        if x > 1:
            raise BadInput(
                f"{where}: the probabilities sum to {_shown(x)}, more than 1; divide every row by "
                "its sum, in double precision",
                "P",
            )
        if 1 - x <= NEAR:
            raise BadInput(
                f"{where}: the fractions sum to {x}, not to 1; exact ones have to sum to "
                "exactly 1: write 1/3, or floats",
                "P",
            )
        missing[r] = total[r] - sums[r]
    return missing


def _off(
    sums: NDArray[Any], total: NDArray[Any], goal: Fraction, rounded: bool
) -> NDArray[np.intp]:
    """Return the rows that do not sum to a goal, within 1e-9 where they are rounded."""
    clear = np.zeros(len(sums), dtype=np.bool_)
    if rounded and sums.dtype != object:
        clear = np.abs(sums / total - float(goal)) <= 0.5e-9
    doubtful = np.flatnonzero(~clear)
    exactly = [Fraction(int(sums[r]), int(total[r])) for r in doubtful.tolist()]
    near = [abs(x - goal) <= NEAR if rounded else x == goal for x in exactly]
    return doubtful[~np.array(near, dtype=np.bool_)]


def _shown(x: Fraction) -> str:
    if x > 10**300:
        return "more than 1e300"
    return str(x) if x.denominator < 1000 else repr(float(x))


def _merged(
    listing: Listing,
    filled: Indices,
    numerator: NDArray[Any],
    missing: NDArray[Any],
    total: NDArray[Any],
    K: int,
) -> ExactShares:
    """Add up what goes to the same target, with what is missing as the first of its row."""
    lost = np.flatnonzero(missing)
    pair = np.concatenate([listing.pair, filled[lost]])
    target = np.concatenate([listing.target, np.full(len(lost), ESCAPES)])
    order = np.lexsort((target, pair))
    pair, target = pair[order], target[order]
    shares = np.concatenate([numerator, missing[lost]])[order]
    new = np.ones(len(pair), dtype=np.bool_)
    new[1:] = (np.diff(pair) != 0) | (np.diff(target) != 0)
    first = np.flatnonzero(new)
    added = np.add.reduceat(shares, first) if len(first) else shares
    whole = np.ones(K, dtype=total.dtype)
    whole[filled] = total
    pointer = np.searchsorted(pair[first], np.arange(K + 1)).astype(np.int64)
    return ExactShares(pointer, target[first], added, whole)
