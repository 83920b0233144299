"""Exports: a certificate that a script without lmdsl can judge, and the model in Storm's format."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from models import random_lp
from problems import doubling, made, standard_map, steps
from random_problems import random_problem

import lmdsl as lm
from lmdsl.certificate.checks import check
from lmdsl.certificate.claims import Witness
from lmdsl.certificate.exact_checks import check_exactly
from lmdsl.cli import main
from lmdsl.results.exports import export_certificate, export_drn

SCRIPT = Path(__file__).parents[2] / "tools/check_certificate.py"
NOISE = {"w": {"values": [0.1, -0.2, 0.02], "weights": [0.1, 0.2, 0.7]}}


def checked(path):
    """Run the stand-alone script with nothing of the environment; return status and output."""
    done = subprocess.run(
        [sys.executable, "-I", "-S", SCRIPT, path], capture_output=True, text=True, check=False
    )
    assert not done.stderr, done.stderr
    return done.returncode, done.stdout


def exported(result, folder):
    path = folder / "certificate.jsonl"
    export_certificate(result, path)
    return path


def noisy(**more):
    """A map with noise whose weights do not sum to 1 as doubles."""
    system = {"kind": "map", "next": {"x": "0.9*x - 0.25*u + w"}}
    box = {"x": {"low": -2, "high": 2, "cells": 40}}
    data = steps(cost="1 + x**2", system=system, state_box=box, noise=NOISE)
    return {**data, "attractor": {"cells": [[19], [20]]}, "on_exit": "clip", **more}


# Certificates -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """An exported certificate of the standard map on 20 x 20 cells, as parsed lines."""
    path = exported(lm.solve(made(standard_map(20))), tmp_path_factory.mktemp("export"))
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture
def spoil(original, tmp_path):
    """Change a deep copy of the lines, write it, and return what the script says of it."""

    def spoiled(change=lambda head, cells, pairs: None):
        head, *rest = json.loads(json.dumps(original))
        cells, pairs = rest[: head["cells"]], rest[head["cells"] :]
        change(head, cells, pairs)
        path = tmp_path / "spoiled.jsonl"
        path.write_text("\n".join(map(json.dumps, [head, *cells, *pairs])) + "\n")
        return checked(path)

    return spoiled


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
        for judge in (check, check_exactly):
            assert judge(result.lp, witness, 1e-6).measure == holds
        said = checked(exported(spoiled, tmp_path))[1]
        assert ("claim 4 measure: holds" in said) == holds, said


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


def test_the_unspoiled_certificate_passes(spoil):
    assert spoil()[0] == 0


def scale(entry, key, factor):
    entry[key] = (float.fromhex(entry[key]) * factor).hex()


def fails(said, claim):
    (line,) = [line for line in said.splitlines() if line.startswith(f"claim {claim} ")]
    return "FAILS" in line


@pytest.mark.parametrize(
    ("name", "factor", "claim"),
    [
        ("V_up", 1 - 1e-9, 2),
        ("V_up", -1, 2),
        ("W", 1 + 1e-9, 3),
        ("W", -1, 3),
        ("w", 1e-3, 1),
        ("w", -1, 1),
        ("w", 0, 1),
        ("mu", 1 + 1e-4, 4),
        ("mu", -1, 4),
    ],
)
@pytest.mark.parametrize("i", [0, 17, 391])
def test_spoiled_vectors_are_refused(spoil, name, factor, claim, i):
    status, said = spoil(lambda head, cells, pairs: scale(cells[i], name, factor))
    assert status == 1
    assert fails(said, claim)


@pytest.mark.parametrize("factor", [1 + 1e-5, 1 - 1e-3, -1])
def test_a_weight_that_does_not_sum_to_1_is_refused(spoil, factor):
    assert spoil(lambda head, cells, pairs: scale(cells[17], "m", factor))[0] == 2


def test_a_shifted_weight_is_refused(spoil):
    def shift(head, cells, pairs):
        for i, sign in ((17, 1), (18, -1)):
            cells[i]["m"] = (float.fromhex(cells[i]["m"]) + sign * 1e-6).hex()

    status, said = spoil(shift)
    assert status == 1
    assert fails(said, 4)


@pytest.mark.parametrize("name", ["V_up", "W", "w", "mu", "m"])
@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_numbers_that_are_none_are_refused(spoil, name, value):
    assert spoil(lambda head, cells, pairs: cells[3].update({name: value}))[0] in (1, 2)


def test_too_low_a_bound_is_a_gap(spoil):
    def change(head, cells, pairs):
        for i in range(len(cells)):
            scale(cells[i], "W", 0.9)
        head["lower_bound"] = (0.0).hex()

    status, said = spoil(change)
    assert status == 1
    assert "claim 3 lower bound: holds" in said
    assert fails(said, 5)


def test_a_spoiled_policy_is_refused(spoil, original):
    n = original[0]["cells"]
    rng = np.random.default_rng(0)
    for i in rng.integers(0, n, 5):
        others = [
            a for j, a, _, _ in original[1 + n :] if j == i and a != original[1 + i]["policy"]
        ]
        wrong = int(rng.choice(others))
        status, said = spoil(lambda head, cells, pairs, i=i, a=wrong: cells[i].update(policy=a))
        assert status == 1
        assert fails(said, 4)
    assert spoil(lambda head, cells, pairs: cells[5].update(policy=10**6))[0] == 2


def of_the_policy(cells, pairs, i):
    return next(pair for pair in pairs if pair[:2] == [i, cells[i]["policy"]])


@pytest.mark.parametrize("i", [0, 17, 391])
@pytest.mark.parametrize(("factor", "claim"), [(1 + 1e-6, 2), (1 - 1e-6, 3)])
def test_a_spoiled_cost_is_refused(spoil, i, factor, claim):
    def change(head, cells, pairs):
        pair = of_the_policy(cells, pairs, i)
        pair[2] = (float.fromhex(pair[2]) * factor).hex()

    status, said = spoil(change)
    assert status == 1
    assert fails(said, claim)
    for cost in ("-0x1p-3", "nan", "inf", "none"):
        assert spoil(lambda h, cells, pairs, c=cost: pairs[7].__setitem__(2, c))[0] == 2


@pytest.mark.parametrize("i", [0, 17, 391])
def test_a_spoiled_row_is_refused(spoil, i):
    def numerator(head, cells, pairs):
        of_the_policy(cells, pairs, i)[3][0][1] += 1

    def target(head, cells, pairs):
        row = of_the_policy(cells, pairs, i)[3]
        row[0][0] = (row[0][0] + 1) % head["cells"]

    def outside(head, cells, pairs):
        of_the_policy(cells, pairs, i)[3][0][0] = head["cells"] + 1

    assert spoil(numerator)[0] == 2
    status, said = spoil(target)
    assert status == 1
    assert fails(said, 4)
    assert spoil(outside)[0] == 2


@pytest.mark.parametrize(("factor", "claim"), [(1 + 1e-6, 2), (1 - 1e-6, 3)])
def test_a_spoiled_gamma_is_refused(spoil, factor, claim):
    status, said = spoil(lambda head, cells, pairs: scale(head, "gamma", factor))
    assert status == 1
    assert fails(said, claim)
    assert fails(said, 4)
    for gamma in ("nan", "inf", "0x0p+0", "-0x1p+0"):
        assert spoil(lambda head, cells, pairs, g=gamma: head.update(gamma=g))[0] == 2


@pytest.mark.parametrize(
    ("name", "factor", "claim"),
    [
        ("cost", 1 - 1e-12, 2),
        ("lower_bound", 1 + 1e-12, 3),
        ("contraction", 0.99, 1),
        ("tolerance", 1e-9, 5),
    ],
)
def test_a_spoiled_statement_is_refused(spoil, name, factor, claim):
    status, said = spoil(lambda head, cells, pairs: scale(head, name, factor))
    assert status == 1
    assert fails(said, claim)


@pytest.mark.long
def test_what_is_missing_is_noticed(spoil):
    def pair(head, cells, pairs):
        del pairs[3]

    def pair_and_count(head, cells, pairs):
        (k,) = [k for k, p in enumerate(pairs) if p[:2] == [4, cells[4]["policy"]]]
        del pairs[k]
        head["pairs"] -= 1

    def all_pairs_of_a_cell(head, cells, pairs):
        pairs[:] = [p for p in pairs if p[0] != 9]
        head["pairs"] = len(pairs)

    def twice(head, cells, pairs):
        pairs.insert(3, pairs[3])
        head["pairs"] += 1

    for change in (pair, pair_and_count, all_pairs_of_a_cell, twice):
        assert spoil(change)[0] == 2
    for key in ("format", "kind", "gamma", "total", "cells", "pairs", "cost", "tolerance"):
        assert spoil(lambda head, cells, pairs, key=key: head.pop(key))[0] == 2
    for key in ("m", "policy", "V_up", "W", "w", "mu"):
        assert spoil(lambda head, cells, pairs, key=key: cells[8].pop(key))[0] == 2


@pytest.mark.parametrize("content", ["", "{}", "[]", "nonsense", "\xff", '{"format": 1}\n' * 3])
def test_other_files_are_no_certificates(content, tmp_path):
    path = tmp_path / "file"
    path.write_text(content, encoding="latin-1")
    status, said = checked(path)
    assert status == 2
    assert said.startswith("not a certificate")
    assert checked(tmp_path / "missing")[0] == 2


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


# Storm --------------------------------------------------------------------------------------


def parsed(path):
    """A small reader of DRN files: labels, and per state a list of (name, cost, row)."""
    head, body = path.read_text().split("@model\n")
    keys = [line for line in head.splitlines() if not line.startswith("//")]
    assert keys[0] == "@type: MDP"
    assert keys[1:3] == ["@parameters", ""]
    assert keys[3:5] == ["@reward_models", "cost"]
    states, labels = [], []
    for line in body.splitlines():
        words = line.split()
        if words[0] == "state":
            assert int(words[1]) == len(states)
            assert words[2] == "[0]"
            labels.append(words[3:])
            states.append([])
        elif words[0] == "action":
            assert words[2][0] + words[2][-1] == "[]"
            states[-1].append((words[1], Fraction(words[2][1:-1]), {}))
        else:
            target, colon, probability = words
            assert colon == ":"
            row = states[-1][-1][2]
            assert int(target) > max(row, default=-1), "targets ascend, each once"
            row[int(target)] = Fraction(probability)
    assert keys[5:7] == ["@nr_states", str(len(states))]
    assert keys[7:9] == ["@nr_choices", str(sum(map(len, states)))]
    return labels, states


def value_iteration(states, sweeps):
    """Least expected total cost until the last state, from below, in plain floats."""
    rows = [[(float(c), [(j, float(p)) for j, p in row.items()]) for _, c, row in actions]
            for actions in states[:-1]]  # fmt: skip
    V = [0.0] * len(states)
    for _ in range(sweeps):
        for i, actions in enumerate(rows):
            V[i] = min(c + sum(p * V[j] for j, p in row) for c, row in actions)
    return V


AT_ONE = {
    "steps": steps(),
    "steps, uneven": steps(cost="0.1 + x"),
    "doubling": doubling(),
    "standard map": standard_map(12, 1.0),
    "noise": noisy(),
    "part of m": noisy(measure={"boxes": [{"x": [0.5, 1.0]}]}),
}


@pytest.fixture(params=AT_ONE)
def at_one(request, tmp_path):
    result = lm.solve(made(AT_ONE[request.param]))
    assert result.status == "verified"
    export_drn(result.lp, tmp_path / "model.drn")
    return result, tmp_path / "model.drn"


def test_the_model_for_storm_is_the_model(at_one):
    result, path = at_one
    lp = result.lp
    labels, states = parsed(path)
    assert len(states) == lp.n + 1
    assert labels[-1] == ["attractor"]
    assert [names == ["init"] for names in labels[:-1]] == [m > 0 for m in lp.weight]
    assert states[-1] == [("stay", 0, {lp.n: 1})]
    found = [(int(name), cost) for actions in states[:-1] for name, cost, _ in actions]
    assert found == [(int(a), Fraction(float(c))) for a, c in zip(lp.control, lp.cost, strict=True)]
    for actions in states:
        assert all(sum(row.values()) == 1 for _, _, row in actions)
        assert all(p > 0 for _, _, row in actions for p in row.values())
    V = value_iteration(states, 1000)
    np.testing.assert_allclose(V[:-1], result.value[lp.cells], rtol=1e-9)


def test_what_storm_cannot_hold_is_refused(tmp_path):
    with pytest.raises(lm.BadInput, match=r"gamma: 1.02 .* gamma = 1") as caught:
        export_drn(lm.compile(made(steps(1.02))), tmp_path / "file")
    assert caught.value.where == "gamma"
    nowhere = steps(system={"kind": "map", "next": {"x": "x + 0*u"}})
    with pytest.raises(lm.BadInput, match="empty"):
        export_drn(lm.compile(made(nowhere)), tmp_path / "file")
    lp = lm.compile(made(steps()))
    with pytest.raises(lm.BadInput, match="initial"):
        export_drn(replace(lp, weight=np.zeros(lp.n)), tmp_path / "file")
    assert not list(tmp_path.iterdir())


PRECISION = 1e-6
"""Storm's stated default, relative to the value; a bound of the error with sound methods only."""


