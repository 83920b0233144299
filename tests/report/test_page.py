"""The page as a whole: what it says, that nothing gets in or out, and that it is written whole."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest
from command_line import run
from problems import made, standard_map, steps
from reports import LIBRARY, SCRIPTS, Read, told, written

import lmdsl as lm
from lmdsl.errors import MissingDependency
from lmdsl.report import cells, sections, writing
from lmdsl.report.browser import unpacked
from lmdsl.report.page import page
from lmdsl.systems import FunctionSystem

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>'\"&<!--\u202e\n<b>"


@pytest.fixture
def library(monkeypatch):
    """Pages with a small library instead of plotly.js."""
    monkeypatch.setattr(writing, "_library", lambda: LIBRARY)


@pytest.mark.parametrize(
    "name", ["maze", "lorenz", "logistic", "standard", "refused", "autonomous"]
)
def test_every_kind_of_result_has_a_page(solved, name):
    result = solved(name)
    read = written(result)
    for heading in ("The problem", "What is certified, and what is not", "Pictures",
                    "The closed loop", "Simulated runs", "What cannot be stabilized",
                    "How to repeat it"):  # fmt: skip
        assert heading in read.text, heading
    assert {"verified": "Verified", "not_stabilizable": "Not stabilizable"}[result.status] in \
        read.text  # fmt: skip
    assert result.problem.name in read.text
    if result.verified:
        assert sections.number(result.cost) in read.text
        assert f"{result.coverage.stabilizable:,} of {result.coverage.free:,}" in read.text


def test_numbers_of_the_page_are_those_of_the_result(solved):
    result = solved("maze")
    data = json.loads(written(result).scripts[0])
    found = data["cells"]
    assert np.array_equal(unpacked(found["status"]), result.cell_status)
    assert np.array_equal(unpacked(found["index"]).astype(int) - 1, result.control_index)
    layers = {layer["key"]: unpacked(layer["values"]) for layer in found["layers"]}
    on = result.cell_status == 1
    for key, values in (("value", result.value), ("lower", result.lower),
                        ("measure", result.measure)):  # fmt: skip
        assert np.allclose(layers[key][on], values[on], rtol=1e-6)
        assert np.isnan(layers[key][~on]).all()
    chosen = result.control_vectors[result.control_index[on], 1]
    assert np.array_equal(layers["control 1"][on], chosen.astype(np.float32))
    assert {r["name"]: r["cells"] for r in found["regions"]} == {
        name: int((result.cell_status == code).sum())
        for code, (name, *_) in cells.REGIONS.items()
        if (result.cell_status == code).any()
    }


def test_lost_cells_are_told_by_cause_and_region(solved):
    result = solved("maze")
    told_ = {cause["name"]: cause for cause in told(result)["lost"]}
    for code, name in ((2, "escapes"), (3, "trapped"), (4, "leads to these")):
        count = int((result.cell_status == code).sum())
        assert told_[name]["cells"] == count
        inside = sum(region["cells"] for region in told_[name]["regions"])
        assert inside + told_[name]["elsewhere"] == count
    assert all(region["why"] for region in told_["escapes"]["regions"])


def test_what_scrolls_sideways_does_not_scroll_up():
    """A formula a bit higher than its box would bring a bar; long lines of text are wrapped."""
    rules = re.findall(r"([^{}]+){([^{}]*)}", (SCRIPTS / "page.css").read_text())
    sideways = [body for _, body in rules if "overflow-x: auto" in body]
    assert len(sideways) == 2
    assert all("overflow-y: hidden" in body for body in sideways)
    pre = [body for head, body in rules if head.strip() == "pre"]
    assert "white-space: pre-wrap" in pre[0]


# Nothing gets in -----------------------------------------------------------------------------


def harmful(result, text):
    """The page of a result in which every text that a file holds is this one."""
    problem = result.problem.model_copy(update={"name": text})
    data = told(replace(result, problem=problem, message=text, backend=text, solver_status=text))
    data["reasons"] = [text]
    data["assumes"] = data["scope"] = text
    data["repeat"]["directory"] = data["repeat"]["digest"] = text
    data["notes"] = [text]
    data["proof"] = text
    data["verification"] = {"holds": False, "reasons": [text]}
    data["comparison"] = {"results": [{**data["result"], "backend": text}], "agreement": None}
    for row in data["claims"]:
        row["figure"] = row["claim"] = text
    for cause in data["lost"]:
        cause["name"] = cause["meaning"] = text
        cause["regions"] = [{"box": text, "cells": 1, "why": text}]
    return page(data, LIBRARY)


def test_names_from_files_are_inert(solved):
    """A page of harmful texts has the very elements and attributes of one of harmless ones."""
    evil, good = (Read(harmful(solved("maze"), text)) for text in (EVIL, "harmless"))
    plain = [[(tag, {k: v for k, v in a.items() if k != "content"}) for tag, a in read.tags]
             for read in (evil, good)]  # fmt: skip
    assert plain[0] == plain[1]
    assert evil.scripts[1:] == good.scripts[1:]
    assert "alert(1)" in evil.text
    assert "\u202e" not in "".join(evil.words)


def test_names_of_states_and_parameters_are_inert_too():
    """They are words of the language; Python can make others where nothing is checked."""
    read = Read(harmful(lm.solve(made(steps())), EVIL))
    assert {tag for tag, _ in read.tags}.isdisjoint({"img", "b", "iframe", "object", "link"})


def test_the_script_reads_what_was_meant(solved):
    """The plain data are strict JSON behind which no element ends."""
    text = harmful(solved("maze"), EVIL)
    (held,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text)
    assert "<" not in held

    def refuse(word):
        raise AssertionError(word)

    assert set(json.loads(held, parse_constant=refuse)) >= {"cells", "map", "starts"}


@pytest.mark.parametrize("evil", ["harmless", EVIL])
def test_a_browser_runs_our_scripts_and_no_other(solved, evil):
    read = Read(harmful(solved("maze"), evil))
    (policy,) = [a["content"] for tag, a in read.tags
                 if a.get("http-equiv") == "Content-Security-Policy"]  # fmt: skip
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    digests = [f"'sha256-{base64.b64encode(hashlib.sha256(x.encode()).digest()).decode()}'"
               for x in read.scripts[1:]]  # fmt: skip
    assert rules["script-src"].split() == digests
    assert rules["default-src"] == "'none'"
    assert len(digests) == 2


def test_nothing_is_fetched(solved):
    """No address stands in a page: the library is the only other text in it."""
    read = written(solved("maze"))
    for tag, attributes in read.tags:
        for key in ("src", "href", "action", "srcset", "data"):
            value = attributes.get(key)
            assert value is None or value.startswith("#"), (tag, key, value)
    own = read.scripts[-1] + "".join(read.words)
    assert set(re.findall(r"https?://[^\s\"']+", own)) <= {"http://www.w3.org/2000/svg"}
    assert not re.search(r"\b(fetch|XMLHttpRequest|eval|import)\s*\(|innerHTML|new Function", own)


# Files ---------------------------------------------------------------------------------------


def test_it_appears_whole_or_not_at_all(solved, tmp_path, library):
    result = solved("steps")
    result.report(tmp_path / "a.html")
    assert (tmp_path / "a.html").read_text().endswith("</html>\n")
    for wrong in ("a.pdf", "a", "", "none/a.html"):
        with pytest.raises(lm.BadInput):
            result.report(tmp_path / wrong)
    assert os.listdir(tmp_path) == ["a.html"]


def test_the_same_result_has_the_same_page(solved, tmp_path, library):
    for name in ("a.html", "b.html"):
        solved("maze").report(tmp_path / name, seed=3)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_the_library_is_plotlys_own(solved, tmp_path):
    pytest.importorskip("plotly")
    solved("steps").report(tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text()
    assert "plotly.js v" in text
    assert "Licensed under the MIT license" in text
    assert len(text) < 8e6


def test_without_plotly_the_fix_is_named(solved, tmp_path, monkeypatch):
    monkeypatch.setattr(writing, "find_spec", lambda name: None)
    with pytest.raises(MissingDependency) as caught:
        solved("steps").report(tmp_path / "a.html")
    assert str(caught.value) == (
        'reports need plotly: pip install "lmdsl[report]" (in a clone: pip install -e ".[report]")'
    )
    assert not os.listdir(tmp_path)


def test_arguments_are_checked(solved, tmp_path, library):
    result = solved("steps")
    for wrong in ({"proof": 1}, {"comparison": 1}, {"seed": -1}):
        with pytest.raises(lm.BadInput) as caught:
            result.report(tmp_path / "a.html", **wrong)
        assert caught.value.where == next(iter(wrong))
    eight = steps(state_box={"x": {"low": 0, "high": 2, "cells": 8}})
    other = lm.solve(made(eight)).prove(target=0.5)
    with pytest.raises(lm.BadInput, match="of another result"):
        result.report(tmp_path / "a.html", proof=other)


def test_large_grids_are_sampled(monkeypatch):
    """Of every axis each third cell: what is drawn shrinks, what runs need does not."""
    result = lm.solve(made(standard_map(20)))
    monkeypatch.setattr(cells, "MOST_DRAWN", 60)
    found = cells.cells_of(result, None)
    assert found["step"] == 3
    assert found["drawn"] == [7, 7]
    values = unpacked(found["layers"][0]["values"]).reshape(7, 7)
    assert values[2, 5] == np.float32(result.value.reshape(20, 20)[7, 16])
    assert found["whole"]
    assert len(unpacked(found["status"])) == 400
    monkeypatch.setattr(cells, "MOST_FULL", 399)
    found = cells.cells_of(result, None)
    assert not found["whole"]
    assert len(unpacked(found["status"])) == 49


def test_results_of_functions_have_a_page(tmp_path, library):
    held = steps()
    held["system"] = FunctionSystem(next=lambda x, u: {"x": x - 0.25 * u})
    lm.solve(lm.Problem(**held)).save(tmp_path / "out")
    path, _ = writing.write_directory(tmp_path / "out")
    read = Read(path.read_text())
    assert "a map written as a Python function" in read.text
    assert json.loads(read.scripts[0])["rows"] is not None
    assert "Left out of this page" in read.text


def test_a_loaded_result_is_compiled_for_its_spectrum(solved, tmp_path, library):
    solved("maze").save(tmp_path / "out")
    for result, name in ((solved("maze"), "a.html"), (lm.Result.load(tmp_path / "out"), "b.html")):
        result.report(tmp_path / name)
    a, b = (json.loads(Read((tmp_path / x).read_text()).scripts[0]) for x in ("a.html", "b.html"))
    assert a["loop"] is not None
    assert a["loop"] == b["loop"]
    first, second = (Read((tmp_path / x).read_text()).text for x in ("a.html", "b.html"))
    assert "The claims were checked when the result was found" in first
    assert "quoted as the saved result states them" in second


def two_basins():
    """x+ = x - 0.25 u below 0.5, a tent above it: there gamma is limited, and here it is not."""
    box = {"x": {"low": 0, "high": 1, "cells": 16}}
    image = "where(x > 0.5, 0.5 + mod(3*(x - 0.5), 0.5), x - 0.25*u)"
    return steps(system={"kind": "map", "next": {"x": image}}, state_box=box,
                 attractor={"boxes": [{"x": [0, 0.25]}, {"x": [0.5, 0.625]}]})  # fmt: skip


def test_what_gamma_leaves_out_is_told(tmp_path, library):
    problem = made(two_basins()).replaced(gamma=3.0)
    refused = lm.solve(problem)
    found = told(refused)
    assert np.array_equal(unpacked(found["cells"]["status"]) == 6, refused.refusal_vector > 0)
    assert found["lost"][-1]["name"] == "no finite cost"
    assert "no law has a finite cost" in written(refused).text
    lm.solve(problem, restrict_to_gamma=True).save(tmp_path / "out")
    path, _ = writing.write_directory(tmp_path / "out")
    loop = json.loads(Read(path.read_text()).scripts[0])["loop"]
    assert loop["cells"] == 4
    assert loop["left"] == [1.0, 0.0]


def test_finite_models_have_a_page(tmp_path, library):
    P = np.array([[[1, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0.5]]] * 2)
    cost = np.array([[0.0, 0.0], [1.0, 2.0], [3.0, 1.0]])
    problem = lm.from_matrices(P, cost, targets=[0])
    lm.solve(problem).report(tmp_path / "a.html")
    read = Read((tmp_path / "a.html").read_text())
    assert "a finite model, given by its rows" in read.text
    assert "one of 2 actions in each of 3 states" in read.text
    assert "true map" not in read.text.split("Words used on this page")[0]
    assert json.loads(read.scripts[0])["map"] is None


# The command ---------------------------------------------------------------------------------


def test_the_command(capsys, tmp_path, solved, library):
    out = tmp_path / "out"
    solved("steps").save(out)
    status, said, _ = run(capsys, "report", out)
    assert status == 0
    assert said == f"written to {out}/report.html (the result as stored, not re-checked; " \
        "see lmdsl verify)\n"  # fmt: skip
    assert "quoted as the saved result states them" in Read((out / "report.html").read_text()).text
    assert lm.verify(out).holds
    status, said, _ = run(capsys, "report", out, "--verify", "--backends",
                          "policy-iteration,highs", "--out", tmp_path / "b.html")  # fmt: skip
    read = Read((tmp_path / "b.html").read_text())
    assert (status, "every claim holds" in said) == (0, True)
    assert "compiled anew and every claim holds" in read.text
    assert "Backends compared" in read.text
    assert "highs" in read.text


def test_what_does_not_hold_is_said_and_gives_1(capsys, tmp_path, solved, library):
    out = tmp_path / "out"
    solved("steps").save(out)
    certificate = json.loads((out / "certificate.json").read_text())
    certificate["cost"] = certificate["cost"] / 2
    (out / "certificate.json").write_text(json.dumps(certificate))
    status, said, _ = run(capsys, "report", out, "--verify")
    assert status == 1
    assert "NOT confirmed" in said
    text = Read((out / "report.html").read_text()).text
    assert "Checked for this page, and not confirmed" in text


def test_bad_input_gives_2_and_no_file(capsys, tmp_path, solved, library):
    out = tmp_path / "out"
    solved("steps").save(out)
    for arguments in ((tmp_path / "none",), (out, "--out", tmp_path / "a.txt"),
                      (out, "--backends", "nonsense"), (out, "--seed", "-1")):  # fmt: skip
        status, said, error = run(capsys, "report", *arguments)
        assert (status, said) == (2, "")
        assert error.count("\n") == 1
    assert not [*tmp_path.rglob("*.html")]


def test_a_proof_in_the_directory_is_told(tmp_path, solved, capsys, library):
    out = tmp_path / "out"
    solved("steps").save(out)
    assert run(capsys, "prove", out)[0] == 0
    assert run(capsys, "report", out)[0] == 0
    read = Read((out / "report.html").read_text())
    assert "Proved of the true map" in read.text
    assert "lmdsl prove" in read.text
    layers = {layer["key"]: layer for layer in json.loads(read.scripts[0])["cells"]["layers"]}
    share = unpacked(layers["arrives"]["values"])
    assert np.allclose(share[1:], 1, atol=2e-3)
    assert np.isnan(share[0])
