"""A problem may be given by the path of its file."""

from __future__ import annotations

import os

import pytest
from problems import made, steps

import lmdsl as lm
from lmdsl.problem import given

PROBLEM = made(steps())


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    found = tmp_path_factory.mktemp("given") / "steps.json"
    PROBLEM.save(found)
    return found


@pytest.mark.parametrize("kind", [lambda path: path, str])
def test_verbs_take_a_path(path, kind):
    assert lm.compile(kind(path)).digest == lm.compile(PROBLEM).digest
    assert lm.solve(kind(path)).problem == PROBLEM
    assert lm.solve(kind(path), proved=0.5).proved.reached
    assert len(lm.compare(kind(path), ["policy-iteration", "highs"]).results) == 2
    assert lm.gamma_max(kind(path)).stabilizable == lm.compile(PROBLEM).n
    assert lm.explain(kind(path)).lost == 0
    assert lm.explain(kind(path), phase_one=True).phase_one.total == pytest.approx(0)
    assert lm.check(kind(path)).axes == {"x": 4}
    assert len(lm.study(kind(path), gamma=[1.0], starts=0).rows) == 1


def test_what_is_compiled_is_taken_as_it_is(path):
    lp = lm.compile(path)
    assert given(lp, lm.StabilizationLP) is lp
    assert given(PROBLEM) is PROBLEM


@pytest.mark.parametrize("verb", [lm.compile, lm.solve, lm.compare, lm.gamma_max, lm.explain,
                                  lm.check, lm.study, lm.suggest])  # fmt: skip
def test_what_is_no_problem_is_refused(verb, tmp_path):
    for bad in (3, None, {"format": "lmdsl/1"}, [PROBLEM]):
        with pytest.raises(lm.BadInput, match="a Problem or the path of a problem file"):
            verb(bad)
    with pytest.raises(lm.BadInput, match=r"nowhere\.json"):
        verb(tmp_path / "nowhere.json")
    with pytest.raises(lm.BadInput, match=r"is a directory; of a saved result take lm\.Result"):
        verb(os.fspath(tmp_path))


def test_what_is_compiled_already_is_no_problem_to_compile():
    with pytest.raises(lm.BadInput, match=r"a Problem or the path of a problem file$"):
        lm.compile(lm.compile(PROBLEM))
