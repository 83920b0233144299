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
SURE = 0.99  # level of the intervals that must overlap
EVENTS = ("reached", "outside", "avoid", "no_control")


def flow(derivative: Callable[[Array, Array], Array], step: float) -> Callable[..., Array]:
    """Return the path of x' = derivative(x, u) during a step: (states, runs) -> (FINE, ...)."""

    def path(x: Array, u: Array, rng: np.random.Generator) -> Array:
        def slope(t: float, flat: Array) -> Array:
            return derivative(flat.reshape(x.shape), u).ravel()

        when = np.linspace(0, step, FINE + 1)[1:]
        done = solve_ivp(slope, (0, step), x.ravel(), "DOP853", when, rtol=1e-9, atol=1e-10)
        return done.y.T.reshape(FINE, *x.shape)

    return path


def first(places: Array) -> Array:
    """Return the first place on the way where something holds; far beyond the last where none."""
    return np.where(places.any(axis=0), places.argmax(axis=0), 10**9)


def runs(
    result,
    path: Callable[..., Array],
    reached: Callable[[Array], Array],
    unsafe: Callable[[Array], Array] = lambda x: np.zeros(x.shape[1:], bool),
    starts: int = 4000,
    steps: int = 1000,
    seed: int = 1,
) -> dict[str, int]:
    """Simulate from random places of the stabilizable cells; count what became of the runs.

    ``path(x, u, rng)`` returns where the runs are on the way, shape (places, states, runs), the
    last one the next state; ``reached`` and ``unsafe`` judge places of shape (states, ...). A run
    ends where it first reaches the target, leaves the box (``outside``), touches what is ``unsafe``
    (``avoid``), or comes to a cell without control (``no_control``).
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
    found = {"starts": starts, **dict.fromkeys(EVENTS, 0)}
    for _ in range(steps):
        index = np.floor((x - low) / width + 1e-9).astype(int)
        index = np.where(circle, index % cells, np.minimum(index, cells - 1))
        control = result.control_index[np.ravel_multi_index(tuple(index), cells.ravel())]
        found["no_control"] += np.count_nonzero(control < 0)
        x, control = x[:, control >= 0], control[control >= 0]
        if not x.shape[1]:
            break
        way = path(x, result.control_vectors[control].T, rng)
        place = np.moveaxis(way, 1, 0)
        place = np.where(circle[..., None], low[..., None] + (place - low[..., None])
                         % (high - low)[..., None], place)  # fmt: skip
        outside = ~((place >= low[..., None]) & (place <= high[..., None])).all(axis=0)
        events = {"outside": outside, "avoid": unsafe(place) & ~outside, "reached": reached(place)}
        when = {name: first(places) for name, places in events.items()}
        earliest = np.minimum.reduce(list(when.values()))
        ended = earliest < len(way)
        for name in events:  # where two fall together the worse one counts
            now = ended & (when[name] == earliest)
            found[name] += np.count_nonzero(now)
            earliest[now] = -1
        x = place[:, -1, ~ended]
    found["safe"] = starts - found["outside"] - found["avoid"]
    return found


def beside(name: str, result, truth: dict[str, int], simulation) -> None:
    """Print success and safety side by side, and stop where they disagree."""
    ours = {"starts": simulation.starts, "reached": simulation.reached, **simulation.lost_to}
    ours["safe"] = ours["starts"] - ours["outside"] - ours["avoid"]
    print(f"{name}: {result.message}")
    print(f"{'':24}{'by lmdsl':>28}{'by SciPy alone':>28}")
    words = {"reached": "arrive", "safe": "are never unsafe", "outside": "leave the box",
             "avoid": "touch what is avoided", "no_control": "lose their control"}  # fmt: skip
    for key, word in words.items():
        line, ends = f"  {word:22}", []
        for who in (ours, truth):
            share = who[key] / who["starts"]
            sure = binomtest(who[key], who["starts"]).proportion_ci(SURE)
            line += f"{100 * share:10.2f} % ({100 * sure.low:5.2f}..{100 * sure.high:6.2f})"
            ends.append(sure)
        print(line)
        assert max(e.low for e in ends) <= min(e.high for e in ends), f"{name}, {word}: {ends}"