def storm_values(path, exact=False):
    """The least expected cost of every state by Storm, whose interface changed with version 2."""
    stormpy = pytest.importorskip("stormpy", reason="Storm is not installed")
    property_ = stormpy.parse_properties('R{"cost"}min=? [F "attractor"]')[0]
    if exact:
        if not hasattr(stormpy, "Rational") or not hasattr(stormpy, "environments"):
            pytest.skip("this version of stormpy reads DRN files as doubles only")
        model = stormpy.build_model_from_drn[stormpy.Rational](str(path))
    else:
        model = stormpy.build_model_from_drn(str(path))
    if hasattr(stormpy, "environments"):  # sound, or exact for an exact model, by default
        found = stormpy.model_checking(model, property_)
    else:
        environment = stormpy.Environment()
        environment.solver_environment.set_force_sound(True)
        found = stormpy.model_checking(model, property_, environment=environment)
    values = found.get_value_vector() if hasattr(found, "get_value_vector") else found.get_values()
    return model, [Fraction(str(v)) if exact else float(v) for v in values]


def test_storm_agrees(at_one):
    result, path = at_one
    lp = result.lp
    model, values = storm_values(path)
    assert (model.nr_states, model.nr_choices) == (lp.n + 1, lp.K + 1)
    assert list(model.initial_states) == list(np.flatnonzero(lp.weight))
    assert values[-1] == 0
    np.testing.assert_allclose(values[:-1], result.value[lp.cells], rtol=PRECISION)


def test_storm_in_rational_arithmetic_lies_between_the_bounds(at_one):
    """Nothing is rounded anywhere: Storm's exact V obeys W <= V <= V_up in every cell."""
    result, path = at_one
    _, values = storm_values(path, exact=True)
    on = result.lp.cells
    for V, lower, upper in zip(values[:-1], result.lower[on], result.value[on], strict=True):
        assert Fraction(float(lower)) <= V <= Fraction(float(upper))


@pytest.mark.parametrize("zero", [0.0, 0.4])
def test_storm_agrees_on_random_models(zero, tmp_path):
    """With zeros in the cost a free stay must not look better than going."""
    rng = np.random.default_rng(8)
    for _ in range(20):
        result = lm.solve(random_lp(rng, cells=12, zero=zero))
        assert result.status == "verified"
        if not result.lp.cost.any():
            continue
        export_drn(result.lp, tmp_path / "model.drn")
        _, values = storm_values(tmp_path / "model.drn")
        np.testing.assert_allclose(
            values[:-1], result.value[result.lp.cells], rtol=PRECISION, atol=1e-9
        )


# The command line ---------------------------------------------------------------------------


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
