"""Films of the closed loop: every frame shows where the runs are, and files are whole."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest
from pictures import logistic

import lmdsl as lm
from lmdsl import plotting
from lmdsl.cli import main
from lmdsl.errors import LmdslError, MissingDependency
from lmdsl.plotting import runs
from lmdsl.plotting.pages import animation
from lmdsl.plotting.quantities import view_of

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")


def scene(result, starts, steps=50, axes=None):
    """What animate makes of runs, and their states as they are: NaN after the end."""
    points, last, pieces = runs.closed_loop(result, np.asarray(starts, float), steps, 0)
    reached = (last >= 0) & (result.cell_status[last] == lm.CellStatus.ATTRACTOR)
    running = (last >= 0) & (result.cell_status[last] == lm.CellStatus.STABILIZED)
    lost = ~reached & ~running
    view = view_of(result, axes, None)
    return animation._Scene.of(result, view, points, reached, lost, pieces), points


def places(artists):
    """The places of dots and crosses by colour: running, arrived, lost."""
    dots = [a.get_offsets() for a in artists if a.get_zorder() in (4, 4.5)]
    return dots[0], dots[1], dots[-1]


def test_every_frame_shows_the_states_of_the_loop(solved):
    result = solved("maze")
    starts = [[0.55, 0.1], *runs.starts_of(result, 3, 0)]
    stage, points = scene(result, starts)
    path = result.closed_loop.path(starts[2], 50)
    for k in range(len(points)):
        on, arrived, lost = places(list(stage._moving(k)))
        assert len(on) + len(arrived) + len(lost) == 4
        assert np.allclose(lost, [[0.55, 0.1]])  # it begins in avoid
        shown = np.concatenate([on, arrived])
        assert np.abs(shown - path[min(k, len(path) - 1)]).max(axis=1).min() < 1e-12
    on, arrived, _ = places(list(stage._moving(len(points) - 1)))
    assert len(on) == 0
    assert len(arrived) == 3
    text = next(a for a in stage._moving(len(points) - 1) if hasattr(a, "get_text"))
    assert text.get_text() == f"step {len(points) - 1}: 3 of 4 in A, 1 lost"


def test_runs_without_a_target_only_go_on():
    data = {**logistic(), "attractor": {}, "discount": 0.9}
    stage, _ = scene(lm.solve(lm.Problem.model_validate(data)), [[0.3]], steps=3)
    text = next(a for a in stage._moving(2) if hasattr(a, "get_text"))
    assert text.get_text() == "step 2"


def test_steps_of_an_equation_have_pieces(solved):
    result = solved("lorenz")
    stage, points = scene(result, [[5.0, 5.0, 20.0]], steps=3, axes=("x", "z"))
    assert stage.pieces == runs.PIECES
    path = result.closed_loop.path([5.0, 5.0, 20.0], 3)
    for k, state in enumerate(path):
        on, arrived, _ = places(list(stage._moving(min(k * runs.PIECES, len(points) - 1))))
        assert np.allclose(np.concatenate([on, arrived])[:, :2], state[[0, 2]])


def test_one_dimension_goes_over_the_step(solved):
    stage, points = scene(solved("logistic"), [[0.3], [0.31]])
    path = solved("logistic").closed_loop.path([0.3], 50)[:, 0]
    for k in range(len(points)):
        on, arrived, _ = places(list(stage._moving(k)))
        j = min(k, len(path) - 1)
        shown = np.concatenate([on, arrived])
        assert np.abs(shown - [j, path[j]]).max(axis=1).min() < 1e-12
    assert stage.ax.get_xlabel() == "step"


def test_a_gif_has_a_frame_for_every_state(solved, tmp_path):
    result, starts = solved("maze"), [[0.15, 0.15], [0.3, 1.0]]
    film = plotting.animate(result, tmp_path / "a.gif", starts=starts, fps=10)
    assert (tmp_path / "a.gif").read_bytes() == film.content
    assert list(tmp_path.iterdir()) == [tmp_path / "a.gif"]
    _, points = scene(result, starts)
    assert film.frames == len(points)
    image = Image.open(io.BytesIO(film.content))
    assert image.info["loop"] == 0
    times = []
    for k in range(image.n_frames):  # frames that are alike are one
        image.seek(k)
        times.append(image.info["duration"])
    assert sum(times) == 100 * (film.frames - 1) + 1500
    assert image.convert("RGB").getpixel((0, 0)) == (255, 255, 255)
    film.save(tmp_path / "b.gif")
    assert (tmp_path / "b.gif").read_bytes() == film.content
    assert film._repr_html_().startswith('<img src="data:image/gif;base64,R0lGOD')
    assert repr(film).startswith(f"Film({film.frames} frames, gif")
    with pytest.raises(lm.BadInput, match=r"ends in \.gif"):
        film.save(tmp_path / "b.mp4")


def test_the_same_runs_make_the_same_film(solved):
    result = solved("logistic")
    first, second = (plotting.animate(result, starts=1, seed=5) for _ in range(2))
    assert first.content == second.content


def test_long_runs_leave_states_out(solved, monkeypatch):
    monkeypatch.setattr(animation, "MOST", 4)
    film = plotting.animate(solved("lorenz"), starts=[[5.0, 5.0, 20.0]], steps=3, axes=["x", "y"])
    assert film.frames <= 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"path": "a.avi"}, "a film ends in .gif or .mp4"),
        ({"path": "a"}, "a film ends in .gif or .mp4"),
        ({"path": "missing/a.gif"}, "missing"),
        ({"fps": 0}, "fps"),
        ({"fps": 1000}, "fps"),
        ({"steps": 0}, "steps"),
        ({"starts": [0.1]}, "starts"),
        ({"axes": ["w"]}, "'w' is not an axis"),
        ({"project": "best"}, "worst or mean"),
    ],
)
def test_what_cannot_be_filmed_is_refused(solved, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(lm.BadInput, match=message):
        plotting.animate(solved("logistic"), **{"starts": 1, **options})
    assert list(tmp_path.iterdir()) == []


def test_without_a_controller_nothing_moves(solved):
    with pytest.raises(lm.BadInput, match="no controller"):
        plotting.animate(solved("refused"))


def fake(tmp_path, script):
    """A program that stands for ffmpeg."""
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "ffmpeg"
    program.write_text(f"#!/bin/sh\nfor last; do :; done\n{script}\n")
    program.chmod(0o755)
    return str(tmp_path / "bin")


def test_ffmpeg_gets_every_frame(solved, tmp_path, monkeypatch):
    kept = tmp_path / "arguments"
    monkeypatch.setenv("PATH", f"{fake(tmp_path, f'echo $@ > {kept}; cat > $last')}:/usr/bin:/bin")
    path = tmp_path / "a.mp4"
    film = plotting.animate(solved("logistic"), path, starts=2, fps=4)
    size = kept.read_text().split(" -s ")[1].split()[0]
    width, height = map(int, size.split("x"))
    assert width % 2 == height % 2 == 0
    assert len(path.read_bytes()) == 3 * width * height * (film.frames + 6)
    assert film._repr_html_().startswith("<video ")


def test_ffmpeg_that_fails_leaves_nothing(solved, tmp_path, monkeypatch):
    folder = fake(tmp_path, "cat > /dev/null; echo no codec >&2; exit 1")
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
    with pytest.raises(LmdslError, match="ffmpeg wrote no film: no codec; write a"):
        plotting.animate(solved("logistic"), tmp_path / "a.mp4", starts=1)
    assert not (tmp_path / "a.mp4").exists()


def test_without_ffmpeg_the_fix_is_named(solved, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingDependency, match="needs ffmpeg: install it"):
        plotting.animate(solved("logistic"), tmp_path / "a.mp4")


def test_the_command_line_makes_films(solved, tmp_path, capsys):
    solved("logistic").save(tmp_path / "out")
    assert main(["plot", str(tmp_path / "out"), "--out", str(tmp_path / "a.gif")]) == 0
    assert (tmp_path / "a.gif").read_bytes().startswith(b"GIF89a")
    wrong = [
        "plot",
        str(tmp_path / "out"),
        "--draw",
        "projections",
        "--out",
        str(tmp_path / "b.gif"),
    ]
    assert main(wrong) == 2
    assert "a plot ends in .png" in capsys.readouterr().err
