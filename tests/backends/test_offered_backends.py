"""Backends of other packages: what is broken in one breaks no other."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
from foreign_backends import Unspeakable
from problems import made, steps

import lmdsl as lm
from lmdsl.backends import Backend, Capabilities, registry
from lmdsl.cli import main

BROKEN = {
    "absent": ("absent = no_such_package.module:BACKEND", "no_such_package"),
    "raises": ("raises = broken_package:RAISES", "kaboom"),
    "exits": ("exits = broken_exit:BACKEND", "SystemExit"),
    "number": ("number = broken_package:NUMBER", "no lmdsl.backends.Backend"),
    "attribute": ("attribute = broken_package:NOTHING", "AttributeError"),
    "record": ("record = broken_package:RECORD", "record is broken"),
    "names": ("names = broken_package:NAMES", "record is broken"),
    "nameless": ("nameless = broken_package:NAMELESS", "record is broken"),
    "inside": ("inside = broken_package:INSIDE", "missing_parent.child"),
    "inside failing": ("failing = broken_package:FAILING", "broken_parent.child"),
    "inside exiting": ("exiting = broken_package:EXITING", "broken_exit.child"),
    "twice": ("twice = broken_package:GOOD", "offered by"),
    "bad name": ("bad\x1b[2Jname = broken_package:GOOD", "no name"),
    "with:colon": ("with:colon = broken_package:GOOD", "no name"),
}
PACKAGE = """
from lmdsl.backends import Backend, Capabilities, Solution, Stop
NUMBER = 7
def solve(lp, options):
    return Solution(Stop.OPTIMAL, "optimal", policy=lp.tree[1])
GOOD = Backend("good", solve)
RECORD = Backend("record", solve, capabilities=None)
NAMES = Backend("names", solve, Capabilities(algorithms=(1, "\\x1b")))
NAMELESS = Backend(None, solve)
INSIDE = Backend("inside", solve, requires=("missing_parent.child",))
FAILING = Backend("failing", solve, requires=("broken_parent.child",))
EXITING = Backend("exiting", solve, requires=("broken_exit.child",))
def __getattr__(name):
    if name == "RAISES":
        raise RuntimeError("kaboom\\x1b[2J")
    raise AttributeError(name)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder of installed packages, most of them broken."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "broken_package.py").write_text(PACKAGE)
    (folder / "broken_exit.py").write_text("import sys; sys.exit(0)")
    (folder / "broken_parent").mkdir()
    (folder / "broken_parent" / "__init__.py").write_text("raise RuntimeError('kaboom')")
    lines = [line for line, _ in BROKEN.values()]
    for name, entries in (
        ("broken", [*lines, "good = broken_package:GOOD", "highs = broken_package:NUMBER"]),
        ("second", ["twice = broken_package:NUMBER"]),
    ):
        info = folder / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("\n".join(["[lmdsl.backends]", *entries]))
    nameless = folder / "nameless-1.0.dist-info"
    nameless.mkdir()
    (nameless / "entry_points.txt").write_text("[lmdsl.backends]\nanonymous = nowhere:BACKEND")
    return folder


@pytest.fixture
def installed(site, monkeypatch):
    monkeypatch.syspath_prepend(str(site))


def test_a_broken_package_breaks_no_other(installed, capsys, lp):
    assert main(["backends", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert listed["good"]["available"]
    assert listed["highs"]["available"]
    assert not listed["anonymous"]["available"]
    assert main(["backends"]) == 0
    text = capsys.readouterr().out
    assert all(line.isprintable() for line in text.splitlines())
    assert lm.solve(lp, "good").status == "verified"
    assert lm.solve(lp, "highs").status == "verified"


@pytest.mark.parametrize("text", ["no value\n", "[lmdsl.backends]\nno value\n", "[x\n", "= 7\n"])
def test_entry_points_that_cannot_be_read_hide_no_other(
    installed, tmp_path, monkeypatch, capsys, lp, text
):
    info = tmp_path / "unreadable-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: unreadable\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert main(["backends", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["good"]["available"]
    assert lm.solve(lp, "good").status == "verified"
    with pytest.raises(lm.BadInput, match="offered by"):
        lm.backends.get("twice")


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_said_with_the_package(installed, name):
    line, reason = BROKEN[name]
    with pytest.raises(lm.BadInput) as refused:
        lm.backends.get(line.split(" = ")[0])
    assert reason in str(refused.value)
    assert str(refused.value).isprintable()
    if not name.startswith("inside"):
        assert "broken" in str(refused.value)


def test_an_extra_that_is_missing_is_named(monkeypatch, lp):
    monkeypatch.setattr(registry, "_found", lambda package: package != "casadi")
    assert "ipopt" not in lm.backends.installed()
    assert "ipopt" in lm.backends.names()
    with pytest.raises(lm.BadInput, match="ipopt needs the package casadi"):
        lm.solve(lp, "ipopt")


@pytest.mark.parametrize("spec", [None, 7, b"highs", ["highs"], "", ":", "highs:", "\x1b[2J"])
def test_what_names_no_backend_is_bad_input(lp, spec):
    if spec == "highs:":
        assert lm.backends.resolve(spec)[1] is None
        return
    with pytest.raises(lm.BadInput) as refused:
        lm.solve(lp, spec)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("broken", [
    Backend(None, lambda lp, o: None), Backend("a", 7), Backend("a", lambda lp, o: None, None),
    Backend("a", lambda lp, o: None, Capabilities(algorithms=5)),
    Backend("a\n", lambda lp, o: None), Backend("a", lambda lp, o: None, requires=(Unspeakable(),)),
])  # fmt: skip
def test_a_backend_with_a_broken_record_is_bad_input(lp, broken):
    with pytest.raises(lm.BadInput, match="record is broken"):
        lm.solve(lp, broken)


@pytest.mark.long
def test_a_backend_that_exits_does_not_end_the_command(site, tmp_path):
    (site / "quitting.py").write_text(
        "import sys\nfrom lmdsl.backends import Backend\n"
        "BACKEND = Backend('quits', lambda lp, o: sys.exit(0))\n"
    )
    made(steps()).save(tmp_path / "p.json")
    code = (
        "import sys; from lmdsl.cli import main\n"
        "import lmdsl.backends as b, quitting\n"
        "b.BUILT_IN['quits'] = 'quitting'\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "solve", str(tmp_path / "p.json"), "--backend", "quits",
         "--json"], capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *sys.path])},
    )  # fmt: skip
    assert done.returncode == 0
    assert json.loads(done.stdout)["status"] == "verified"
    assert "SystemExit" in json.loads(done.stdout)["solver_status"]
