"""Programs over ranks about models, beside those of ``rank_programs``."""

import numpy as np
from rank_programs import main

import lmdsl as lm
from lmdsl.slabs import compiling
from lmdsl.slabs.digest import of_model


def in_global_numbers(lp):
    """The arrays of an LP, whole or of one rank, targets in global numbers."""
    target = lp.mesh.numbers[lp.rows.target] if lp.mesh else lp.rows.target
    return {
        "cells": lp.cells, "pairs": np.diff(lp.pair_pointer), "control": lp.control,
        "cost": lp.cost, "weight": lp.weight, "lengths": np.diff(lp.rows.pointer),
        "target": target.astype(np.int64), "code": lp.rows.code, "level": lp._algorithm_1[0],
        "first": lp.control[lp._algorithm_1[1]],
    }  # fmt: skip


def joined(ranks, lp):
    """The arrays of all ranks one after the other, in hexadecimal digits."""
    every = ranks.collect(in_global_numbers(lp))
    return {name: np.concatenate([own[name] for own in every]).tobytes().hex() for name in every[0]}


def compile_file(ranks, file):
    """The model of a file over ranks, and its digest."""
    lp = compiling.compiled(ranks, lm.load(file))
    return joined(ranks, lp), of_model(ranks, lp)


if __name__ == "__main__":
    main({"compile_file": compile_file})
