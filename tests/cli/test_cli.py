"""The command line: exit statuses, JSON, and directories that appear whole or not at all."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from problems import doubling, standard_map, steps

import lmdsl as lm
from lmdsl.cli import main

KEYS = [
    "status", "backend", "solver_status", "gamma", "cost", "lower_bound", "gap", "tolerance",
    "contraction", "gamma_bar", "cells", "controls", "pairs", "attractor_cells",
    "stabilizable_cells", "polish_steps", "seconds", "message",
    "local_controller", "beyond_gamma", "coverage", "simulation",
]  # fmt: skip


@pytest.fixture
def file(tmp_path):
    def write(data, name="problem.json"):
        path = tmp_path / name
        path.write_text(json.dumps(data))
        return str(path)

    return write


def run(capsys, *arguments):
    status = main(list(map(str, arguments)))
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return status, captured.out, captured.err


def run_json(capsys, *arguments):
    status, out, _ = run(capsys, *arguments, "--json")
    assert out.count("\n") == 1 or arguments[0] in ("systems", "backends")

    def refuse(word):
        raise AssertionError(f"{word} in JSON")

    return status, json.loads(out, parse_constant=refuse)


def test_solve_and_everything_after(capsys, file, tmp_path):
    out = tmp_path / "out"
    status, report = run_json(capsys, "solve", file(standard_map(20)), "--out", out)
    assert status == 0
    assert list(report) == KEYS
    assert report["status"] == "verified"
    assert set(report["seconds"]) == {"compile", "solve", "verify"}
    assert sorted(p.name for p in out.iterdir()) == [
        "certificate.json",
        "problem.json",
        "solution.npz",
    ]
    stored = json.loads((out / "certificate.json").read_text())
    assert report.pop("coverage") == {"stabilizable": 392, "free": 392, "share": 1}
    runs = report.pop("simulation")
    assert (runs["starts"], runs["reached"]) == (1000, 1000)
    assert {"coverage", "simulation"} & stored.keys() == set()
    assert {key: stored[key] for key in KEYS[:-2]} == report
    assert len(stored["model_sha256"]) == 64
    with np.load(out / "solution.npz", allow_pickle=False) as arrays:
        assert arrays["control_index"].dtype == np.int32
        assert arrays["cell_status"].dtype == np.uint8
        assert arrays["value"].shape == arrays["lower"].shape == arrays["measure"].shape == (400,)
    status, found = run_json(capsys, "verify", out)
    assert status == 0
    assert found["holds"]
    assert found["same_model"]
    status, exact = run_json(capsys, "verify", out, "--exact")
    assert status == 0
    assert exact["holds"]
    assert exact["gap"] <= found["gap"]
    status, runs = run_json(capsys, "simulate", out, "--starts", 200, "--steps", 500)
    assert status == 0
    assert runs["starts"] == 200 == runs["reached"] + runs["lost"] + runs["cycling"]
    assert set(runs["steps"]) == {"min", "q50", "q90", "q99", "max"}
    assert 0 <= runs["interval"][0] <= runs["reached"] / 200 <= runs["interval"][1] <= 1
    # The same once more, into the same directory.
    status, _, _ = run(capsys, "solve", file(standard_map(20)), "--out", out)
    assert status == 0


def test_text_output(capsys, file, tmp_path):
    status, out, err = run(capsys, "solve", file(standard_map(20)), "--out", tmp_path / "o")
    assert status == 0
    assert "verified" in out
    assert err == ""
    status, out, _ = run(capsys, "verify", tmp_path / "o")
    assert "every claim holds" in out
    status, out, _ = run(capsys, "simulate", tmp_path / "o", "--starts", 50)
    assert "reached the attractor" in out


def test_overrides_are_saved(capsys, file, tmp_path):
    run(capsys, "solve", file(steps()), "--gamma", "1.25", "--out", tmp_path / "o")
    assert json.loads((tmp_path / "o" / "problem.json").read_text())["gamma"] == 1.25
    loaded = lm.Result.load(tmp_path / "o")
    assert loaded.gamma == 1.25
    np.testing.assert_allclose(loaded.value[1:], [1, 2.25, 1 + 1.25 + 1.25**2])
    assert loaded.controller([[0.6]]) == 1


def test_exit_statuses(capsys, file, tmp_path):
    assert run_json(capsys, "solve", file(steps()))[0] == 0
    status, report = run_json(capsys, "solve", file(steps(0.5, cost="u")))
    assert (status, report["status"]) == (1, "unverified")
    status, report = run_json(capsys, "solve", file({**steps(), "gama": 1}))
    assert (status, report["status"]) == (2, "bad_input")
    assert list(report) == KEYS
    assert "gama" in report["message"]
    status, report = run_json(capsys, "solve", file(doubling(3.0)), "--out", tmp_path / "r")
    assert (status, report["status"]) == (3, "not_stabilizable")
    assert report["cost"] is report["gap"] is report["lower_bound"] is report["contraction"] is None
    assert run(capsys, "verify", tmp_path / "r")[0] == 0
    avoided = steps(avoid={"boxes": [{"x": [0.5, 0.75]}]})
    status, report = run_json(capsys, "solve", file(avoided))
    assert status == 0
    status, report = run_json(capsys, "solve", file(avoided), "--require-all")
    assert (status, report["status"]) == (3, "not_stabilizable")
    status, report = run_json(
        capsys, "solve", file(standard_map(20)), "--max-iterations", "1", "--out", tmp_path / "u"
    )
    assert (status, report["status"]) == (4, "solver_failed")
    assert run(capsys, "verify", tmp_path / "u")[0] == 1
    assert lm.Result.load(tmp_path / "u").simulate(starts=100).reached > 0


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


def spoil_array(folder, name, change):
    path = folder / "solution.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    change(arrays[name])
    np.savez(path, **arrays)


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


def test_function_results_keep_their_rows(tmp_path, capsys):
    from problems import made

    from lmdsl.systems import FunctionSystem

    own = made(steps()).replaced(system=FunctionSystem(next=lambda x, u: (x - 0.25 * u,)))
    lm.solve(own).save(tmp_path / "own")
    found = lm.verify(tmp_path / "own")
    assert found.holds
    assert "not re-evaluated" in found.notes[0]
    loaded = lm.Result.load(tmp_path / "own")
    assert loaded.controller([[0.3]]) == 1
    with pytest.raises(lm.BadInput, match="Python function"):
        loaded.simulate(starts=3)
    spoil_array(tmp_path / "own", "value", lambda a: a.__imul__(0.5))
    assert not lm.verify(tmp_path / "own").holds


def test_compare(capsys, file):
    status, found = run_json(
        capsys, "compare", file(standard_map(10)), "--backends", "policy-iteration,highs"
    )
    assert status == 0
    assert [list(r) for r in found["results"]] == [KEYS, KEYS]
    agreement = found["agreement"]
    assert agreement["cost"] < 1e-6
    assert agreement["controls"] == 1
    assert agreement["value"] < 1e-6
    status, found = run_json(capsys, "compare", file(doubling(3)), "--backends", "highs")
    assert status == 3
    assert found["agreement"] is None
    status, out, _ = run(capsys, "compare", file(standard_map(10)))
    assert status == 0
    for name in ("policy-iteration", "highs", "clarabel", "cvxpy", "agreement"):
        assert name in out


def test_listings_and_init(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_json(capsys, "systems")[1]["standard_map"]["parameters"] == {"K": 0.25}
    assert "standard_map" in run(capsys, "systems")[1]
    assert run_json(capsys, "backends")[1]["policy-iteration"]["available"]
    assert "highs" in run(capsys, "backends")[1]
    assert json.loads(run(capsys, "schema")[1])["title"] == "lmdsl problem file"
    assert run(capsys, "init", "standard_map")[0] == 0
    assert lm.load("standard_map.json").gamma == 1.02
    assert run(capsys, "init", "standard_map")[0] == 2  # not overwritten
    assert run(capsys, "init", "standard_map", "--out", "other.json")[0] == 0


def test_names_are_safe_for_terminals(capsys, file):
    data = steps(name="\x1b[31mred\x07\u202e \u00e9")
    status, out, _ = run(capsys, "solve", file(data))
    assert status == 0
    assert "\x1b" not in out
    assert "\x07" not in out
    assert "\u202e" not in out
    assert "\u00e9" in out


def test_as_a_process(tmp_path):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}

    def call(*arguments):
        return subprocess.run(
            [sys.executable, "-m", "lmdsl", *arguments],
            capture_output=True, text=True, env=environment, cwd=tmp_path, check=False,
        )  # fmt: skip

    (tmp_path / "p.json").write_text(json.dumps(steps(name="\u00e9")))
    done = call("solve", "p.json", "--out", "out")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert call("--version").stdout.startswith("lmdsl ")
    assert call("solve", "q.json").returncode == 2


def test_an_internal_error_is_one_message(capsys, file, monkeypatch):
    import lmdsl.results.solving

    def explode(*_, **__):
        raise RuntimeError("boom\x1b[31m")

    monkeypatch.setattr(lmdsl.results.solving, "solve", explode)
    status, _, err = run(capsys, "solve", file(steps()))
    assert status == 4
    assert "internal error" in err
    assert "\x1b" not in err


def test_interrupt_is_one_message(capsys, file, monkeypatch):
    import lmdsl.results.solving

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(lmdsl.results.solving, "solve", interrupt)
    status, _, err = run(capsys, "solve", file(steps()))
    assert status == 130
    assert err == "lmdsl: interrupted\n"
