"""Random loops: whatever the axes, noise, paths and exits, what is proved of boxes happens."""

from __future__ import annotations

import numpy as np
import pytest
from random_loops import followed, random_problem

from lmdsl.model.successors.compiled import enclosing, places

pytestmark = pytest.mark.long  # in other versions it would find nothing else


def follow(seed, count, most):
    """Prove random loops; return the shares seen."""
    shares = np.zeros(4)
    for _, _, proof in followed(random_problem, np.random.default_rng(seed), count, most, 2000):
        shares += proof.arrives, proof.lost, proof.stays, proof.undecided
    return shares / count


def test_what_is_proved_happens():
    shares = follow(0, 12, 2_000)
    assert shares[0] > 0.1


def narrow(step, given, held=None):
    """Enclose half of every box only."""
    middle, away = given.low / 2 + given.high / 2, (given.high - given.low) / 4
    return WHOLE(step, given._replace(low=middle - away, high=middle + away), held)


WHOLE = enclosing.enclose


@pytest.mark.parametrize(
    ("module", "name", "spoilt"),
    [(places, "follow", lambda *_: None), (enclosing, "enclose", narrow)],
)
def test_runs_find_out_what_is_not_enclosed(monkeypatch, module, name, spoilt):
    """Without the path, or the outer half of boxes, other things happen than are proved."""
    monkeypatch.setattr(module, name, spoilt)
    with pytest.raises(AssertionError):
        follow(2, 40, 1_000)


@pytest.mark.long
@pytest.mark.full
def test_what_is_proved_happens_in_many_loops():
    shares = follow(1, 150, 6_000)
    assert (shares > 0.001).all()
