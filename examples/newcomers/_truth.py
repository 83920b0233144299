"""Closed-loop runs of the true system by SciPy alone, to set beside what lmdsl says.

Nothing of lmdsl is used here but the controller, as a table of numbers: u = control[cell of x].
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.stats import binomtest

Array = NDArray[np.float64]
FINE = 64  # places of a step at which its path is looked at


def flow(derivative: Callable[[Array, Array], Array], step: float) -> Callable[..., Array]:
    """Return the path of x' = derivative(x, u) during a step: (states, runs) -> (FINE, ...)."""

    def path(x: Array, u: Array, rng: np.random.Generator) -> Array:
        def slope(t: float, flat: Array) -> Array:
            return derivative(flat.reshape(x.shape), u).ravel()

        when = np.linspace(0, step, FINE + 1)[1:]
        done = solve_ivp(slope, (0, step), x.ravel(), "DOP853", when, rtol=1e-9, atol=1e-10)
        return done.y.T.reshape(FINE, *x.shape)

    return path


def runs(
    result,
    path: Callable[..., Array],
    reached: Callable[[Array], Array],
    unsafe: Callable[[Array], Array] = lambda x: np.zeros(x.shape[1:], bool),
    starts: int = 1000,
    steps: int = 1000,
    seed: int = 0,
) -> dict[str, float]:
    """Simulate from random places of the stabilizable cells; count what became of the runs.

    ``path(x, u, rng)`` returns where the runs are on the way, shape (places, states, runs), the
    last one the next state; ``reached`` and ``unsafe`` judge places of shape (states, ...).
    """
    rng = np.random.default_rng(seed)
    axes = list(result.problem.state_box.values())
    low, high = (np.array([getattr(a, end) for a in axes])[:, None] for end in ("low", "high"))
    cells = np.array([a.cells for a in axes])[:, None]
    circle = np.array([a.periodic for a in axes])[:, None]
    width = (high - low) / cells
    chosen = rng.choice(np.flatnonzero(result.cell_status == 1), starts)
    index = np.array(np.unravel_index(chosen, cells.ravel()))
    x = low + (index + rng.random(index.shape)) * width
    arrived = lost = touched = 0
    for _ in range(steps):
        index = np.floor((x - low) / width + 1e-9).astype(int)
        index = np.where(circle, index % cells, np.minimum(index, cells - 1))
        control = result.control_index[np.ravel_multi_index(tuple(index), cells.ravel())]
        lost += np.count_nonzero(control < 0)
        x, control = x[:, control >= 0], control[control >= 0]
        if not x.shape[1]:
            break
        way = path(x, result.control_vectors[control].T, rng)
        place = np.moveaxis(way, 1, 0)
        place = np.where(circle[..., None], low[..., None] + (place - low[..., None])
                         % (high - low)[..., None], place)  # fmt: skip
        outside = ~((place >= low[..., None]) & (place <= high[..., None])).all(axis=0)
        bad, good = outside | unsafe(place), reached(place)
        never = len(way)
        first_bad = np.where(bad.any(axis=0), bad.argmax(axis=0), never)
        first_good = np.where(good.any(axis=0), good.argmax(axis=0), never)
        ended = np.minimum(first_bad, first_good) < never
        arrived += np.count_nonzero(ended & (first_good < first_bad))
        lost += np.count_nonzero(ended & (first_good >= first_bad))
        harm = unsafe(place)
        first_harm = np.where(harm.any(axis=0), harm.argmax(axis=0), never)
        touched += np.count_nonzero((first_harm < never) & (first_harm == first_bad)
                                    & (first_harm < first_good))  # fmt: skip
        x = place[:, -1, ~ended]
    return {"starts": starts, "reached": arrived, "lost": lost, "touched": touched}


def beside(name: str, result, truth: dict[str, float], simulation) -> None:
    """Print the two side by side, and stop where they disagree."""
    print(f"{name}: {result.message}")
    for key in ("reached", "lost"):
        ours, theirs = getattr(simulation, key), truth[key]
        a = binomtest(ours, simulation.starts).proportion_ci(0.9999)
        b = binomtest(theirs, truth["starts"]).proportion_ci(0.9999)
        print(
            f"  {key:8} by lmdsl {100 * ours / simulation.starts:6.2f} %   "
            f"by SciPy alone {100 * theirs / truth['starts']:6.2f} %"
        )
        assert max(a.low, b.low) <= min(a.high, b.high), f"{key}: {a} and {b}"
