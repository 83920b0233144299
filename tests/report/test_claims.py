"""What a page says is certified: never more than the certificate does."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.report import claims
from lmdsl.report.claims import claims_of, percent

# A word of the claim that stands for each field of a certificate.
ABOUT = {
    "stabilizing": "with probability 1", "upper_bound": "costs at most",
    "lower_bound": "costs less than", "measure": "Lyapunov measure",
}  # fmt: skip


def row(result, word, proof=None):
    (found,) = [row for row in claims_of(result, proof) if word in row["claim"]]
    return found


@pytest.fixture(scope="module")
def result():
    return lm.solve(made(steps()))


@pytest.mark.parametrize("name", ABOUT)
def test_what_does_not_hold_is_not_said_to_be_proved(result, name):
    assert row(result, ABOUT[name])["worth"] == claims.PROVED
    spoilt = replace(result, certificate=replace(result.certificate, **{name: False}))
    assert row(spoilt, ABOUT[name])["worth"] == claims.OPEN


def test_every_claim_of_the_certificate_has_a_row(result):
    known = {f.name for f in fields(lm.Certificate) if f.name in result.certificate.claims}
    assert known == {*ABOUT, "refusal", "safe"}


def test_a_gap_above_the_tolerance_is_no_optimum(result):
    wide = replace(result.certificate, gap=0.1)
    assert row(result, "relative gap")["worth"] == claims.PROVED
    assert row(replace(result, certificate=wide), "relative gap")["worth"] == claims.OPEN
    none = replace(result.certificate, gap=None)
    assert row(replace(result, certificate=none), "relative gap")["worth"] == claims.OPEN


@pytest.mark.parametrize(("safe", "worth"), [(True, "proved"), (False, "not proved"),
                                             ("assumed", "assumed")])  # fmt: skip
def test_claim_7(result, safe, worth):
    said = replace(result, certificate=replace(result.certificate, safe=safe))
    assert row(said, "is ever lost")["worth"] == worth


def test_sampled_successors_are_said_to_leave_runs_open(result):
    assert row(result, "between the sample points")["worth"] == claims.OPEN


def test_a_refusal_is_what_is_proved():
    refused = lm.solve(made(standard_map(20, gamma=50.0)))
    assert row(refused, "no law has a finite cost")["worth"] == claims.PROVED
    assert not [r for r in claims_of(refused, None) if "costs at most" in r["claim"]]


def test_proofs_of_the_true_map(result):
    proof = result.prove()
    assert percent(proof.arrives, 6) in row(result, "arrives in A", proof)["figure"]
    assert row(result, "arrives in A", proof)["worth"] == claims.PROVED
    assert row(result, "Share that is undecided", proof)["worth"] == claims.OPEN
    assert row(result, "arrives for certain")["worth"] == claims.UNKNOWN


@pytest.mark.parametrize(("lost", "left", "worth", "figure"), [
    (0.0, 0.8, "not proved", "at least 0 %; 80 % is undecided"),
    (0.1, 0.8, "proved", "at least 10 %; 80 % is undecided"),
    (0.0, 0.0, "proved", "0 %"),
])  # fmt: skip
def test_what_is_undecided_may_be_lost(result, lost, left, worth, figure):
    """That no loss is proved while most is undecided is no proof that nothing is lost."""
    proof = replace(result.prove(), lost=lost, undecided=left, arrives=1 - lost - left, stays=lost)
    for word in ("that is lost", "stays elsewhere"):
        assert row(result, word, proof)["worth"] == worth
        assert row(result, word, proof)["figure"] == figure


def test_runs_are_evidence_and_no_proof(result):
    runs = replace(result, simulation=result.simulate(starts=20))
    assert row(runs, "random starts reach A")["worth"] == claims.EVIDENCE


def test_without_a_target_no_arrival_is_claimed():
    result = lm.solve(made(doubling(discount=0.5, attractor={})))
    assert "ends with probability 1" in row(result, "with probability 1")["claim"]


def test_shares_are_not_rounded_to_all_or_nothing():
    assert percent(1.0) == "100 %"
    assert percent(0.0) == "0 %"
    assert percent(1 - 1e-12, 6) == "99.9999 %"
    assert percent(1e-12) == "0.0001 %"
