"""Plots of proofs show the kind of the box in which a state lies; words say where the rest sits."""

from __future__ import annotations

import numpy as np
import pytest
from problems import made
from proved_points import box_at

import lmdsl as lm
from lmdsl import plotting
from lmdsl.cli import main
from lmdsl.plotting.proved import proofs
from lmdsl.plotting.quantities import view_of
from lmdsl.results.directory import proved

pytest.importorskip("matplotlib")


def inwards(d, **more):
    """x+ = x/2 on [-1, 1]^d, but for a strip of x that is lost; A is the middle."""
    names = "xyz"[:d]
    formulas = {name: f"0.5*{name}" for name in names}
    formulas["x"] = "where(abs(x - 0.55) < 0.02, 2, 0.5*x)"
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": formulas},
        "state_box": {name: {"low": -1, "high": 1, "cells": 4} for name in names},
        "attractor": {"boxes": [{name: [-0.5, 0.5] for name in names}]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
        **more,
    }


@pytest.fixture(scope="module", params=[1, 2, 3])
def drawn(request):
    result = lm.solve(made(inwards(request.param)))
    return result, result.prove(0.9)


def test_pixels_are_of_the_box_in_which_their_middle_lies(drawn):
    result, proof = drawn
    view = view_of(result, ["y", "x"] if result.partition.dimension > 1 else None, None)
    pixels = proofs.painted(view, proof)
    rng = np.random.default_rng(0)
    part, seen = result.partition, set()
    for _ in range(300):
        at = np.array([rng.integers(n) for n in pixels.shape])
        x = part.low + (view.cell + 0.5 + 1e-9) * part.width  # held just above the middle
        for k, axis in enumerate(view.axes):
            x[axis] = part.low[axis] + (at[k] + 0.5) / pixels.shape[k] * 2
        b = box_at(proof, part, x)
        kind = proof.kind[b] if b >= 0 else proofs.NOTHING
        assert pixels[tuple(at)] == kind
        seen.add(int(kind))
    assert {1, 2} <= seen


def test_a_proof_is_drawn_with_words(drawn):
    result, proof = drawn
    ax = plotting.proof(result, proof)
    words = {text.get_text() for text in ax.get_legend().get_texts()}
    assert {"arrives", "lost"} <= words
    assert "stays elsewhere" not in words


def test_boxes_smaller_than_a_pixel_are_seen(drawn, monkeypatch):
    result, proof = drawn
    monkeypatch.setattr(proofs, "PIXELS", 4)
    pixels = proofs.painted(view_of(result, None, None), proof)
    assert pixels.shape[0] == 4
    assert (pixels[3] == proofs.LOST).any()  # the strip in [0.53, 0.57]
    assert not (pixels[0] == proofs.LOST).any()


def test_a_proof_of_another_result_is_not_drawn(drawn):
    other = lm.solve(made(inwards(2, state_box={n: {"low": -1, "high": 1, "cells": 2}
                                                for n in "xy"},
                                  attractor={"cells": [[0, 0]]})))  # fmt: skip
    with pytest.raises(lm.BadInput, match="another result"):
        plotting.proof(other, drawn[1])


def test_where_it_sits(drawn):
    """What is lost lies in cells of [0.5, 1]; half of it in at least half of these."""
    result, proof = drawn
    lost = proof.where["lost"]
    d = result.partition.dimension
    assert proof.where["stays"] is None
    assert lost.share >= 0.5
    assert 0 < len(lost.area) <= 4 ** (d - 1)
    assert all(region.box["x"] == pytest.approx((0.5, 1)) for region in lost.area.regions)
    assert f"in {len(lost.area)} cells" in proof.text()
    assert proof.to_dict()["where"]["lost"]["cells"] == len(lost.area)


@pytest.mark.parametrize("drawn", [2], indirect=True)
def test_a_page_of_a_directory_has_its_proof(drawn, tmp_path, monkeypatch):
    result, proof = drawn
    result.save(tmp_path / "out")
    proved.add(tmp_path / "out", result, proof)
    pages = []
    monkeypatch.setattr(plotting, "figure", lambda *_, **options: pages.append(options["proof"]))
    assert main(["plot", str(tmp_path / "out")]) == 0
    np.testing.assert_array_equal(pages[0].kind, proof.kind)
    monkeypatch.undo()
    titles = {ax.get_title() for ax in plotting.figure(result, proof=pages[0]).axes}
    assert "proved of the true map" in titles


@pytest.mark.parametrize("drawn", [2], indirect=True)
def test_what_is_no_proof_is_not_drawn(drawn, tmp_path, capsys):
    result, proof = drawn
    result.save(tmp_path / "out")
    proved.add(tmp_path / "out", result, proof)
    arrays = proof.arrays()
    arrays["cell"] = arrays["cell"] + result.partition.size
    from lmdsl.common import arrays as packing

    (tmp_path / "out" / "proof.npz").write_bytes(packing.packed(arrays))
    assert main(["plot", str(tmp_path / "out")]) == 2
    assert "proof.npz" in capsys.readouterr().err
