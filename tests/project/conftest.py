"""Shared by the tests of project."""

import pytest
from contestants import FATES, ROOT

from benchmarks import measure, rivals
from benchmarks.rivals import Contestant


@pytest.fixture(scope="module")
def contest(tmp_path_factory):
    """The contest of all fake rivals, and the processes that are left after it."""
    folder = tmp_path_factory.mktemp("contest")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT / "tests/helpers"))
        facts = measure.prepared("standard-map-10", 1.02, folder, 100)
        fakes = [Contestant(name, "fake_rival", name) for name in FATES]
        gone = Contestant("is not there", "fake_rival", package="no_such_package_anywhere")
        ours = [one for one in rivals.ALL if one.name == rivals.OURS]
        rules = measure.Rules(repeats=2, limit=3.0, budget=0.5)
        lines = []
        rows = measure.contest(facts, [*ours, gone, *fakes], folder, rules, lines.append)
    return {row.contestant: row for row in rows}, lines
