"""What the swing-up takes over ranks: told by hand, and measured where an MPI is."""

import argparse
import math

import pytest
from launching import needs_mpi

from benchmarks import cart_pole


def found(cells, taken):
    """What two ranks report that take so much."""
    rank = {"wall": taken, "cpu": taken, "peak": 1e6 * taken, "calls": 7, "sent": 30, "own": 10,
            "ghosts": 2}  # fmt: skip
    return {"cells": cells, "status": "verified", "gap": 1e-12, "pairs": 1234, "coverage": 0.8,
            "seconds": {"compile": 1, "solve": 2}, "runs": {"starts": 1000, "reached": 992},
            "ranks": [rank, {**rank, "ghosts": 4}]}  # fmt: skip


def test_a_row_by_hand():
    row = dict(zip(cart_pole.COLUMNS, cart_pole.row(found((10, 10, 10, 10), 5)), strict=True))
    assert row == {
        "cells": "10x10x10x10", "pairs": "1,234", "C": "80.0%", "arrive": "99.20%", "gap": "1e-12",
        "ghosts / own": "0.40", "MB a rank": "5", "B a cell": "1000", "compile s": "1.0",
        "solve s": "2.0", "all s": "5.0", "CPU s": "10.0", "calls": "7", "B sent a cell": "3",
    }  # fmt: skip


def test_what_grows_in_proportion_to_cells_is_foretold():
    shapes = [(8, 8, 8, 8), (16, 8, 8, 8), (16, 16, 16, 8)]
    rows = [found(cells, 1 + math.prod(cells) / 1e4) for cells in shapes]
    text = cart_pole.predicted(rows, (100, 100, 100, 100))
    assert text == (
        "100x100x100x100 (100,000,000 cells): about 10.0 GB beside imports on each of 2 ranks, "
        "10001 s"
    )
    assert cart_pole.at([100], [5.0], 300) == 15


@pytest.mark.parametrize("text", ["8x8x8", "0x8x8x8", "8x8x8x8x8"])
def test_other_shapes_are_refused(text):
    with pytest.raises(argparse.ArgumentTypeError):
        cart_pole.shape(text)


@pytest.mark.long
@pytest.mark.full
@needs_mpi
def test_two_ranks_tell_what_they_took(tmp_path):
    told = cart_pole.solved((8, 16, 16, 16), 2, tmp_path / "out", 300)
    assert told["status"] == "verified"
    assert told["coverage"] > 0.8
    assert told["runs"]["reached"] > 0.98 * told["runs"]["starts"]
    assert all(rank["ghosts"] < rank["own"] for rank in told["ranks"])
    assert (tmp_path / "out/certificate.json").exists()
