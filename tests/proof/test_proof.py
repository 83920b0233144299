"""Proofs of small loops whose answer is known by hand, and runs against what is proved."""

from __future__ import annotations

import json

import numpy as np
import pytest
from problems import doubling, made, steps
from proved_points import box_at, exceptions

import lmdsl as lm
from lmdsl.results.directory.proved import add


def line(formula, cells=4, **more):
    """x+ = formula on [0, 1], A = the first cell, no control, cost 1."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": formula}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": cells}},
        "attractor": {"cells": [[0]]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
        **more,
    }


def proved(data, target=1.0, **options):
    result = lm.solve(made(data))
    assert result.certificate.stabilizing
    return result, result.prove(target, **options)


def test_cells_that_move_as_a_whole_need_no_bisection():
    """The edges of the cells lie in margins: what touches them is bisected, little is left."""
    _, proof = proved(steps(cost="u"), target=0.999)
    assert proof.arrives >= 0.999
    assert (proof.lost, proof.stays) == (0, 0)
    assert proof.reached


def test_steps_and_costs_are_exact_where_cells_are_not_torn():
    """x+ = x/4 in 8 cells: of cost 1 + x the bounds close in on 1 + mean(x) and more."""
    result, proof = proved(line("0.1 + 0.125*(x - 0.1)", cells=8, attractor={"cells": [[0]]}))
    assert proof.arrives == 1
    assert proof.undecided == 0
    x = np.linspace(0.126, 0.999, 999)
    for point in x[:, None]:
        b = box_at(proof, result.partition, point)
        taken = len(result.closed_loop.path(point, 100)) - 1
        assert proof.cost_below[b] - 1e-9 <= taken <= proof.cost_above[b] + 1e-9
        assert taken <= proof.level[b]
    assert proof.cost[0] <= np.mean(proof.level) or proof.steps == 1


@pytest.mark.parametrize(
    ("formula", "lost", "stays"),
    [
        ("where(x > 0.9, 2, x - 0.25)", 0.1 / 0.75, 0),
        ("where(abs(x - 0.95) < 0.03, 0.5*x + 0.475, x - 0.25)", 0, 0.06 / 0.75),
        ("where(abs(x - 0.95) < 0.03, 0.93 + mod(x*7, 0.04), x - 0.25)", 0, 0.06 / 0.75),
        ("where(x > 0.95, 2, where(x > 0.90, x + 0.05, x - 0.25))", 0.1 / 0.75, 0),
    ],
)
def test_what_samples_do_not_see_is_found(formula, lost, stays):
    """One sample a cell sees none of it: the finite model brings every cell to A."""
    result, proof = proved(line(formula), target=1 - lost - stays - 1e-4)
    assert result.stabilizable_cells == 3
    assert proof.lost == pytest.approx(lost, abs=1e-3)
    assert proof.lost <= lost
    assert proof.stays == pytest.approx(stays, abs=1e-3)
    assert proof.arrives == pytest.approx(1 - lost - stays, abs=1e-3)
    assert exceptions(result, proof, 4000) == {"arrives": 0, "lost": 0, "stays": 0}
    assert not any(np.isnan(proof.cost))
    for kind, outcome in (("lost", 1), ("stays", 2)):
        if proof.witnesses[kind] is not None:
            x = np.array(proof.witnesses[kind])
            run = result.closed_loop.run(x[None], 50, np.random.default_rng(0))
            assert run.outcome[0] == outcome
    assert (proof.witnesses["lost"] is None) == (lost == 0)


def test_a_state_at_the_end_of_a_circle_belongs_to_its_first_cell():
    """An image of -1e-20 becomes the state 1.0 itself, where this map does something else."""
    data = doubling()
    data["state_box"]["x"]["cells"] = 4
    data["attractor"] = {"cells": [[2]]}
    data["system"]["next"] = {"x": "where(x >= 1, x, 0.6)"}
    result, proof = proved(data, target=0.9)
    seam = box_at(proof, result.partition, np.array([1.0]))
    assert proof.place[seam] == 0
    assert proof.kind[seam] == 0
    free = {**data, "system": {"kind": "map", "next": {"x": "where(x > 1, x, 0.6)"}}}
    _, proof = proved(free, target=0.9)
    assert proof.arrives < 1  # the margin reaches beyond 1; no state does
    _, proof = proved({**data, "system": {"kind": "map", "next": {"x": "0.6 + 0*x"}}})
    assert proof.arrives == 1


def test_a_state_just_below_an_edge_belongs_to_the_cell_above():
    """floor(t + 1e-9): a box at the lower face of a cell holds what lies a little lower."""
    tail = "where(x < 0.5 and x > 0.5 - 2e-10, 2, 0.1)"
    result, proof = proved(line(tail), target=0.99)
    x = np.array([0.5 - 1e-10])
    box = box_at(proof, result.partition, x)
    assert proof.cell[box] == 2
    assert proof.kind[box] == 0
    whole = proof.kind[(proof.cell == 1)]
    assert (whole != 0).any()


def test_what_rounding_does_is_not_overlooked():
    """The sum with 2^52 rounds x to 0 or 1: f(0.6) = 0.3, though F(0.6) = 0.22 is in A."""
    data = line("0.1 + 0.2*((x + 4503599627370496) - 4503599627370496)", cells=4)
    data["system"]["next"]["x"] = f"where(x < 0.5, 0, {data['system']['next']['x']})"
    result, proof = proved(data, target=0.99)
    for x in (0.51, 0.6, 0.7, 0.74):
        b = box_at(proof, result.partition, np.array([x]))
        assert proof.kind[b] == 0 or proof.level[b] == 2
    assert exceptions(result, proof, 2000) == {"arrives": 0, "lost": 0, "stays": 0}


def test_paths_of_many_substeps_are_enclosed_a_few_boxes_at_a_time():
    """x' = -x, 1,000 substeps: what x' = -x does in one."""
    data = line("0", cells=16)
    data["system"] = {"kind": "ode", "derivative": {"x": "-x"}, "step": 0.5, "substeps": 1000}
    _, many = proved(data)
    data["system"]["substeps"] = 1
    _, one = proved(data)
    assert many.arrives == one.arrives == 1
    assert many.steps == one.steps


def test_clipped_images_are_never_out():
    data = line("where(x > 0.9, 2, x - 0.25)", on_exit="clip")
    _, proof = proved(data, target=0.866)
    assert proof.lost == 0  # x = 2 becomes 1, and so for ever
    assert proof.stays == pytest.approx(0.1 / 0.75, abs=1e-3)


@pytest.mark.parametrize("on_exit", ["forbid", "clip"])
def test_nothing_is_claimed_where_the_image_may_be_undefined(on_exit):
    """0/0 is no number, and the bounds of a quotient do not tell it from others."""
    data = line("where(x > 0.9, (x - x)/(x - x), x - 0.25)", on_exit=on_exit)
    _, proof = proved(data, target=0.866)
    assert (proof.lost, proof.stays) == (0, 0)
    assert proof.undecided == pytest.approx(0.1 / 0.75, abs=1e-3)


def test_all_noise_counts():
    """x+ = x/2 + w: of uniform noise also what no node has."""
    data = line(
        "0.5*x + w", cells=8, noise={"w": {"uniform": {"low": 0, "high": 0.1, "points": 1}}}
    )
    data["attractor"] = {"boxes": [{"x": [0, 0.25]}]}
    result, proof = proved(data, target=0.999)
    assert proof.arrives >= 0.999
    # A run with all the noise of the worst kind: x = 1, 0.6, 0.4, 0.3, 0.25.
    assert proof.steps >= 5
    data["noise"] = {"w": {"values": [0.05], "weights": [1]}}
    _, few = proved(data, target=0.999)
    assert few.steps < proof.steps
    data["noise"] = {"w": {"uniform": {"low": 0, "high": 0.16, "points": 1}}}
    result, proof = proved(data, target=0.999, time_limit=1)
    assert proof.arrives < 0.5
    assert exceptions(result, proof, 1000)["lost"] == 0


def test_terminal_costs_and_gamma_are_paid():
    """From cell k one step a cell: V = 1 + gamma + ... + gamma^k t."""
    data = line("x - 0.25", gamma=0.5, terminal_cost="3 + 0*x", attractor={"cells": [[0]]})
    data["system"]["next"]["x"] = "0.125 + 0.25*floor(4*x - 1)"
    result, proof = proved(data, target=0.9)
    for cell, cost in ((1, 1 + 0.5 * 3), (2, 1 + 0.5 + 0.25 * 3), (3, 1.75 + 0.125 * 3)):
        x = np.array([0.25 * cell + 0.1])
        b = box_at(proof, result.partition, x)
        assert proof.cost_above[b] == pytest.approx(cost)
        assert proof.cost_below[b] == pytest.approx(cost)
        assert proof.level[b] == cell


def test_levels_of_what_is_lost_count_steps():
    data = line("where(x > 0.95, 2, where(x > 0.90, x + 0.05, x - 0.25))")
    result, proof = proved(data, target=0.86)
    assert proof.level[box_at(proof, result.partition, np.array([0.97]))] == 1
    assert proof.level[box_at(proof, result.partition, np.array([0.945]))] == 2


def test_what_cannot_be_proved_is_bad_input():
    with pytest.raises(lm.BadInput, match="share"):
        lm.solve(made(steps())).prove(2.0)
    function = lm.systems.FunctionSystem(next=lambda x, u: {"x": x - 0.25 * u})
    problem = made({**steps(), "system": function})
    with pytest.raises(lm.BadInput, match="cannot be enclosed"):
        lm.solve(problem).prove()
    matrices = lm.from_matrices(np.array([[[0.0, 1.0], [0.0, 1.0]]]), np.ones((2, 1)), targets=[1])
    with pytest.raises(lm.BadInput, match="rows"):
        lm.solve(matrices).prove()
    with pytest.raises(lm.BadInput, match="time_limit"):
        lm.solve(made(steps())).prove(time_limit=-1)
    refused = lm.solve(made(doubling(3.0)))
    with pytest.raises(lm.BadInput, match="no controller"):
        refused.prove()


def test_a_time_limit_leaves_a_sound_proof():
    result = lm.solve(made(line("where(abs(x - 0.95) < 0.03, 0.5*x + 0.475, x - 0.25)")))
    proof = result.prove(1.0, time_limit=1e-6)
    assert proof.arrives + proof.lost + proof.stays + proof.undecided == pytest.approx(1)
    assert not proof.reached


def test_without_an_attractor_staying_is_the_target():
    """x+ = x/2 + 1/4 of a killed chain: C is all cells, and what starts there stays."""
    data = line("0.5*x + 0.25", discount=0.9, attractor={})
    _, proof = proved(data, target=0.999)
    assert proof.stays == 1
    assert proof.arrives == 0
    assert proof.reached
    assert str(proof).startswith(
        "of the volume that is controlled 100.0000 % is proved to stay, 0.0000 % to be lost"
    )
    assert "elsewhere" not in str(proof)
    assert "stays in A" not in str(proof)


def test_a_cost_without_bounds_is_kept(tmp_path):
    """Of a pole between samples nothing is known of the cost; what arrives still does."""
    data = line("0.5*x", stage_cost="1/(x - 0.31)**3 + 1e6", attractor={"cells": [[0]]})
    result, proof = proved(data, target=0.9)
    assert proof.arrives == 1
    assert proof.cost == (-np.inf, np.inf)
    result.save(tmp_path / "out")
    add(tmp_path / "out", result, proof)
    assert lm.verify(tmp_path / "out").holds


def test_the_cost_of_a_killed_chain_counts_the_discount():
    data = line("0.125 + 0.25*floor(4*x - 1)", discount=0.5, gamma=1.0)
    result, proof = proved(data, target=0.9)
    b = box_at(proof, result.partition, np.array([0.6]))
    assert proof.cost_above[b] == pytest.approx(1 + 0.5)


def test_a_controller_inside_the_attractor_that_is_proved_to_hold():
    data = line("0.5*x", local_controller={"kind": "constant", "control": {}})
    data["attractor"] = {"boxes": [{"x": [0, 0.25]}]}
    _, proof = proved(data)
    assert proof.holds is True
    data["system"]["next"]["x"] = "where(x < 0.25, x + 0.2, 0.5*x)"
    _, proof = proved(data, target=0.5)
    assert proof.holds is False


@pytest.mark.parametrize("local", [{"kind": "constant", "control": {}},
                                   {"kind": "hold", "partial": True}])  # fmt: skip
def test_what_arrives_stays_if_what_it_can_enter_holds(local, tmp_path):
    """A = [0, 1/2]: what is above 3/8 leaves it; below it is halved. Who enters decides."""
    data = line("where(x > 0.499, SHARE*x, where(x > 0.375, x + 0.3, 0.5*x))", cells=16)
    data |= {"attractor": {"boxes": [{"x": [0, 0.5]}]}, "local_controller": local}
    refuted = None if local["kind"] == "hold" else False  # states that do not hold are not tried
    for share, holds in (("0.25", True), ("0.45", refuted)):
        text = data["system"]["next"]["x"].replace("SHARE", share)
        problem = made({**data, "system": {"kind": "map", "next": {"x": text}}})
        result = lm.solve(problem)
        assert 0 < result.local_controller.proved < 8
        proof = result.prove(0.5)
        assert proof.arrives == 1
        assert proof.holds is holds
        result.save(tmp_path / share)
        add(tmp_path / share, lm.Result.load(tmp_path / share), proof)
        assert lm.verify(tmp_path / share).holds
    certificate = tmp_path / "0.45" / "certificate.json"
    said = json.loads(certificate.read_text())
    said["proof"]["holds"] = True
    certificate.write_text(json.dumps(said))
    assert not lm.verify(tmp_path / "0.45").holds


def test_an_empty_answer_is_said_in_words():
    data = line("where(abs(x - 0.95) < 0.03, 0.5*x + 0.475, x - 0.25)")
    _, proof = proved(data, target=0.95)
    text = str(proof)
    assert "stay elsewhere" in text
    assert "for example from (" in text
    assert "not reached" in text
