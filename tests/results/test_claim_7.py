"""Claim 7, no run of the map is lost, as a script without lmdsl judges it: what holds, what not."""

from __future__ import annotations

import functools
import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from certificate_files import checked, exported, fails
from problems import made, steps
from standing_alone import PROBLEMS, judge

import lmdsl as lm
from lmdsl.model.sets import CellSets
from lmdsl.model.true_map import TrueMap

pytestmark = pytest.mark.long  # in other versions it would find nothing else


@functools.cache
def exported_lines(name):
    """Solve a problem; return the result and the lines of its certificate."""
    result = lm.solve(made(PROBLEMS[name]))
    assert result.status == "verified", result.message
    with tempfile.TemporaryDirectory() as folder:
        return result, exported(result, Path(folder)).read_text().splitlines()


def spoiled(name, tmp_path, change):
    """Change the head and the cells of a certificate, and check it."""
    _, lines = exported_lines(name)
    head = json.loads(lines[0])
    cells = [json.loads(line) for line in lines[1 : head["cells"] + 1]]
    change(head["map"], cells)
    path = tmp_path / "spoiled"
    rest = lines[head["cells"] + 1 :]
    path.write_text("\n".join([*map(json.dumps, [head, *cells]), *rest]) + "\n")
    return checked(path)


@pytest.mark.parametrize("name", PROBLEMS)
def test_what_lmdsl_proves_the_script_proves(name, tmp_path):
    result, _ = exported_lines(name)
    assert result.claims["safe"] is True
    status, said = spoiled(name, tmp_path, lambda said, cells: None)
    assert status == 0, said
    assert "claim 7 safe: holds" in said
    assert said.count("holds") == 6


@pytest.mark.parametrize("partial", [False, True])
def test_attractors_that_hold_are_judged_by_their_cells(partial, tmp_path):
    hold = {"kind": "hold", "partial": partial}
    result = lm.solve(made({**PROBLEMS["endpoint"], "local_controller": hold}))
    assert result.claims["safe"] is True
    path = exported(result, tmp_path)
    said = json.loads(path.read_text().splitlines()[0])["map"]
    assert said["attractor"] == np.flatnonzero(result.cell_status == 0).tolist()
    assert said["ends_on_path"] is False
    assert "claim 7 safe: holds" in checked(path)[1]


def test_nothing_is_said_of_sampled_successors(tmp_path):
    path = exported(lm.solve(made(steps())), tmp_path)
    assert "map" not in json.loads(path.read_text().splitlines()[0])
    assert "claim 7" not in checked(path)[1]


def states_of(partition, cell, count, rng):
    """Return states of a cell, many of them at its edges and at the seam."""
    index = np.array([int(k[0]) for k in partition.multi_index(np.array([cell]))])
    offsets = rng.random((count, len(index)))
    special = np.array([0.0, 1.0, 0.9e-9, -0.9e-9, 1 - 1.1e-9, 1e-12, 0.5])
    chosen = rng.random(offsets.shape) < 0.4
    offsets[chosen] = rng.choice(special, size=int(chosen.sum()))
    x = partition.low + (index + offsets) * partition.width
    seam = partition.periodic & (index == 0) & (rng.random(offsets.shape) < 0.2)
    states, located = partition.enter(np.where(seam, partition.high, x))
    return states[located == cell]


def lost(problem, partition, allowed, cell, control, rng):
    """Return whether some state of a cell, under some noise, is led where it may not."""
    x = states_of(partition, cell, 60, rng)
    noise = []
    for each in (problem.noise or {}).values():
        least, most = each.parts()
        part = rng.integers(len(least), size=len(x))
        noise.append(rng.choice([0.0, 0.5, 1.0], size=len(x)) * (most - least)[part] + least[part])
    u = np.repeat(control[None], len(x), axis=0)
    images = TrueMap(problem, partition).images(x, u, noise)
    cells = partition.locate(list(images.T))
    bad = (cells < 0) | ~allowed[cells]
    admitted = problem.admitted()
    if admitted is not None:
        values = dict(zip((*problem.states, *problem.controls), (*x.T, *u.T), strict=True))
        bad |= admitted(values)[0] == 0
    return bad.any()


@pytest.mark.parametrize("name", [name for name in PROBLEMS if name not in ("named", "walls")])
def test_no_control_that_loses_a_state_is_proved(name, monkeypatch):
    """Every control of every cell, of which the surviving ones are proved."""
    result, lines = exported_lines(name)
    lp, rng = result.lp, np.random.default_rng(0)
    judged = judge.Judge(json.loads(lines[0])["map"], lp.cells.tolist())
    allowed = np.isin(result.cell_status, (0, 1))
    refused = 0
    monkeypatch.setattr(judge, "MOST", 64)
    for i, cell in enumerate(lp.cells.tolist()):
        surviving = lp.control[lp.pair_pointer[i] : lp.pair_pointer[i + 1]]
        for control, values in enumerate(lp.controls):
            why = judged.unproved(cell, control)
            assert why is None or control not in surviving, (cell, control, why)
            refused += why is not None
            assert why or not lost(lp.problem, lp.partition, allowed, cell, values, rng)
    assert refused or name not in ("clip", "edges", "endpoint")


