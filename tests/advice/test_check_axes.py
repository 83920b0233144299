"""``check``: angles that are no circles, or in degrees, and images that lie on edges."""

from __future__ import annotations

import json

import pytest
from checked import PI, found, pendulum, shift
from problems import made

import lmdsl as lm


def test_degrees():
    degrees = {"points": [{"th": 180, "om": 0}]}
    finding = found(pendulum(attractor=degrees))["degrees"]
    assert finding.where == "attractor.points[0].th"
    assert finding.figures["radians"] == pytest.approx(PI)
    assert "degrees" not in found(pendulum(attractor={"points": [{"th": PI, "om": 0}]}))
    assert "degrees" not in found(pendulum(attractor={"points": [{"th": 3 * PI / 2, "om": 0}]}))
    lists = found(pendulum(attractor={"points": [[90, 0]]}))
    assert lists["degrees"].where == "attractor.points[0][0]"


def test_an_axis_in_degrees():
    data = pendulum(attractor={"boxes": [{"th": [-24, 24], "om": [-0.8, 0.8]}]})
    data["state_box"]["th"] |= {"low": -180, "high": 180}
    assert found(data)["degrees"].where == "state_box.th"
    data["system"]["derivative"] = {"th": "om", "om": "g*sin(pi/180*th) + u"}
    assert "degrees" not in found(data)


# Axes ------------------------------------------------------------------------------------------


def test_an_angle_that_is_not_declared_periodic():
    report = found(pendulum(periodic=False))
    finding = report["not_periodic"]
    assert finding.where == "state_box.th"
    assert finding.figures["period"] == pytest.approx(2 * PI)
    assert finding.figures["share_then"] > finding.figures["share"] + 0.1
    coverage = lm.solve(made(pendulum())).coverage
    assert finding.figures["share_then"] == pytest.approx(coverage.share)


@pytest.mark.parametrize(("low", "high"), [(-3.14, 3.14), (-3.5, 3.5), (0, 6.2831853)])
def test_an_angle_of_about_a_turn(low, high):
    data = pendulum(periodic=False)
    data["state_box"]["th"] |= {"low": low, "high": high}
    finding = found(data)["not_periodic"]
    axis = {
        name: json.loads(word)
        for name, word in (
            part.strip('"').split('": ') for part in finding.remedy[6:].split(", ")[:2]
        )
    }
    assert axis["high"] - axis["low"] == pytest.approx(2 * PI)


@pytest.mark.parametrize(
    ("next_", "box"),
    [
        ("x + 0.1*u", (0, 1)),  # moved along with the state: no circle
        ("0.5*x + 0.1*u", (0, 1)),
        ("0.5", (0, 1)),
        ("3*x + 0.1*u", (0, 1)),  # unstable and straight: whole lengths go to whole lengths
        ("where(x < 1, 0.2, 0.7)", (0, 1)),  # images that do not depend on where outside
        ("x + 0.1*sin(2*pi*x) + 0.1*u", (0, 0.9)),  # not the whole circle
        ("x + 0.1*sin(pi*x) + 0.1*u", (0, 1)),  # half of it
    ],
)
def test_no_circle(next_, box):
    data = shift(low=box[0], high=box[1], attractor={"points": [[0.5]]})
    data["system"]["next"]["x"] = next_
    assert "not_periodic" not in found(data)


def test_a_circle_of_length_one():
    data = shift(low=0, high=1, attractor={"points": [[0.5]]})
    data["system"]["next"]["x"] = "x + 0.1*sin(2*pi*x) + 0.1*u"
    assert found(data)["not_periodic"].figures["period"] == 1
    data["state_box"]["x"]["periodic"] = True
    assert "not_periodic" not in found(data)


def test_images_that_lie_on_edges():
    # The middle of a cell of width 1 goes by 0.5 to an edge; with widths of 0.9 it does not.
    at = {"attractor": {"points": [[0.25]]}}
    finding = found(shift(low=-4.5, high=4.5, cells=9, **at))["on_edges"]
    assert finding.where == "state_box.x.cells"
    assert finding.figures["share"] > 0.5
    assert finding.figures["cells"] == 10
    assert finding.figures["share_then"] == 0
    assert "on_edges" not in found(shift(low=-4.5, high=4.5, cells=10, **at))
    assert "on_edges" not in found(shift(low=-4.5, high=4.5, cells=9, per_axis=2, **at))


def test_images_at_the_ends_of_an_axis_are_no_accident():
    data = shift("9*u", on_exit="clip")
    assert "on_edges" not in found(data)


def test_a_doubling_circle():
    data = shift(low=0, high=1, attractor={"points": [[0.5]]})
    data["system"]["next"]["x"] = "mod(2*x + 0.1*u, 1)"
    assert found(data)["not_periodic"].figures["period"] == 1
