"""Costs or rewards of a finite model: of states, of pairs or of transitions, in any usual shape."""

from dataclasses import replace
from typing import Any

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.errors import BadInput
from lmdsl.systems.matrices.layouts import coordinates, doubles, is_sparse, shape_of
from lmdsl.systems.matrices.listing import Listing


def with_cost(listing: Listing, cost: Any, layout: str) -> Listing:
    """Return a listing with what is paid: by pair, or by transition."""
    if cost is None:
        if listing.value is None and listing.of_pair is None:
            raise BadInput("give the costs, or rewards with maximise=True", "cost")
        return listing
    listing = replace(listing, value=None, of_pair=None)
    if _of_transitions(cost, listing, layout):
        return replace(listing, value=_by_transition(cost, listing, layout))
    array = doubles(_plain(cost), "cost")
    S, A, K = listing.states, listing.actions, len(listing.state)
    by_shape = {(S, A): lambda: array[listing.state, listing.action], (K,): lambda: array}
    if array.shape == (S,) == (K,) and not (listing.state == np.arange(S)).all():
        raise BadInput(f"{S} numbers may be of the states or of the pairs; give (S, A)", "cost")
    by_shape.setdefault((S,), lambda: array[listing.state])
    if array.shape not in by_shape:
        raise BadInput(
            f"has shape {array.shape}; give (S, A) = {(S, A)}, (S,) = {(S,)}, one number per "
            f"pair {(K,)}, or one per transition, in the shape of P",
            "cost",
        )
    return replace(listing, of_pair=by_shape[array.shape]())


def _plain(cost: Any) -> Any:
    return cost.toarray() if is_sparse(cost) else cost


def _of_transitions(cost: Any, listing: Listing, layout: str) -> bool:
    """Return whether there is one number per transition: as many matrices, or rows, as P has."""
    S, A, K = listing.states, listing.actions, len(listing.state)
    if isinstance(cost, list | tuple) and any(map(is_sparse, cost)):
        return True
    shape = shape_of(cost)
    wanted = {"states": (A, S, S), "product": (S, A, S), "pairs": (K, S)}.get(layout)
    return shape == wanted and wanted != (S, A)


def _by_transition(cost: Any, listing: Listing, layout: str) -> Floats:
    S, A = listing.states, listing.actions
    state, action = listing.state[listing.pair], listing.action[listing.pair]
    if layout == "product":
        table = doubles(cost, "cost")
        return np.asarray(table[state, action, listing.target])
    if layout == "pairs":
        return _looked_up(cost, listing.pair, listing.target)
    if len(cost) != A:
        raise BadInput(f"{len(cost)} matrices for {A} actions; give one each", "cost")
    found = np.empty(len(state))
    for a in range(A):
        of = np.flatnonzero(action == a)
        if shape_of(cost[a]) != (S, S):
            raise BadInput(f"the matrix of action {a} has shape {shape_of(cost[a])}", "cost")
        found[of] = _looked_up(cost[a], state[of], listing.target[of])
    return found


def _looked_up(matrix: Any, row: Any, column: Any) -> Floats:
    if not is_sparse(matrix):
        return np.asarray(doubles(matrix, "cost")[row, column])
    (_, S), r, c, values = coordinates(matrix, "cost")
    key, wanted = r * S + c, row * S + column
    if not len(key):
        return np.zeros(len(wanted))
    at = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    return np.where(key[at] == wanted, doubles(values, "cost")[at], 0.0)


def paid(listing: Listing, maximise: bool) -> tuple[Floats, float | None, Listing]:
    """Return the cost of each pair, R where rewards are maximised, and the pairs that there are.

    Pairs of infinite cost (or of reward minus infinity) are left out.

    Raises
    ------
    BadInput
        A cost is negative, or no number.
    """
    figure = _mean(listing)
    forbidden = figure == (-np.inf if maximise else np.inf)
    if forbidden.any():
        kept = ~forbidden[listing.pair]
        listing = replace(
            listing,
            pair=listing.pair[kept],
            target=listing.target[kept],
            share=listing.share[kept],
            ends=None if listing.ends is None else listing.ends[kept],
        )
    there = ~forbidden & (np.bincount(listing.pair, minlength=len(figure)) > 0)
    wrong = there & ~np.isfinite(figure)
    if not maximise:
        wrong |= there & (figure < 0)
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        hint = "" if maximise else "; a cost is finite and >= 0 (rewards: maximise=True)"
        raise BadInput(f"{listing.name(k)}: {float(figure[k])!r}{hint}", "cost")
    figure = np.where(there, figure, 0.0)
    if not maximise:
        return figure, None, listing
    best = float(figure[there].max(initial=-np.inf)) if there.any() else 0.0
    return figure, best, listing


def _mean(listing: Listing) -> Floats:
    """Return what each pair costs in the mean over its transitions."""
    K = len(listing.state)
    if listing.value is None:
        of_pair = np.zeros(K) if listing.of_pair is None else listing.of_pair
        return np.asarray(of_pair, dtype=np.float64)
    share = doubles(listing.share, "P")
    with np.errstate(invalid="ignore", over="ignore"):
        total = np.bincount(listing.pair, share * listing.value, minlength=K)
        weight = np.bincount(listing.pair, share, minlength=K)
        mean = total / np.where(weight > 0, weight, 1.0)
    start = np.flatnonzero(np.diff(listing.pair, prepend=-1))
    if len(start):  # of equal costs the mean is no more and no less
        least = np.minimum.reduceat(listing.value, start)
        equal = least == np.maximum.reduceat(listing.value, start)
        mean[listing.pair[start[equal]]] = least[equal]
    if listing.of_pair is not None:
        mean = mean + listing.of_pair
    return np.asarray(mean)
