"""Certificates as text files: checked by a script without lmdsl, written whole."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from certificate_files import SCRIPT, checked, exported, fails, noisy, parsed
from problems import doubling, made, standard_map, steps
from random_problems import random_problem

import lmdsl as lm
from lmdsl.certificate.claims import Witness
from lmdsl.certificate.judge import exact_verdict, verdict
from lmdsl.cli import main
from lmdsl.results.exports import export_certificate

# Certificates ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "problem",
    [
        steps(),
        steps(0.5),
        steps(1.7, cost="x"),
        steps(cost="0"),
        steps(measure={"boxes": [{"x": [0.5, 0.75]}]}),
        doubling(1.9),
        noisy(),
        noisy(gamma=1.01),
    ],
)
def test_good_certificates_pass(problem, tmp_path):
    result = lm.solve(made(problem))
    assert result.status == "verified", result.message
    status, said = checked(exported(result, tmp_path))
    assert status == 0, said
    assert said.count("holds") == 5
    assert "FAILS" not in said


def test_a_large_measure_counts_relative_to_its_size(tmp_path):
    # Just below gamma_bar = 10/3 mu sums to 6e7; doubles cannot hold its residual below 1e-9.
    result = lm.solve(made(standard_map(20, gamma=10 / 3 * (1 - 1e-5))))
    assert result.status == "verified", result.message
    size = result.measure.sum()
    assert size > 1e7
    assert result.certificate.measure_residual > 1e-9
    result.save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds
    assert lm.verify(tmp_path / "out", exact=True).holds
    assert checked(exported(result, tmp_path))[0] == 0
    for off, holds in ((2e-10, True), (2e-9, False)):
        measure = result.measure.copy()
        measure[np.flatnonzero(result.cell_status == 1)[-1]] += off * size
        spoiled = replace(result, measure=measure)
        on = result.lp.cells
        pair = np.array([result.lp.column(c, result.control_index[c]) for c in on])
        witness = Witness(pair, mu=measure[on])
        for judge in (verdict, exact_verdict):
            assert judge(result.lp, witness, 1e-6).measure == holds
        said = checked(exported(spoiled, tmp_path))[1]
        assert ("claim 4 measure: holds" in said) == holds, said


@pytest.mark.long
def test_verdicts_agree_on_random_problems(tmp_path):
    rng = np.random.default_rng(5)
    verified = 0
    for _ in range(25):
        result = lm.solve(lm.Problem.model_validate(random_problem(rng)))
        if result.status == "not_stabilizable" and result.cause != "gamma":
            continue
        status, said = checked(exported(result, tmp_path))
        assert (status == 0) == (result.status in ("verified", "not_stabilizable")), said
        verified += result.status == "verified"
    assert verified > 5


def test_the_numbers_are_those_of_the_result(tmp_path):
    result = lm.solve(made(noisy()))
    head, *rest = map(json.loads, exported(result, tmp_path).read_text().splitlines())
    assert head["format"] == "lmdsl-certificate/1"
    assert head["model_sha256"] == result.lp.digest
    assert (head["cells"], head["pairs"]) == (result.lp.n, result.lp.K)
    on = result.lp.cells
    for i, line in enumerate(rest[: head["cells"]]):
        assert line["cell"] == on[i]
        assert line["policy"] == result.control_index[on[i]]
        for key, array in (("V_up", result.value), ("W", result.lower), ("w", result.witness),
                           ("mu", result.measure), ("m", result.weight)):  # fmt: skip
            assert float.fromhex(line[key]) == array[on[i]]
    # Weights 0.1, 0.2, 0.7 are read as the doubles they are; every row sums to exactly 1.
    weights = [Fraction(w) for w in (0.1, 0.2, 0.7)]
    allowed = {
        Fraction(sum(a * w for a, w in zip(hits, weights, strict=True)), 2 * sum(weights))
        for hits in np.ndindex(3, 3, 3)
    }
    for _, _, _, row in rest[head["cells"] :]:
        assert sum(c for _, c in row) == head["total"]
        assert all(Fraction(c, head["total"]) in allowed for _, c in row)


@pytest.mark.parametrize("gamma", [2.0, 3.0])
def test_refusals(gamma, tmp_path):
    result = lm.solve(made(doubling(gamma)))
    assert result.cause == "gamma"
    path = exported(result, tmp_path)
    status, said = checked(path)
    assert status == 0
    assert said.startswith("claim 6 refusal: holds")
    head, *lines = map(json.loads, path.read_text().splitlines())
    assert "V_up" not in lines[0]

    def spoiled(change):
        copy = json.loads(json.dumps([head, *lines]))
        change(*copy)
        path.write_text("\n".join(map(json.dumps, copy)) + "\n")
        return checked(path)

    for w in ("0x0p+0", "-0x1p+0", "nan", "inf"):
        status, said = spoiled(lambda head, cell, pair, w=w: cell.update(w=w))
        assert status == 1
        assert fails(said, 6)
    status, said = spoiled(lambda head, cell, pair: head.update(gamma=(1.9).hex()))
    assert status == 1
    assert fails(said, 6)
    assert spoiled(lambda head, cell, pair: pair[3][0].__setitem__(1, 1))[0] == 2

    def absorbed(head, cell, pair):
        pair[3] = [[head["cells"], head["total"]]]

    assert spoiled(absorbed)[0] == 1
    path.write_text("\n".join(map(json.dumps, [{**head, "pairs": 0}, lines[0]])))
    assert checked(path)[0] == 2


def test_what_no_vector_proves_is_not_exported(tmp_path):
    nowhere = steps(system={"kind": "map", "next": {"x": "x + 0*u"}})
    refused = lm.solve(made(nowhere))
    assert refused.cause == "empty"
    with pytest.raises(lm.BadInput, match="graph of the model"):
        export_certificate(refused, tmp_path / "file")
    good = lm.solve(made(steps()))
    other = lm.compile(made(doubling()))
    with pytest.raises(lm.BadInput, match="different cells"):
        export_certificate(good, tmp_path / "file", other)
    nobody = replace(good, control_index=np.full_like(good.control_index, -1))
    with pytest.raises(lm.BadInput, match="no controller"):
        export_certificate(nobody, tmp_path / "file")
    with pytest.raises(lm.BadInput, match="cannot write"):
        export_certificate(good, tmp_path / "missing" / "file")
    assert not list(tmp_path.iterdir())


def test_an_answer_that_is_not_verified_is_refused(tmp_path):
    """At gamma < 1 staying away for ever is cheaper than a detour: claim 1 cannot hold."""
    lazy = steps(0.5, cost="where(u > 0, 9, 1)")
    result = lm.solve(made(lazy))
    assert result.status == "unverified"
    status, said = checked(exported(result, tmp_path))
    assert status == 1
    assert fails(said, 1)


def test_a_result_restricted_to_gamma(tmp_path):
    """Above y = 0.5 the map doubles, below it goes to A at once: gamma = 3 is feasible there."""
    box = {"x": {"low": 0, "high": 1, "cells": 2, "periodic": True},
           "y": {"low": 0, "high": 1, "cells": 2}}  # fmt: skip
    next_ = {"x": "where(y > 0.5, 2*x, 0.25)", "y": "y"}
    data = doubling(3.0, state_box=box, system={"kind": "map", "next": next_},
                    attractor={"cells": [[0, 0], [0, 1]]})  # fmt: skip
    result = lm.solve(made(data), restrict_to_gamma=True)
    assert result.status == "verified"
    result.save(tmp_path / "out")
    for answer in (result, lm.Result.load(tmp_path / "out")):
        assert checked(exported(answer, tmp_path))[0] == 0


@pytest.mark.long
def test_the_largest_example_of_the_paper_takes_seconds(tmp_path):
    path = exported(lm.solve(made(standard_map(50))), tmp_path)
    done = subprocess.run(
        [sys.executable, "-I", "-S", SCRIPT, path], capture_output=True, timeout=600, check=False
    )
    assert done.returncode == 0


# The command line -----------------------------------------------------------------------------


def test_export_from_the_command_line(tmp_path, capsys):
    out = tmp_path / "out"
    lm.solve(made(noisy())).save(out)
    for kind in ("certificate", "drn"):
        assert main(["export", str(out), "--format", kind, "--out", str(tmp_path / kind)]) == 0
        assert capsys.readouterr().out == f"written to {tmp_path / kind}\n"
    assert checked(tmp_path / "certificate")[0] == 0
    assert len(parsed(tmp_path / "drn")[1]) == lm.Result.load(out).stabilizable_cells + 1
    lm.solve(made(noisy(gamma=1.01))).save(out)
    assert main(["export", str(out), "--format", "drn", "--out", str(tmp_path / "x")]) == 2
    assert "gamma" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
    assert main(["export", str(out), "--format", "xml", "--out", str(tmp_path / "x")]) == 2
    assert main(["export", str(out), "--format", "drn"]) == 2
    assert main(["export", str(tmp_path), "--format", "drn", "--out", "x"]) == 2


def test_a_python_function_is_exported_from_its_saved_rows(tmp_path, capsys):
    system = lm.systems.FunctionSystem(next=lambda x, u: {"x": x - 0.25 * u}, parameters={})
    result = lm.solve(made(steps(system=system)))
    result.save(tmp_path / "out")
    path = tmp_path / "file"
    assert (
        main(["export", str(tmp_path / "out"), "--format", "certificate", "--out", str(path)]) == 0
    )
    assert checked(path)[0] == 0
    export_certificate(result, tmp_path / "same")
    assert path.read_text() == (tmp_path / "same").read_text()
    capsys.readouterr()


@pytest.mark.parametrize("name", ["certificate.json", "solution.npz", "problem.json", "link"])
@pytest.mark.parametrize("form", ["certificate", "drn"])
def test_an_export_does_not_replace_the_result(tmp_path, capsys, name, form):
    out = tmp_path / "out"
    lm.solve(made(steps())).save(out)
    (tmp_path / "link").symlink_to(out / "solution.npz")
    target = tmp_path / name if name == "link" else out / name
    arguments = ["export", str(out), "--format", form, "--out"]
    assert main([*arguments, str(target)]) == 2
    assert "is a part of the result; choose another name" in capsys.readouterr().err
    assert lm.verify(out).holds
    (tmp_path / "solution.npz").write_text("of somebody else")
    assert main([*arguments, str(tmp_path / "solution.npz")]) == 0
    assert main([*arguments, str(out / "model.txt")]) == 0
