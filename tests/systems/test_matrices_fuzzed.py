"""Whatever is handed over as a finite model: it is read, or refused as bad input."""

from __future__ import annotations

import contextlib
import random
import warnings
from fractions import Fraction

import numpy as np
import pytest
from tables import STORM

import lmdsl as lm

JUNK = [0, 1, 0.5, -1, float("nan"), float("inf"), None, "a", "1/2", "1/0", Fraction(1, 3), True,
        1e-320, 10**400, [], [1], {}, np.float32(0.5), np.int8(1), 1j, b"x", (1, 2)]  # fmt: skip
CHARACTERS = '0123456789./eE[]:,@ \t\n"stateaction-+²é\x00'


@pytest.mark.parametrize("seed", range(3))
def test_spoiled_files_of_storm(seed, tmp_path):
    rnd, path, read = random.Random(seed), tmp_path / "model.drn", 0
    for _ in range(250):
        text = list(STORM)
        for _ in range(rnd.randint(1, 3)):
            k, what = rnd.randrange(len(text)), rnd.random()
            if what < 0.4:
                text[k] = rnd.choice(CHARACTERS)
            elif what < 0.7:
                del text[k]
            elif what < 0.9:
                text.insert(k, rnd.choice(CHARACTERS))
            else:
                a = rnd.randrange(len(text))
                text[k:k] = text[a : a + 20]
        path.write_text("".join(text))
        try:
            lm.compile(lm.from_matrices(path, "energy", targets=[2]))
            read += 1
        except lm.BadInput:
            pass
    assert 10 < read < 200


def nested(rnd, depth):
    """Lists of junk, not always as deep, nor as long."""
    if not depth:
        return rnd.choice(JUNK)
    deeper = depth - 1 if rnd.random() < 0.95 else max(depth - 2, 0)
    return [nested(rnd, deeper) for _ in range(rnd.choice([1, 2, 2, 2, 3]))]


def almost(rnd, shape):
    """Probabilities, a few of them spoiled."""
    rng = np.random.default_rng(rnd.randrange(10**6))

    def spoiled(x):
        if isinstance(x, list):
            return [spoiled(y) for y in x]
        return rnd.choice(JUNK) if rnd.random() < 0.05 else x

    return spoiled(rng.dirichlet(np.ones(shape[-1]), size=shape[:-1]).tolist())


def table(rnd, S, A):
    """A table of Gymnasium, a few of its entries spoiled."""
    return {
        s: {
            a: [(rnd.choice([*JUNK, *[1.0] * 20]), rnd.choice([0, 1, 0, 0, "x", -1, 10**20]),
                 rnd.choice([*JUNK, *[1.0] * 20]), rnd.choice([True, False, None]))]
            for a in range(A)
        }
        for s in range(S)
    }  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_junk_is_bad_input(seed):
    rnd = random.Random(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of NumPy about what is no array
        for _ in range(250):
            S, A = rnd.choice([1, 2, 3]), rnd.choice([1, 2])
            P = rnd.choice([
                lambda S=S, A=A: almost(rnd, (A, S, S)), lambda S=S, A=A: almost(rnd, (S * A, S)),
                lambda: nested(rnd, 3), lambda: nested(rnd, 2),
                lambda S=S: (almost(rnd, (S, S)), nested(rnd, 1), nested(rnd, 1)),
                lambda S=S, A=A: table(rnd, S, A),
            ])()  # fmt: skip
            cost = rnd.choice([lambda S=S: [1.0] * S, lambda S=S, A=A: [[1.0] * A] * S,
                               lambda: nested(rnd, 1), lambda: nested(rnd, 2), lambda: None,
                               lambda S=S, A=A: almost(rnd, (A, S, S))])()  # fmt: skip
            with contextlib.suppress(lm.BadInput):
                lm.compile(
                    lm.from_matrices(
                        P,
                        cost,
                        rnd.choice([[0], [], [S - 1], rnd.choice(JUNK)]),
                        rnd.choice([(), (), [0], rnd.choice(JUNK)]),
                        discount=rnd.choice([None, 0.9, 0.5]),
                        layout=rnd.choice(["auto", "states", "product", "pairs", "gymnasium"]),
                        maximise=rnd.random() < 0.3,
                    )
                )
