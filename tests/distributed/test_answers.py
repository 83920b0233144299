"""What a solve over ranks returns is what one process returns, in the same words."""

from pathlib import Path

import pytest
from alike import alike, answers, sampled

import lmdsl as lm

pytestmark = pytest.mark.long  # in other versions it would find nothing else

MAP = lm.load(Path(__file__).parents[2] / "examples/standard_map.json")


def test_the_standard_map():
    assert alike(MAP, (1, 2, 3, 4)).status == "verified"


@pytest.mark.parametrize("restrict", [False, True])
def test_beyond_gamma_bar(restrict):
    """With the bracket, the cells that limit it, and what is left."""
    one = alike(MAP.replaced(gamma=2.6), (2, 3), restrict_to_gamma=restrict)
    assert (one.status, one.cause) == ("not_stabilizable", "gamma")


@pytest.mark.parametrize(("seed", "status", "cause"), [
    (7, "unverified", None), (8, "not_stabilizable", "empty"), (12, "not_stabilizable", "gamma"),
    (1, "verified", None),
])  # fmt: skip
def test_random_problems(seed, status, cause):
    one = alike(sampled(seed), (2, 3))
    assert (one.status, one.cause) == (status, cause)


def test_all_cells_are_required():
    one = alike(sampled(9), (2,), require_all=True)
    assert one.cause == "require_all"


def test_how_many_cells_of_others_ranks_know():
    """None alone; more ranks know more, and at most all others each."""
    ghosts = [answers(MAP, count)[0].ghosts for count in (1, 2, 4)]
    assert ghosts[0] == 0
    assert 0 < ghosts[1] < ghosts[2] <= 3
