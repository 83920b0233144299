"""A dozen problems as threads and as processes: the same bits, that one process verifies."""

import pytest
from distributed_programs import DOZEN, problem, solve_dozen
from launching import needs_mpi, returned

import lmdsl as lm
from lmdsl.ranks.threaded import as_threads

SCRIPT = "distributed_programs.py"


def files(folder):
    return {path.name: path.read_bytes() for path in folder.glob("*.npy")}


@pytest.mark.long
def test_a_dozen_problems_as_threads(tmp_path):
    """As one process answers them; 2 and 3 ranks."""
    assert all(map(problem, DOZEN))
    said = [as_threads(n, lambda r, n=n: solve_dozen(r, tmp_path / str(n)))[0] for n in (2, 3)]
    for k, name in enumerate(DOZEN):
        one = lm.solve(problem(name))
        assert said[0][k][0] == said[1][k][0] == one.status
        assert said[0][k][2] == said[1][k][2]
        for count in ("2", "3"):
            checked = lm.verify(tmp_path / count / str(name))
            assert checked.same_model
            assert checked.holds == (one.exit_status in (0, 3)), (name, checked.reasons)
            found = lm.Result.load(tmp_path / count / str(name))
            assert (found.control_index == one.control_index).all()


@pytest.mark.long
@needs_mpi
@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.full)])
def test_a_dozen_problems_as_processes(tmp_path, count):
    """To the bits of threads: processes share nothing but a program."""
    assert all(map(problem, DOZEN))
    found = returned(count, "solve_dozen", str(tmp_path / "mpi"), script=SCRIPT)
    said = as_threads(2, lambda ranks: solve_dozen(ranks, tmp_path / "threads"))
    assert found == [found[0]] * count
    for (status, cost, digest), expected in zip(found[0], said[0], strict=True):
        assert [status, digest] == [expected[0], expected[2]]
        assert cost == (cost and pytest.approx(expected[1], rel=1e-12))
    for name in map(str, DOZEN):
        assert files(tmp_path / "mpi" / name) == files(tmp_path / "threads" / name)
