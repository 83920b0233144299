"""Runs over ranks: what becomes of every run is what becomes of it in one process."""

from pathlib import Path

import numpy as np
import pytest
from alike import sampled

import lmdsl as lm
from lmdsl.distributed.answering import answer
from lmdsl.distributed.simulating import Controlled, gathered, simulated
from lmdsl.ranks.threaded import as_threads

pytestmark = pytest.mark.long  # in other versions it would find nothing else

EXAMPLES = Path(__file__).parents[2] / "examples"


def runs(result, count, **options):
    """The runs over ranks of the controller of a result."""
    law = Controlled(result.problem, result.partition, result.control_vectors, result.control_index,
              result.cell_status)  # fmt: skip
    return as_threads(count, lambda ranks: simulated(ranks, law, **options))


def require_alike(one, found):
    """Require of all ranks the runs of one process, each of them."""
    for every in found:
        assert every.to_dict() == one.to_dict()
        for name in ("starts", "outcome", "lost_to", "steps", "times", "cost"):
            x, y = getattr(every.each, name), getattr(one.each, name)
            assert np.array_equal(x, y, equal_nan=x.dtype.kind == "f"), name


@pytest.mark.parametrize(
    "name", ["standard_map", "standard_map_held", "double_integrator", "zoo/circle_map"]
)
def test_runs_of_shipped_systems(name):
    """Of a map, under a local controller, of an equation, where attractor cells hold."""
    result = lm.solve(EXAMPLES / f"{name}.json")
    options = {"starts": 300, "steps": 200, "seed": 3, "hold": 20}
    one = result.simulate(**options)
    for count in (2, 3):
        require_alike(one, runs(result, count, **options))


@pytest.mark.parametrize("seed", [1, 3, 13])
def test_runs_with_noise(seed):
    result = lm.solve(sampled(seed))
    one = result.simulate(starts=1000, steps=50)
    for count in (1, 4):
        require_alike(one, runs(result, count, starts=1000, steps=50))


def test_a_finite_model():
    """Whose next states are drawn by its rows."""
    P = np.array([[[1.0, 0.0], [0.5, 0.5]], [[1.0, 0.0], [0.25, 0.75]]])
    result = lm.solve(lm.from_matrices(P, np.array([[0, 0], [1, 2.0]]), [0], layout="states"))
    require_alike(result.simulate(starts=200), runs(result, 3, starts=200))


def test_the_controller_of_an_answer():
    problem = lm.load(EXAMPLES / "standard_map.json")
    result = lm.solve(problem)

    def program(ranks):
        law = gathered(ranks, answer(ranks, problem))
        assert (law.control_index == result.control_index).all()
        return simulated(ranks, law, starts=100)

    require_alike(result.simulate(starts=100), as_threads(3, program))


def test_a_rank_without_time_ends_the_runs_of_all():
    result = lm.solve(EXAMPLES / "standard_map.json")
    law = Controlled(result.problem, result.partition, result.control_vectors, result.control_index,
              result.cell_status)  # fmt: skip

    def program(ranks):
        return simulated(ranks, law, 100, time_limit=1e-9 if ranks.rank else None)

    for found in as_threads(3, program):
        assert found.cut
        assert found.cycling == 100


def test_without_a_controller_there_is_nothing_to_run():
    def program(ranks):
        return simulated(ranks, gathered(ranks, answer(ranks, sampled(8))))

    with pytest.raises(lm.BadInput, match="no controller"):
        as_threads(2, program)
