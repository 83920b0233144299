"""Programs over ranks about models, beside those of ``rank_programs``."""

import numpy as np
from rank_programs import main

import lmdsl as lm
from lmdsl.slabs import compiling, solving
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


def answer(ranks, problem, gathered=10**6):
    """The answer of a problem over ranks, as plain data; None where no first policy is found."""
    lp = compiling.compiled(ranks, problem)
    found = solving.solved(lp, gathered=gathered)
    if found is None:
        return None
    witness = found.witness
    if witness.policy is None:
        return {"certificate": found.certificate.to_dict(),
                "refusal": joined_array(ranks.collect(witness.refusal))}  # fmt: skip
    every = ranks.collect((lp.cells, lp.control[witness.policy], *vectors(witness)))
    names = ("cells", "control", "w", "V_up", "W", "mu")
    return {
        **{name: joined_array([own[k] for own in every]) for k, name in enumerate(names)},
        "certificate": found.certificate.to_dict(),
        "steps": found.steps,
    }


def vectors(witness):
    """The vectors of a witness."""
    return witness.w, witness.V_up, witness.W, witness.mu


def joined_array(parts):
    """A vector of all ranks, None where it is missing."""
    return None if any(part is None for part in parts) else np.concatenate(parts).tolist()


def solve_file(ranks, file, gathered=str(10**6)):
    """The answer of a file over ranks."""
    return answer(ranks, lm.load(file), int(gathered))


if __name__ == "__main__":
    main({"compile_file": compile_file, "solve_file": solve_file})
