"""Slices and projections of three and four dimensions: what every panel shows, and what not."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from pictures import patches

import lmdsl as lm
from lmdsl import plotting
from lmdsl.cli import main
from lmdsl.model.grid.partition import Partition
from lmdsl.plotting.view import View

pytest.importorskip("matplotlib")

ATTRACTOR, STABILIZED, AVOID = (
    lm.CellStatus.ATTRACTOR,
    lm.CellStatus.STABILIZED,
    lm.CellStatus.AVOID,
)


def panels(page):
    """The axes of a page that show states, its colour bar left out."""
    return [ax for ax in page.axes if ax.get_label() != "<colorbar>"]


def image(ax):
    """What axes show over the cells, in the order of the axes."""
    return np.ma.filled(ax.images[0].get_array(), np.nan).T if ax.images else np.nan


def over(result, flat, axes, held):
    """All values over the cells shown by brute force: (..., R)."""
    p = result.partition
    grid = np.asarray(flat).reshape(p.shape)
    for name, index in held.items():
        grid = np.take(grid, [index], axis=p.names.index(name))
    kept = [p.names.index(name) for name in axes]
    moved = np.moveaxis(grid, kept, range(len(kept)))
    return moved.reshape(*moved.shape[: len(kept)], -1)


def known(result):
    return np.where(result.cell_status == STABILIZED, result.value, np.nan)


@pytest.mark.parametrize("axes", [("x", "theta"), ("omega", "x"), ("v",)])
def test_projections_are_the_worst_or_the_mean_of_what_lies_over_a_cell(solved, axes):
    result = solved("cart")
    values = known(result)
    for held in ({}, {"theta": 3}) if "theta" not in axes else ({}, {"omega": 2}):
        at = {k: result.partition.centres(np.zeros(1, int))[0][result.partition.names.index(k)]
              + i * result.partition.width[result.partition.names.index(k)]
              for k, i in held.items()}  # fmt: skip
        each = over(result, values, axes, held)
        count = np.isfinite(each).sum(axis=-1)
        assert (count > 1).any()
        worst = np.where(count, np.nan_to_num(each, nan=-1).max(axis=-1), np.nan)
        mean = np.nansum(each, axis=-1) / np.where(count, count, np.nan)
        for project, expected in (("worst", worst), ("mean", mean)):
            ax = plotting.cost(result, axes=axes, at=at, project=project)
            if len(axes) == 1:
                (line,) = [q for q in ax.patches if type(q).__name__ == "StepPatch"]
                shown = line.get_data().values
            else:
                shown = image(ax)
            assert np.allclose(shown, expected, equal_nan=True)
            assert f"{project} over " in ax.get_title()


def test_the_worst_control_is_the_largest_in_magnitude(solved):
    result = solved("cart")
    index = result.control_index
    u = np.where(index >= 0, result.control_vectors[index, 0], np.nan)
    each = over(result, u, ("x", "theta"), {})
    size = np.nan_to_num(np.abs(each), nan=-1)
    shown = image(plotting.control(result, axes=("x", "theta"), project="worst"))
    there = np.isfinite(shown)
    assert np.array_equal(there, (size >= 0).any(axis=-1))
    assert np.array_equal(np.abs(shown[there]), size.max(axis=-1)[there])
    assert (shown[there] < 0).any()


def test_regions_of_a_projection():
    """One cell of each kind over each cell shown, in every combination."""
    kinds = list(itertools.product((0, 1, 2, 3, 5), repeat=3))
    data = {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "x", "y": "y", "z": "z"}},
        "state_box": {
            "x": {"low": 0, "high": 1, "cells": len(kinds)},
            "y": {"low": 0, "high": 1, "cells": 1},
            "z": {"low": 0, "high": 1, "cells": 3},
        },
        "attractor": {"cells": [[0, 0, 0]]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
    }
    partition = Partition.of(lm.Problem.model_validate(data))
    flat = np.array(kinds, dtype=np.uint8).ravel()
    view = View.of(partition, flat == 0, ("x", "y"), project="worst")
    for kind, code in zip(kinds, view.codes(flat)[:, 0], strict=True):
        counts = {k: kind.count(k) for k in kind if k != 5}
        if 1 in kind:
            assert code == 1
        elif not counts:
            assert code == 5
        else:
            assert counts[code] == max(counts.values())
    assert np.array_equal(view.shadow(flat == 5)[:, 0], [5 in kind for kind in kinds])
    assert np.array_equal(view.core(flat == 5)[:, 0], [set(kind) == {5} for kind in kinds])


def test_slices_share_their_colours_and_one_meets_the_attractor(solved):
    result = solved("lorenz")
    p = result.partition
    page = plotting.slices(result)
    shown = panels(page)
    assert len(shown) == 6 == len({ax.get_title() for ax in shown})
    norms = {(ax.images[0].norm.vmin, ax.images[0].norm.vmax) for ax in shown if ax.images}
    assert len(norms) == 1
    values = known(result)
    for ax, k in zip(shown, range(6), strict=True):
        expected = over(result, values, ("x", "y"), {"z": k})[..., 0]
        assert np.allclose(image(ax), expected, equal_nan=True)
        assert ax.get_title() == f"z ≈ {p.low[2] + (k + 0.5) * p.width[2]:.3g}"
    assert sum("attractor" in patches(ax) for ax in shown) == 1
    assert len(page.legends) == 1


def test_slices_through_two_axes_make_a_table(solved):
    result = solved("cart")
    page = plotting.slices(result, "measure", axes=("theta", "omega"), panels=3)
    shown = panels(page)
    assert len(shown) == 9
    assert any("attractor" in patches(ax) for ax in shown)
    titles = [ax.get_title().split(", ") for ax in shown]
    assert len({x for x, _ in titles}) == 3 == len({v for _, v in titles})
    assert "slices along x and v" in page.get_suptitle()


def test_slices_of_one_axis_have_the_same_ordinate(solved):
    page = plotting.slices(solved("lorenz"), axes=["z"], panels=3)
    shown = panels(page)
    assert len(shown) == 9
    assert len({(*ax.get_ylim(), ax.get_yscale()) for ax in shown}) == 1
    low, high = shown[0].get_ylim()
    heights = [
        patch.get_data().values
        for ax in shown
        for patch in ax.patches
        if type(patch).__name__ == "StepPatch"
    ]
    assert heights
    assert low <= np.nanmin(heights)
    assert high >= np.nanmax(heights)


def test_slices_are_where_they_are_asked_for(solved):
    result = solved("cart")
    page = plotting.slices(
        result, "control", "u", axes=["x", "v"], at={"theta": [0.3, 0], "omega": 1}
    )
    assert [ax.get_title() for ax in panels(page)] == [
        "theta ≈ 0.286, omega ≈ 1.14", "theta ≈ 0, omega ≈ 1.14",
    ]  # fmt: skip
    index = over(result, result.control_index, ("x", "v"), {"theta": 5, "omega": 5})[..., 0]
    u = np.where(index >= 0, result.control_vectors[index, 0], np.nan)
    assert np.allclose(image(panels(page)[0]), u, equal_nan=True)


def test_projections_show_every_pair_of_axes(solved):
    result = solved("cart")
    page = plotting.projections(result, project="mean")
    shown = panels(page)
    names = [(ax.get_xlabel(), ax.get_ylabel()) for ax in shown]
    assert names == list(itertools.combinations(result.partition.names, 2))
    for ax, axes in zip(shown, names, strict=True):
        each = over(result, known(result), axes, {})
        count = np.isfinite(each).sum(axis=-1)
        expected = np.nansum(each, axis=-1) / np.where(count, count, np.nan)
        assert np.allclose(image(ax), expected, equal_nan=True)
    assert len(panels(plotting.projections(result, at={"v": 0.1}))) == 3
    assert len(panels(plotting.projections(solved("maze")))) == 1


def test_coverage_is_the_share_of_what_is_free(solved):
    result = solved("cart")
    status = result.cell_status
    each = over(result, status, ("theta", "omega"), {})
    free = ((each != ATTRACTOR) & (each != AVOID)).sum(axis=-1)
    share = (each == STABILIZED).sum(axis=-1) / np.where(free, free, np.nan)
    ax = plotting.coverage(result, axes=("theta", "omega"))
    assert np.allclose(image(ax), share, equal_nan=True)
    assert set(patches(ax)) <= {"avoid", "attractor"}
    covered = result.coverage
    total = np.nansum(np.where(free, share, 0) * free) / free.sum()
    assert total == pytest.approx(covered.share)


def test_obstacles_are_drawn_in_every_panel(solved):
    """The first column of x is a wall whatever the rest is, the other wall for large angles."""
    result = solved("cart")
    p = result.partition
    for page in (plotting.slices(result, panels=2), plotting.projections(result)):
        for ax in panels(page):
            if ax.get_xlabel() != "x":  # inner panels of slices have no labels
                continue
            wall = patches(ax)["avoid"].get_path()
            x, y = p.low[0] + p.width[0] / 2, np.mean(ax.get_ylim())
            assert wall.contains_point((x, y))
    for draw in (plotting.trajectories, plotting.portrait):
        ax = draw(result)
        assert {"avoid", "attractor"} <= set(patches(ax))
        corner = p.low[0] + 7.5 * p.width[0], 0.45
        assert patches(ax)["avoid"].get_path().contains_point(corner)
        assert not patches(ax)["avoid"].get_path().contains_point((0.0, 0.0))
    legend = plotting.trajectories(result, axes=("x", "v"), legend=True).get_legend()
    assert "avoid, in part" in [t.get_text() for t in legend.get_texts()]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: plotting.slices(r, axes=("x", "w")), "'w' is not an axis"),
        (lambda r: plotting.slices(r, at={"w": [1]}), "'w' is not an axis"),
        (lambda r: plotting.slices(r, at={"v": [9]}), "outside the state box"),
        (lambda r: plotting.slices(r, at={"v": []}), "outside the state box"),
        (lambda r: plotting.slices(r, at={"x": [0, 1]}), "not shown"),
        (lambda r: plotting.slices(r, at={"v": 0, "omega": 0}), "none to cut along"),
        (lambda r: plotting.slices(r, at={"v": [0] * 9, "omega": [0] * 9}), "81 panels"),
        (lambda r: plotting.slices(r, panels=0), "panels"),
        (lambda r: plotting.slices(r, "costs"), "known: cost, control, measure, coverage"),
        (lambda r: plotting.slices(r, "control", "w"), "'w' is no control"),
        (lambda r: plotting.slices(r, path="a.gif"), "png"),
        (lambda r: plotting.projections(r, project="best"), "worst or mean"),
        (lambda r: plotting.projections(r, at={"x": [0, 1]}), "held at one place"),
        (lambda r: plotting.cost(r, project=True), "worst or mean"),
        (lambda r: plotting.cost(r, at={"v": [0, 1]}), "held at one place"),
        (lambda r: plotting.slices("result"), "result"),
    ],
)
def test_what_cannot_be_shown_is_refused(solved, call, message):
    with pytest.raises(lm.BadInput, match=message):
        call(solved("cart"))


def test_the_command_line_cuts_and_projects(solved, tmp_path, capsys):
    out = str(tmp_path / "out")
    solved("cart").save(out)
    for name, options in {
        "a.png": ["--axes", "theta", "--at", "x=0,v=0.5", "--project", "mean"],
        "b.svg": ["--draw", "slices", "--at", "v=0,1,omega=0", "--quantity", "control"],
        "c.pdf": ["--draw", "projections", "--quantity", "coverage", "--at", "omega=0,v=0"],
    }.items():
        assert main(["plot", out, *options, "--out", str(tmp_path / name)]) == 0
        assert (tmp_path / name).stat().st_size > 1000
    capsys.readouterr()
    for options, message in (
        (["--at", "v"], "--at: 'v': write axis=number, such as z=1,v=0.5"),
        (["--at", "v=0,v=1"], "--at: 'v=0,v=1'"),
        (["--at", "v=nan"], "--at: 'v=nan'"),
        (["--at", "v=0,1"], "v is held at one place"),
        (["--axes", "x,w"], "'w' is not an axis"),
        (["--draw", "projections", "--axes", "x,v"], "--axes: projections"),
    ):
        assert main(["plot", out, *options]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out" / "figures.png").exists()
