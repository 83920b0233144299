"""``check``: the attractor, what acts on it, and how little can be stabilized."""

from __future__ import annotations

import json

import numpy as np
import pytest
from checked import found, pendulum, shift
from problems import made

import lmdsl as lm
from lmdsl.advice.targets import _longest
from lmdsl.cli import main


def swapped():
    """The pendulum with the formulas of its states exchanged, friction beside."""
    data = pendulum()
    data["system"]["derivative"] = {"th": "g*sin(th) + u", "om": "om"}
    return data


def test_little_that_can_be_stabilized_is_no_right_look():
    report = lm.check(made(swapped()))
    (finding,) = [one for one in report.findings if one.code == "few_stabilizable"]
    share = finding.figures["stabilizable"] / finding.figures["free"]
    assert 0 < share == report.expected.coverage < 0.1
    lost = sum(finding.figures["causes"].values())
    assert lost == finding.figures["free"] - finding.figures["stabilizable"]
    main = max(finding.figures["causes"], key=finding.figures["causes"].get)
    assert f"by this cause, {main}" in finding.text
    assert "no control acts on om, not even through other states" in finding.text
    message = lm.solve(made(swapped())).message
    stabilizable, free = finding.figures["stabilizable"], finding.figures["free"]
    assert message.startswith(f"only {stabilizable} of {free} free cells can be stabilized")


def test_it_is_said_before_all_else(tmp_path, capsys):
    file = tmp_path / "p.json"
    file.write_text(json.dumps(swapped()))
    assert main(["solve", str(file), "--no-simulate"]) == 0
    first, empty, *_ = capsys.readouterr().out.split("\n")
    assert first.startswith("only ")
    assert first.endswith("free cells can be stabilized")
    assert not empty
    assert main(["check", str(file)]) == 1
    file.write_text(json.dumps(pendulum()))
    assert main(["solve", str(file), "--no-simulate"]) == 0
    assert capsys.readouterr().out.count("only ") == 1  # of the check before


def test_a_step_that_moves_samples_out_of_all_cells_is_not_said_to_keep_any():
    text = found(pendulum(0.02))["short_step"].text
    assert "no control moves any sample out" not in text
    assert "can the attractor be reached" in text
    stays = found(shift("0.01*u"))["short_step"].text
    assert stays.startswith("in 14 of 14 cells tried no control moves any sample out of its cell")


def test_states_are_steered_through_others():
    assert "few_stabilizable" not in found(pendulum())
    let = swapped() | {"let": {"push": "u - om"}}
    let["system"]["derivative"] = {"th": "g*sin(th)", "om": "push"}
    data = {code: one.text for code, one in found(let).items()}
    assert all("no control acts on th" in text for code, text in data.items() if "stabil" in code)


def test_a_control_that_stands_only_in_the_cost():
    data = pendulum()
    data["system"]["derivative"]["om"] = "g*sin(th)"
    data["stage_cost"] = "1 + u**2"
    finding = found(data)["idle_control"]
    assert finding.where == "control_grid.u"
    assert finding.text == "no control changes any next state: u stands only in stage_cost"
    assert "idle_control" not in found(pendulum())
    both = shift("0.5*u", stage_cost="1 + v**2")
    both["control_grid"]["v"] = {"values": [0, 1]}
    text = found(both)["idle_control"].text
    assert text == "v changes no next state: it stands only in stage_cost"
    through = shift("0.5*push", stage_cost="1 + u**2", let={"push": "u"})
    assert "idle_control" not in found(through)


def test_a_box_that_whole_cells_leave_too_little_of():
    data = shift(low=-4, high=4, cells=16, attractor={"boxes": [{"x": [-0.8, 0.8]}]})
    report = lm.check(made(data))
    assert not report
    (finding,) = report.notes
    assert f"nothing looks wrong\n\nnote: {finding}" in str(report) == repr(report)
    assert finding.figures["kept"] == pytest.approx(1 / 1.6)
    assert finding.figures["cells"] == {"x": 20}  # cells 0.4 wide have edges at 0.8
    assert finding.figures["around"] == {"x": [-1, 1]}
    data["state_box"]["x"]["cells"] = 20
    assert not lm.check(made(data)).notes
    whole = shift(attractor={"boxes": [finding.figures["around"]]})
    assert not lm.check(made(whole)).notes


HOLDING = {"successors": "enclosed", "local_controller": {"kind": "hold"}}


def test_no_attractor_cell_that_holds_is_the_first_cause():
    data = shift("1.5*x + 0.1*u", per_axis=2, **HOLDING)
    finding = found(data)["nothing_holds"]
    assert finding.where == "local_controller"
    assert finding.text.startswith("no attractor cell holds")
    assert finding.text not in finding.remedy
    assert f"{finding.text}: {finding.remedy}" in lm.solve(made(data)).message
    explained = lm.explain(made(data))
    lines = str(explained).split("\n")
    assert lines[2] == explained.to_dict()["unheld"]
    assert lines[2].startswith("no attractor cell holds")
    holds = shift("-0.5*x", **HOLDING)
    assert "nothing_holds" not in found(holds)
    assert lm.explain(made(holds)).unheld is None


def noisy(half, **more):
    noise = {"w": {"uniform": {"low": -half, "high": half, "points": 3}}}
    return shift("0.5*u + w", noise=noise, **more)


def test_noise_wider_than_the_attractor():
    finding = found(noisy(0.6))["noise_too_wide"]  # 2.4 cells; the attractor is 2 long
    assert finding.figures["noise"] == pytest.approx(2.4)
    assert finding.figures["attractor"] == 2
    assert lm.solve(made(noisy(0.6, successors="enclosed"))).sure_cells in (0, None)
    assert "noise_too_wide" not in found(noisy(0.5))
    assert "noise_too_wide" not in found(noisy(0.6, attractor={"boxes": [{"x": [-1, 1]}]}))


def test_noise_that_is_narrower_beside_the_attractor():
    data = noisy(0.5, cells=4_000, attractor={"boxes": [{"x": [-0.02, 0.02]}]})
    data["system"]["next"] = {"x": "0.5*x + w*x + 0*u"}
    assert "noise_too_wide" not in found(data)
    data["noise"]["w"]["uniform"] |= {"low": -1, "high": 1.5}
    assert "noise_too_wide" in found(data)


def test_rows_of_cells():
    rng = np.random.default_rng(0)
    for periodic in (False, True):
        for _ in range(50):
            mask = rng.random((4, 6)) < 0.6
            for axis in (0, 1):
                lines = mask.T if axis == 0 else mask
                words = ["".join("x" if x else " " for x in line) for line in lines]
                longest = max(
                    len(part) for word in words for part in (word * (1 + periodic)).split(" ")
                )
                assert _longest(mask, axis, periodic) == min(longest, mask.shape[axis])
