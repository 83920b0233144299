"""The page in headless Chromium: everything is drawn, answers, and nothing gets out."""

from __future__ import annotations

import re

import numpy as np
import pytest
from browsers import asked, browser, chromium, dom
from problems import made, steps

import lmdsl as lm

pytestmark = [browser, pytest.mark.long]

ACT = "document.title='gone'"
EVIL = f'</script><script>{ACT}</script><img src=x onerror="{ACT}">'


@pytest.fixture(scope="module")
def pages(solved, tmp_path_factory):
    """Pages by name, each written when first asked for."""
    folder = tmp_path_factory.mktemp("pages")

    def of(name):
        path = folder / f"{name}.html"
        if not path.exists():
            solved(name).report(path)
        return path

    return of


def test_everything_is_drawn_and_nothing_is_complained_of(pages):
    """Of two and three dimensions, with the policy in force: a script that broke would say so."""
    for name in ("maze", "lorenz"):
        log = chromium(pages(name), "--dump-dom", "--enable-logging=stderr")
        assert 'data-ready="yes"' in log
        assert ":CONSOLE" not in log
        drawn = set(re.findall(r'<div id="(\w+)"[^>]*class="plot[^"]*js-plotly-plot', log))
        assert drawn == {"map", "time", "spectrum", "decay"}


def test_the_run_that_an_address_names_is_that_of_the_compiled_steps(pages, solved):
    result = solved("standard")
    cell = int(np.argmax(np.where(result.cell_status == 1, result.value, 0)))
    x, y = (float(v) for v in result.partition.centres(np.array([cell]))[0])
    path = result.closed_loop.path([x, y], 50, as_compiled=True)
    assert len(path) > 3
    text = re.sub(r"<[^>]+>", " ", dom(pages("standard"), f"#start={x!r},{y!r}"))
    assert f"reached A after {len(path) - 1} steps" in text


def test_a_cell_answers(pages, solved):
    """Point at a cell, click it: value, control, where samples go, and a run."""
    result = solved("maze")
    cell = int(np.flatnonzero(result.cell_status == 1)[7])
    x, y = result.partition.centres(np.array([cell]))[0]
    said = asked(
        pages("maze"),
        f"""const map = document.getElementById("map");
        const area = map.querySelector(".nsewdrag").getBoundingClientRect();
        const clientX = area.left + area.width * {x};
        const clientY = area.bottom - area.height * {y / 1.2};
        const at = {{ points: [{{ x: {x}, y: {y} }}], event: {{ clientX, clientY }} }};
        map.emit("plotly_hover", at);
        const cell = document.getElementById("cell").textContent;
        const marks = document.querySelectorAll(".over .diamond").length;
        map.emit("plotly_click", at);
        await wait(300);
        const run = document.getElementById("run").textContent;
        for (const key of ["ArrowRight", "ArrowDown"]) {{
          map.dispatchEvent(new KeyboardEvent("keydown", {{ key }}));
        }}
        return {{ cell, marks, run, next: document.getElementById("cell").textContent }};""",
    )
    index = ", ".join(str(i) for i in np.unravel_index(cell, result.partition.shape))
    assert f"[{index}]" in said["cell"]
    assert f"cost-to-go V{result.value[cell]:.6g}" in said["cell"]
    assert "goes to" in said["cell"]
    assert said["marks"] == 4
    assert "reached A" in said["run"]
    i, j = np.unravel_index(cell, result.partition.shape)
    assert f"[{min(i + 1, 9)}, {max(j - 1, 0)}]" in said["next"]


def test_sliders_move_the_slice(pages, solved):
    result = solved("lorenz")
    said = asked(
        pages("lorenz"),
        """const range = document.querySelector("#controls input[type=range]");
        const z = () => {
          const maps = document.getElementById("map").data.filter((t) => t.type === "heatmap");
          return [range.value, maps[0].z.map((row) => Array.from(row))];
        };
        const before = z();
        range.value = 1;
        range.dispatchEvent(new Event("input"));
        await wait(300);
        return [before, z()];""",
    )
    status = result.cell_status.reshape(result.partition.shape)
    for at, codes in said:
        drawn = np.array(codes).T  # 0 where stabilized
        assert np.array_equal(drawn == 0, status[:, :, int(at)] == 1)


