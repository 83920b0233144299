"""Conditions on blocks of intervals, and what is chosen by them; see arithmetic.py.

A condition is a row too: lower 1 where it holds everywhere on the box, upper 1 where it may hold
somewhere, else 0.
"""

import numpy as np

from lmdsl.machine.kernels import kernel

NAMES = ("<", "<=", "==", "not", "and", "or")
LESS, LESS_EQUAL, EQUAL, NOT, AND, OR = range(len(NAMES))
EXACT = 2.0**50  # quotient above which whole numbers are no longer told apart


@kernel
def _known(which, al, ah, bl, bh):  # type: ignore[no-untyped-def]
    if which == LESS:
        return ah < bl, al < bh
    if which == LESS_EQUAL:
        return ah <= bl, al <= bh
    if which == EQUAL:
        meet = (al <= bh) & (bl <= ah)
        return (al == ah) & (bl == bh) & meet, meet
    if which == NOT:
        return ah == 0.0, al == 0.0
    if which == AND:
        return (al != 0.0) & (bl != 0.0), (ah != 0.0) & (bh != 0.0)
    return (al != 0.0) | (bl != 0.0), (ah != 0.0) | (bh != 0.0)


@kernel
def decide(which, t, a, b):  # type: ignore[no-untyped-def]
    """Fill in what is known of a condition on a and b."""
    for i in range(t.shape[1]):
        surely, possibly = _known(which, a[0, i], a[1, i], b[0, i], b[1, i])
        t[0, i], t[1, i] = 1.0 if surely else 0.0, 1.0 if possibly else 0.0


@kernel
def choose(t, c, a, b):  # type: ignore[no-untyped-def]
    """Fill in t = a where c holds, b where it does not, else what holds both."""
    for i in range(np.uint64(t.shape[1])):
        surely, possibly = c[0, i] != 0.0, c[1, i] != 0.0
        low = a[0, i] if a[0, i] < b[0, i] else b[0, i]
        high = a[1, i] if a[1, i] > b[1, i] else b[1, i]
        low, high = low if possibly else b[0, i], high if possibly else b[1, i]
        t[0, i], t[1, i] = a[0, i] if surely else low, a[1, i] if surely else high


@kernel
def choose_one(t, c, a, b):  # type: ignore[no-untyped-def]
    """Fill in t = a where c holds, b where it does not, else the line: a jump."""
    for i in range(np.uint64(t.shape[1])):
        surely, possibly = c[0, i] != 0.0, c[1, i] != 0.0
        low, high = -np.inf if possibly else b[0, i], np.inf if possibly else b[1, i]
        t[0, i], t[1, i] = a[0, i] if surely else low, a[1, i] if surely else high


@kernel
def flat(t, a):  # type: ignore[no-untyped-def]
    """Fill in t = 0 where a is one number, else the line: the slope of a step function."""
    for i in range(np.uint64(t.shape[1])):
        one = a[0, i] == a[1, i]
        t[0, i], t[1, i] = 0.0 if one else -np.inf, 0.0 if one else np.inf


@kernel
def _floor(a, b):  # type: ignore[no-untyped-def]
    """Return floor(a / b), exact for doubles up to EXACT."""
    rest = np.fmod(a, b)
    k = np.rint((a - rest) / b)
    return k - 1.0 if (rest != 0.0) & ((rest < 0.0) != (b < 0.0)) else k


@kernel
def floors(t, a, b):  # type: ignore[no-untyped-def]
    """Fill in the least and the largest floor(a / b); the line where they are not told."""
    for i in range(t.shape[1]):
        al, ah, bl, bh = a[0, i], a[1, i], b[0, i], b[1, i]
        low, high = -np.inf, np.inf
        if ((bl > 0.0) | (bh < 0.0)) & ((ah - al) + (bh - bl) < np.inf):
            p, q, r, s = _floor(al, bl), _floor(al, bh), _floor(ah, bl), _floor(ah, bh)
            low, high = min(min(p, q), min(r, s)), max(max(p, q), max(r, s))
        sound = (abs(low) < EXACT) & (abs(high) < EXACT)
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf


@kernel
def remainder(t, turned, k, b, a):  # type: ignore[no-untyped-def]
    """Fill in t = mod(a, b): a - k b, as it is given, where there is one k; else 0 to b."""
    for i in range(t.shape[1]):
        low, high = min(b[0, i], 0.0), max(b[1, i], 0.0)
        if k[0, i] == k[1, i]:
            low, high = max(low, turned[0, i]), min(high, turned[1, i])
        apart = (b[0, i] > 0.0) | (b[1, i] < 0.0)
        sound = apart & ((a[1, i] - a[0, i]) + (b[1, i] - b[0, i]) < np.inf)
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf
