"""The command line refuses: bad input, folders of others, altered results."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
from command_line import run, spoil_array
from problems import standard_map, steps

import lmdsl as lm


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["nonsense"],
        ["solve"],
        ["solve", "missing.json"],
        ["solve", "FILE", "--backend", "cplex"],
        ["solve", "FILE", "--backend", "highs:magic"],
        ["solve", "FILE", "--gamma", "-1"],
        ["solve", "FILE", "--gamma", "nan"],
        ["solve", "FILE", "--gamma", "one"],
        ["solve", "FILE", "--tolerance", "-1"],
        ["solve", "FILE", "--tolerance", "nan"],
        ["solve", "FILE", "--time-limit", "0"],
        ["solve", "FILE", "--time-limit", "nan"],
        ["solve", "FILE", "--max-iterations", "0"],
        ["solve", "FILE", "--out", "FILE"],
        ["solve", "FILE", "--out", "FILE/below"],
        ["solve", "FILE", "--out", "/proc/nowhere/out"],
        ["solve", "FILE", "--frobnicate"],
        ["compare", "FILE", "--backends", ""],
        ["compare", "FILE", "--backends", "policy-iteration,nobody"],
        ["verify", "missing"],
        ["verify", "FILE"],
        ["simulate", "missing"],
        ["plot", "missing"],
        ["init", "nobody"],
    ],
)
def test_usage_and_bad_input(capsys, file, tmp_path, arguments):
    path = file(steps())
    before = sorted(os.listdir(tmp_path))
    status, _, err = run(capsys, *(a.replace("FILE", path) for a in arguments))
    assert status == 2
    assert err
    assert sorted(os.listdir(tmp_path)) == before


def test_a_folder_of_somebody_else_is_not_touched(capsys, file, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "thesis.tex").write_text("precious")
    status, _, err = run(capsys, "solve", file(steps()), "--out", folder)
    assert status == 2
    assert "not a result directory" in err
    assert (folder / "thesis.tex").read_text() == "precious"
    status, _, _ = run(capsys, "solve", file(steps()), "--out", tmp_path / "out")
    (tmp_path / "out" / "notes.txt").write_text("precious")
    status, _, _ = run(capsys, "solve", file(steps(1.5)), "--out", tmp_path / "out")
    assert status == 0
    assert lm.Result.load(tmp_path / "out").gamma == 1.5
    assert (tmp_path / "out" / "notes.txt").read_text() == "precious"


def test_an_empty_folder_is_used(capsys, file, tmp_path):
    (tmp_path / "out").mkdir()
    assert run(capsys, "solve", file(steps()), "--out", tmp_path / "out")[0] == 0
    assert (tmp_path / "out" / "solution.npz").exists()


def spoil_certificate(folder, **changes):
    path = folder / "certificate.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_verify_refuses_altered_results(capsys, file, tmp_path):
    def fresh():
        folder = tmp_path / "out"
        run(capsys, "solve", file(standard_map(20)), "--out", folder)
        assert run(capsys, "verify", folder)[0] == 0
        return folder

    for changes in ({"cost": 1.0}, {"gap": 0.0}, {"contraction": 0.1}, {"lower_bound": 99.0},
                    {"status": "unverified"}, {"status": "not_stabilizable"},
                    {"gamma": 1.5}):  # fmt: skip
        folder = fresh()
        spoil_certificate(folder, **changes)
        status, out, _ = run(capsys, "verify", folder)
        assert status == 1, changes
        assert "NOT confirmed" in out
    alterations = {
        "control_index": lambda a: a.__setitem__(5, (a[5] + 7) % 21),
        "value": lambda a: a.__imul__(0.999),
        "lower": lambda a: a.__imul__(1.001),
        "measure": lambda a: a.__imul__(1.001),
        "witness": lambda a: a.fill(1.0),
        "cell_status": lambda a: a.__setitem__(0, 4),
    }
    for name, change in alterations.items():
        folder = fresh()
        spoil_array(folder, name, change)
        assert run(capsys, "verify", folder)[0] == 1, name
    folder = fresh()
    problem = json.loads((folder / "problem.json").read_text())
    problem["stage_cost"] = "2*(x**2 + y**2 + u**2)"
    (folder / "problem.json").write_text(json.dumps(problem))
    status, out, _ = run(capsys, "verify", folder)
    assert status == 1
    assert "differs" in out


def test_unreadable_results(capsys, file, tmp_path):
    import io
    import zipfile

    def fresh():
        folder = tmp_path / "out"
        run(capsys, "solve", file(steps()), "--out", folder)
        return folder

    def header(descr, shape):
        buffer = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            buffer, {"descr": descr, "fortran_order": False, "shape": shape}
        )
        return buffer.getvalue()

    def archive_with(folder, name, content):
        path = folder / "solution.npz"
        with np.load(path) as stored:
            kept = dict(stored)
        kept.pop(name)
        np.savez(path, **kept)
        with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as out:
            out.writestr(f"{name}.npy", content)

    spoilers = {
        "truncated": lambda f: (f / "solution.npz").write_bytes(b"PK\x03\x04"),
        "empty": lambda f: (f / "solution.npz").write_bytes(b""),
        "missing": lambda f: (f / "solution.npz").unlink(),
        "terabytes": lambda f: archive_with(f, "value", header("<f8", (10**12,))),
        "bomb": lambda f: archive_with(f, "value", header("<f8", (4,)) + bytes(50_000_000)),
        "pickle": lambda f: archive_with(f, "value", header("|O", (4,)) + b"x" * 32),
        "short": lambda f: archive_with(f, "value", header("<f8", (4,)) + bytes(8)),
        "bad deflate": lambda f: (f / "solution.npz").write_bytes(
            (f / "solution.npz").read_bytes()[:200] + bytes(400)
        ),
        "header": lambda f: archive_with(
            f, "value", bytes([147]) + b"NUMPY" + bytes([1, 0, 16, 0]) + b"{'descr': (" + b"'" * 3
        ),
        "huge cost": lambda f: spoil_certificate(f, cost=10**310),
        "huge tolerance": lambda f: spoil_certificate(f, tolerance=10**310),
        "negative tolerance": lambda f: spoil_certificate(f, tolerance=-1.0),
        "huge bracket": lambda f: spoil_certificate(f, gamma_bar=[1.0, 10**310]),
        "control index": lambda f: spoil_array(f, "control_index", lambda a: a.fill(9)),
        "certificate gone": lambda f: (f / "certificate.json").unlink(),
        "certificate list": lambda f: (f / "certificate.json").write_text("[]"),
        "status": lambda f: spoil_certificate(f, status="fine"),
        "types": lambda f: spoil_certificate(f, gap="0"),
        "seconds": lambda f: spoil_certificate(f, seconds={"a": 1}),
        "cause": lambda f: spoil_certificate(f, cause="fate"),
        "claims": lambda f: spoil_certificate(f, claims={"stabilizing": 1}),
        "more seconds": lambda f: spoil_certificate(
            f, seconds={"compile": None, "solve": None, "verify": None, "save": None}
        ),
        "reasons": lambda f: spoil_certificate(f, reasons=[1]),
        "problem gone": lambda f: (f / "problem.json").unlink(),
    }
    import shutil

    for name, spoil in spoilers.items():
        folder = fresh()
        spoil(folder)
        for command in ("verify", "simulate"):
            status, _, err = run(capsys, command, folder)
            assert status == 2, name
            assert err.count("\n") == 1, name
        shutil.rmtree(folder)