def test_no_path_through_a_wall_is_proved(monkeypatch):
    result, lines = exported_lines("walls")
    lp, rng, late = result.lp, np.random.default_rng(1), np.linspace(0, 1, 41)[1:]
    judged = judge.Judge(json.loads(lines[0])["map"], lp.cells.tolist())
    sets, crossings = CellSets.of(lp.problem, lp.partition), 0
    monkeypatch.setattr(judge, "MOST", 16)
    for i, cell in list(enumerate(lp.cells.tolist()))[::5]:
        surviving = lp.control[lp.pair_pointer[i] : lp.pair_pointer[i + 1]]
        for control, (a,) in enumerate(lp.controls):
            x = states_of(lp.partition, cell, 20, rng)
            way = 0.5 * late[:, None, None] * np.array([np.cos(a), np.sin(a)])
            places = lp.partition.locate(list(np.moveaxis(x + way, -1, 0)))
            entered = np.cumsum(sets.attractor[places] & (places >= 0), axis=0) > 0
            lost = (((places < 0) | sets.avoid[places]) & ~entered).any()
            if not (lost or control in surviving):
                continue
            crossings += lost
            assert (judged.unproved(cell, control) is not None) == lost, (cell, control)
    assert crossings > 20


def the_first(key, value):
    def change(said, cells):
        said[key][0] = value

    return change


def without_a_goal(said, cells):
    said["attractor"].pop(len(said["attractor"]) // 2)


def other_control(said, cells):
    for cell in cells:
        cell["policy"] = (cell["policy"] + 1) % len(said["control_vectors"])


def elsewhere(said, cells):
    said["axes"][0][:2] = [x.hex() for x in (0.9, 2.0)]


def no_seam(said, cells):
    said["axes"][0][3] = False


def longer(said, cells):
    said["ode"][0] = (3 * float.fromhex(said["ode"][0])).hex()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("line", the_first("formulas", "shrunk + u*(1 - x**2) + 0.5")),
        ("line", lambda said, cells: said["parameters"].update(a=(1.3).hex())),
        ("line", lambda said, cells: said["let"].update(shrunk="a*x + 0.5")),
        ("line", without_a_goal),
        ("line", elsewhere),
        ("choice", the_first("formulas", "where(x > 0 and not x > 2, 0.4*x, 1/x) + 0.1*u")),
        ("choice", lambda said, cells: said.update(admissible="x*u < 0.4 and x + u > 0")),
        ("circle", without_a_goal),
        ("seam", without_a_goal),
        ("seam", no_seam),
        ("nodes", lambda said, cells: said["noise_parts"].append([[(9.0).hex()] * 2])),
        ("uniform", lambda said, cells: said["noise_parts"][1][0].__setitem__(1, (0.9).hex())),
        ("clip", lambda said, cells: said.update(clip=False)),
        ("edges", lambda said, cells: said["control_vectors"][0].__setitem__(0, (-0.31).hex())),
        ("endpoint", other_control),
        ("endpoint", longer),
        ("endpoint", the_first("formulas", "y + 1")),
        ("named", lambda said, cells: said["parameters"].update(mu=(6.0).hex())),
        ("walls", other_control),
        ("walls", lambda said, cells: said["avoid"].append(cells.pop()["cell"])),
        ("walls", longer),
    ],
)  # fmt: skip
def test_what_is_spoiled_is_refused(name, change, tmp_path):
    status, said = spoiled(name, tmp_path, change)
    assert status in (1, 2), said
    if status == 1:
        assert fails(said, 7), said
    else:
        assert said.startswith("not a certificate"), said


@pytest.mark.parametrize(
    "change",
    [
        lambda said, cells: said["attractor"].append(cells[0]["cell"]),
        lambda said, cells: said["avoid"].append(-1),
        lambda said, cells: said.pop("axes"),
        lambda said, cells: said["axes"].append(said["axes"][0]),
        lambda said, cells: said["axes"][0].__setitem__(2, 0),
        lambda said, cells: said["noise_parts"].append([["0x1p0", "0x1p0"]]),
        lambda said, cells: said.update(noise_parts=[]),
        lambda said, cells: said["formulas"].append("x"),
        *(
            the_first("formulas", text)
            for text in (
                "__import__('os').getpid()", "x.real", "x if x > 0 else u", "(lambda: x)()",
                "[x][0]", "x + y", "x % 2", "x // 2", "x < 1", "where(x, 1, 2)", "sin(x, u)",
                "min(*[x, u])", "0 < x < 1", "1j", "'x'", "True", "x; u", "sin(x=u)", "1e999",
                "where(0 < x < 1, x, u)", "(x > 0) + 1", "not x",
            )
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_no_certificate(change, tmp_path):
    status, said = spoiled("line", tmp_path, change)
    assert status == 2, said
    assert said.startswith("not a certificate")


def test_the_policy_must_be_a_control(tmp_path):
    def change(said, cells):
        said["control_vectors"].clear()

    assert spoiled("line", tmp_path, change)[0] == 2
