"""What is said of a problem, in one line."""

from __future__ import annotations

import contextlib
import io
import math

from hypothesis import strategies as st

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.model.discretization import control_count, noise_nodes, sample_points

NOISY = {"w": {"values": [0, 0.25, 1], "weights": [0.5, 0.25, 0.25]}}
SEEDS = st.integers(0, 2**40)


def work(problem):
    """Return how many times compiling evaluates the map, about; infinite where that is large."""
    cells = math.prod(axis.cells for axis in problem.state_box.values())
    with contextlib.suppress(lm.BadInput):
        nodes = noise_nodes(problem)
        count = cells * control_count(problem) * sample_points(problem) * len(nodes.weights)
        substeps = getattr(problem.system, "substeps", 1)
        return count * (1000 if substeps == "auto" else substeps)
    return math.inf


def one_line(error):
    """Assert that a message can be printed on one line."""
    message = str(error)
    assert message
    assert message.isprintable(), ascii(message)
    assert len(message) < 1000


def called(*arguments):
    """Run the command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main([str(a) for a in arguments])
    for text in (out.getvalue(), err.getvalue()):
        assert text.replace("\n", "").isprintable(), ascii(text)
        assert "Traceback" not in text
    return status, out.getvalue(), err.getvalue()
