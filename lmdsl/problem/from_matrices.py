"""A problem from the matrices of a finite model, as other tools hold them."""

import os
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

from lmdsl.common.types import Bools, Indices
from lmdsl.errors import BadInput, shown
from lmdsl.problem.axes import Axis
from lmdsl.problem.controls import ControlValues
from lmdsl.problem.problem import Problem
from lmdsl.problem.sampling import Grid
from lmdsl.problem.sets import MAX_BOXES, Attractor, Avoid, Measure
from lmdsl.systems.matrices.costs import paid, with_cost
from lmdsl.systems.matrices.drn import Explicit, labelled, read_drn
from lmdsl.systems.matrices.exact import exact
from lmdsl.systems.matrices.layouts import layout_of, read_arrays, read_gymnasium
from lmdsl.systems.matrices.listing import Listing
from lmdsl.systems.matrices.rows import GivenRows
from lmdsl.systems.matrices.system import MatrixSystem

Layout = Literal["auto", "states", "product", "pairs", "gymnasium", "drn"]
STATE, ACTION = "state", "action"


def from_matrices(
    P: Any,
    cost: Any = None,
    targets: Iterable[int] | str = (),
    avoid: Iterable[int] | str = (),
    gamma: float = 1.0,
    discount: float | None = None,
    layout: Layout = "auto",
    maximise: bool = False,
) -> Problem:
    """Return the problem of a finite model: one axis ``state``, one control ``action``.

    State s is the cell of the same number, action a the control value. What is solved, certified,
    explained and saved is the model as given: nothing is sampled.

    Parameters
    ----------
    P
        Transition probabilities in one of the layouts: ``states``, (A, S, S), a matrix for each
        action, dense or sparse; ``product``, (S, A, S); ``pairs``, (Q, s_indices, a_indices) with a
        row of Q for each pair, or Q alone with row s A + a; ``gymnasium``, P[s][a] a list of
        (probability, next state, reward, terminated); ``drn``, the path of a file of Storm.
        A row of floats that sums to 1 within 1e-9 is divided by its sum, exactly; Fractions are
        kept and have to sum to 1. What a row lacks escapes, unless it lacks what ``discount``
        says in every row. A pair with an empty row is inadmissible.
    cost
        >= 0, of shape (S, A), (S,) or (pairs,), or one for each transition, in the shape of P;
        infinite where a pair is inadmissible. For ``drn`` the name of a reward model, and None
        where it has one; None for ``gymnasium``.
    targets, avoid
        States: the attractor, and what counts as an escape. For ``drn`` also a label; the label
        ``init`` says where runs begin (``measure``). May be empty with a discount, and where
        transitions terminate.
    gamma, discount
        As in a problem file.
    layout
        ``auto`` takes what fits the shape, and refuses a shape that fits two.
    maximise
        The figures are rewards. They become costs R - r, R the largest reward, and R/(1 - gamma b)
        for what is missed after a target; ``result.reward`` gives the user's figure.

    Returns
    -------
    Problem
        Its results are saved with the matrices.

    Raises
    ------
    BadInput
        The matrices are none, a row sums to more than 1, a cost is negative, or sets are empty.

    Notes
    -----
    A transition that terminates leads to one more state, number S, which is a target.

    Examples
    --------
    >>> import lmdsl as lm
    >>> P = [[[0.5, 0.5], [0.0, 1.0]]]
    >>> problem = lm.from_matrices(P, cost=[1, 0], targets=[1], layout="states")
    >>> lm.solve(problem).value.tolist()[1]
    0.0
    """
    if not isinstance(maximise, bool | np.bool_):
        raise BadInput(f"{shown(maximise)} is not accepted; write True or False", "maximise")
    chosen = layout_of(P, layout)
    listing, found = _read(P, cost, chosen)
    listing = listing.ordered()
    figures, best, listing = paid(listing, bool(maximise))
    ends = listing.ends is not None and bool(listing.ends.any())
    cells = listing.states + ends
    goal = _states(targets, "targets", listing.states, found)
    unsafe = _states(avoid, "avoid", listing.states, found)
    if best is not None:
        best = max(best, 0.0) if ends or goal.any() else best
        figures = np.where(_there(listing), best - figures, 0.0)
    shares = exact(listing, discount)
    pairs = (listing.state, listing.action)
    rows = GivenRows.of(cells, listing.actions, pairs, shares, figures)
    reached = [*np.flatnonzero(goal).tolist(), *([listing.states] if ends else [])]
    if not reached and discount is None:
        raise BadInput("no target; give states, or a discount: then there may be none", "targets")
    return Problem(
        system=MatrixSystem(rows=rows, best_reward=best),
        state_box={STATE: Axis(low=-0.5, high=cells - 0.5, cells=cells)},
        control_grid={ACTION: ControlValues(values=tuple(map(float, range(listing.actions))))},
        attractor=Attractor(cells=tuple((cell,) for cell in reached)),
        avoid=Avoid(boxes=_boxes(unsafe, "avoid")) if unsafe.any() else None,
        measure=_begins(found, goal | unsafe),
        stage_cost="0",
        sampling=Grid(per_axis=1),
        gamma=float(gamma),
        discount=discount,
    )


