"""A certificate file is refused for every spoiled field, by the script that needs no lmdsl."""

from __future__ import annotations

import json

import numpy as np
import pytest
from certificate_files import checked, exported, fails
from problems import made, standard_map

import lmdsl as lm


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """An exported certificate of the standard map on 12 x 12 cells, as parsed lines."""
    path = exported(lm.solve(made(standard_map(12))), tmp_path_factory.mktemp("export"))
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


def test_the_unspoiled_certificate_passes(spoil):
    assert spoil()[0] == 0


def scale(entry, key, factor):
    entry[key] = (float.fromhex(entry[key]) * factor).hex()


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
@pytest.mark.parametrize("i", [0, 17, 131])
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
        assert fails(said, 2) or fails(said, 4)
    assert spoil(lambda head, cells, pairs: cells[5].update(policy=10**6))[0] == 2


def of_the_policy(cells, pairs, i):
    return next(pair for pair in pairs if pair[:2] == [i, cells[i]["policy"]])


@pytest.mark.parametrize("i", [0, 17, 131])
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


@pytest.mark.parametrize("i", [0, 17, 131])
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
