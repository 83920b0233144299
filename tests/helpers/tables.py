"""Tables of Gymnasium's environments, made without it, a file of Storm, and value iteration."""

from __future__ import annotations

import numpy as np

LAKES = {
    "4x4": ["SFFF", "FHFH", "FFFH", "HFFG"],
    "8x8": ["SFFFFFFF", "FFFFFFFF", "FFFHFFFF", "FFFFFHFF", "FFFHFFFF", "FHHFFFHF", "FHFFHFHF",
            "FFFHFFFG"],
}  # fmt: skip

TAXI = ["+---------+", "|R: | : :G|", "| : | : : |", "| : : : : |", "| | : | : |", "|Y| : |B: |",
        "+---------+"]  # fmt: skip
PLACES = [(0, 0), (0, 4), (4, 0), (4, 3)]


STORM = """// Exported by storm
// Original model type: MDP
@type: MDP
@parameters

@reward_models
steps energy
@nr_states
3
@nr_choices
4
@model
state 0 [0, 1] init
//[x=0]
\taction go [1, 0.5]
\t\t1 : 0.3
\t\t2 : 0.7
\taction wait [1, 0]
\t\t0 : 1
state 1 "far off"
\taction go [1, 2]
\t\t0 : 0.3333333333
\t\t2 : 0.6666666667
state 2 done
\taction __NOLABEL__ [0, 0]
\t\t2 : 1
"""


def frozen_lake(name="4x4", slippery=True):
    """P of FrozenLake: left, down, right, up; a third each for the way and both sides."""
    lake = LAKES[name]
    n = len(lake)
    steps = [(0, -1), (1, 0), (0, 1), (-1, 0)]
    success = 1.0 / 3.0
    fail = (1.0 - success) / 2.0
    P = {s: {a: [] for a in range(4)} for s in range(n * n)}
    for row in range(n):
        for column in range(n):
            s = row * n + column
            for a in range(4):
                if lake[row][column] in "GH":
                    P[s][a].append((1.0, s, 0, True))
                    continue
                ways = [(fail, (a - 1) % 4), (success, a), (fail, (a + 1) % 4)]
                for share, way in ways if slippery else [(1.0, a)]:
                    r = min(max(row + steps[way][0], 0), n - 1)
                    c = min(max(column + steps[way][1], 0), n - 1)
                    letter = lake[r][c]
                    P[s][a].append((share, r * n + c, int(letter == "G"), letter in "GH"))
    return P


def taxi():
    """P of Taxi: south, north, east, west, pick up, drop off; 500 states."""
    P = {s: {} for s in range(500)}
    for s in P:
        rest, goal = divmod(s, 4)
        rest, passenger = divmod(rest, 5)
        row, column = divmod(rest, 5)
        for a in range(6):
            r, c, p, reward, done = row, column, passenger, -1, False
            here = (row, column)
            if a == 0:
                r = min(row + 1, 4)
            elif a == 1:
                r = max(row - 1, 0)
            elif a == 2 and TAXI[1 + row][2 * column + 2] == ":":
                c = min(column + 1, 4)
            elif a == 3 and TAXI[1 + row][2 * column] == ":":
                c = max(column - 1, 0)
            elif a == 4:
                if passenger < 4 and here == PLACES[passenger]:
                    p = 4
                else:
                    reward = -10
            elif a == 5:
                if passenger == 4 and here == PLACES[goal]:
                    p, reward, done = goal, 20, True
                elif passenger == 4 and here in PLACES:
                    p = PLACES.index(here)
                else:
                    reward = -10
            P[s][a] = [(1.0, ((r * 5 + c) * 5 + p) * 4 + goal, reward, done)]
    return P


def value_iteration(P, discount, sweeps=20_000):
    """Values and greedy values of all actions, in plain Python."""
    V = np.zeros(len(P))
    while sweeps:
        sweeps -= 1
        Q = np.array(
            [
                [
                    sum(p * (r + discount * (0.0 if end else V[j])) for p, j, r, end in P[s][a])
                    for a in sorted(P[s])
                ]
                for s in sorted(P)
            ]
        )
        new = Q.max(axis=1)
        if np.abs(new - V).max() <= 1e-13 * max(1.0, np.abs(V).max()):
            return new, Q
        V = new
    return V, Q