def _read(P: Any, cost: Any, layout: str) -> tuple[Listing, Explicit | None]:
    if layout == "drn":
        if not isinstance(P, str | os.PathLike):
            raise BadInput(f"{shown(P)} is no path of a DRN file", "P")
        name = cost if isinstance(cost, str) else None
        listing, found = read_drn(P, name)
        return (listing if cost is name else with_cost(listing, cost, layout)), found
    if layout == "gymnasium":
        return with_cost(read_gymnasium(P), cost, layout), None
    return with_cost(read_arrays(P, layout), cost, layout), None


def _there(listing: Listing) -> Bools:
    return np.bincount(listing.pair, minlength=len(listing.state)) > 0


def _states(given: Any, where: str, count: int, found: Explicit | None) -> Bools:
    """Return a mask of states named by number, by mask, or by label."""
    mask = np.zeros(count, dtype=np.bool_)
    if isinstance(given, str):
        if found is None:
            raise BadInput(f"{given!r} is a label, which only DRN files have", where)
        given = labelled(found, [given])
    given = list(given) if isinstance(given, set | frozenset | range) else given
    array = np.asarray(given)
    if array.dtype.kind == "b" and array.shape == (count,):
        return array.astype(np.bool_)
    if array.dtype.kind in "US" and found is not None:
        array = np.asarray(labelled(found, array.tolist()), dtype=np.int64)
    if not array.size:
        return mask
    if array.ndim == 0 and array.dtype.kind in "iu":
        raise BadInput(f"{int(array)} stands for one; write a list of them, [{int(array)}]", where)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise BadInput(f"{shown(given)} are no states; give their numbers", where)
    if array.min() < 0 or array.max() >= count:
        raise BadInput(f"states are 0..{count - 1}, not {shown(array.tolist())}", where)
    mask[array] = True
    return mask


def _begins(found: Explicit | None, elsewhere: Bools) -> Measure | None:
    """Return the weight of the initial states that a file names; None where there are none."""
    initial = np.zeros(len(elsewhere), dtype=np.bool_)
    initial[found.labels.get("init", []) if found else []] = True
    initial &= ~elsewhere
    return Measure(boxes=_boxes(initial, "measure")) if initial.any() else None


def _boxes(mask: Bools, where: str) -> tuple[dict[str, tuple[float, float]], ...]:
    """Return the boxes that cover the cells of a mask, a box for each run of neighbours."""
    edges: Indices = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    if len(edges) > 2 * MAX_BOXES:
        raise BadInput(
            f"{len(edges) // 2} separate runs of states; at most {MAX_BOXES}: order the states so "
            "that they are neighbours",
            where,
        )
    ends = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return tuple({STATE: (a - 0.5, b - 0.5)} for a, b in ends)