def test_the_other_axes_are_put_together(pages, solved):
    """The largest and the mean over z, of the cost where there is any; regions likewise."""
    result = solved("lorenz")
    said = asked(
        pages("lorenz"),
        """const others = [...document.querySelectorAll("#controls select")].pop(), found = [];
        for (const k of [1, 2]) {
          others.value = k;
          others.dispatchEvent(new Event("change"));
          await wait(300);
          found.push(document.getElementById("map").data.filter((t) => t.type === "heatmap")
            .map((t) => t.z.map((row) => Array.from(row))));
        }
        return found;""",
    )
    shape = result.partition.shape
    on = (result.cell_status == 1).reshape(shape)
    value = np.where(on, result.value.reshape(shape), np.nan)
    some = on.any(axis=2)
    for (codes, drawn), put in zip(said, (np.nanmax, np.nanmean), strict=True):
        assert np.array_equal(np.array(codes).T == 0, some)
        found = np.array(drawn, dtype=float).T
        assert np.array_equal(np.isfinite(found), some)
        wanted = [put(x[np.isfinite(x)]) for x in value[some]]
        assert np.allclose(found[some], wanted, rtol=1e-5)


def test_lines_over_time_go_over_the_seam_from_edge_to_edge(pages):
    """Of runs on a torus, until one is met that goes over the seam: no spike is left."""
    lines = asked(
        pages("standard"),
        """const button = [...document.querySelectorAll("#controls button")][0];
        for (let n = 0; n < 30; n++) {
          button.click();
          await wait(100);
          const lines = document.getElementById("time").data.filter((t) =>
            t.mode === "lines" && t.yaxis !== "y2").map((t) => Array.from(t.y));
          if (lines.some((y) => y.includes(null))) return lines;
        }""",
    )
    assert any(None in y for y in lines)
    for y in lines:
        for a, b, c in zip(y, y[1:], y[2:], strict=False):
            if b is None:
                assert sorted((a, c)) == [0, 1]
            elif a is not None:
                assert abs(a - b) <= 0.5


def test_names_do_nothing_in_a_browser(tmp_path):
    problem = made(steps()).replaced(name=EVIL)
    lm.solve(problem).report(tmp_path / "a.html")
    text = dom(tmp_path / "a.html")
    assert "<title>gone</title>" not in text
    assert "<img" not in text
    assert 'data-ready="yes"' in text


def test_the_policy_lets_no_other_script_run(tmp_path, pages):
    """A script that gets into the page after all is not run; without the policy it would be."""
    page, ours = tmp_path / "a.html", pages("steps").read_text()
    whole = ours.replace("</body>", "<script>document.title = 'gone'</script></body>")
    page.write_text(whole)
    refused = chromium(page, "--dump-dom", "--enable-logging=stderr")
    assert "<title>gone</title>" not in refused
    assert "violates the following Content Security Policy" in refused
    page.write_text(re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", whole))
    assert "<title>gone</title>" in dom(page)


def test_a_large_page_stays_small(tmp_path):
    """A million cells on two axes."""
    box = {"x": {"low": 0, "high": 1, "cells": 4}, "y": {"low": 0, "high": 1, "cells": 250_000}}
    data = steps(system={"kind": "map", "next": {"x": "x - 0.25*u", "y": "y"}}, state_box=box,
                 attractor={"boxes": [{"x": [0, 0.25]}]})  # fmt: skip
    page = tmp_path / "a.html"
    lm.solve(made(data)).report(page)
    assert page.stat().st_size < 12e6
    assert 'data-ready="yes"' in dom(page)


def test_what_is_printed_is_a_page(pages, tmp_path):
    out = tmp_path / "a.pdf"
    chromium(pages("maze"), f"--print-to-pdf={out}")
    content = out.read_bytes()
    assert content.startswith(b"%PDF-")
    assert len(content) > 50_000
    assert len(re.findall(rb"/Type\s*/Page\b", content)) > 1
