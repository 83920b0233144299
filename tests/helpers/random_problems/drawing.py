"""The generator."""

import math

import numpy as np
from reference import (
    attractor_cells,
    avoid_cells,
    compile_reference,
    control_vectors,
    measure_cells,
    noise_nodes,
    read_axes,
    sample_offsets,
)

from random_problems import parts
from random_problems.families import FAMILIES, Problem

EVALUATIONS = 4_000  # samples of one problem, about; an ODE step counts several times
STATE_NAMES = [("x", "y", "z"), ("q", "p", "angle"), ("x2", "x1", "x_3")]
CONTROL_NAMES = [("u", "v"), ("force", "a_1")]


def random_problem(rng: np.random.Generator) -> Problem:
    """Draw a small valid problem."""
    while True:
        problem = attempt(rng)
        try:
            compile_reference(problem)  # refuses a cost that is negative or not finite
        except ValueError:
            continue
        return problem


def attempt(rng: np.random.Generator) -> Problem:
    states = STATE_NAMES[int(rng.choice(3, p=[0.6, 0.2, 0.2]))]
    all_controls = CONTROL_NAMES[int(rng.choice(2, p=[0.8, 0.2]))]
    controls = list(all_controls[: int(rng.choice(3, p=[0.12, 0.6, 0.28]))])
    noise_names = ["w", "gust"][: int(rng.choice(3, p=[0.6, 0.3, 0.1]))]
    terms = [*controls, "0", "0"][:2]
    if len(controls) == 1 and rng.random() < 0.7:
        terms[1] = controls[0]
    shape = f"*(1 + {states[0]}/3)" if rng.random() < 0.3 else ""
    noise_term = "".join(f" + {n}{shape}" for n in noise_names)

    family = FAMILIES[int(rng.integers(len(FAMILIES)))]
    system, box, point, size = family(rng, states, terms, noise_term)
    if noise_names and noise_term not in str(system):  # a system that shows no noise has none
        noise_names = []

    d = len(box)
    expense = 4 * system.get("substeps", 1) if system["kind"] == "ode" else 1
    for axis in box.values():
        axis["cells"] = int(rng.integers(*[(1, 41), (2, 13), (2, 6)][d - 1]))
    problem: Problem = {
        "format": "lmdsl/1",
        "name": f"random {family.__name__[1:]}",
        "system": system,
        "state_box": box,
        "attractor": {},
        "control_grid": parts.controls(rng, controls, size),
        "stage_cost": parts.cost(rng, list(box), controls, noise_names, point),
    }
    if noise_names:
        problem["noise"] = parts.noise(rng, noise_names)
    nodes = len(noise_nodes(problem))
    pairs = len(control_vectors(problem)) * math.prod(a["cells"] for a in box.values())
    most = min(20 // nodes, max(1, EVALUATIONS // (pairs * nodes * expense)))
    problem["sampling"] = parts.sampling(rng, list(box), max(1, most))
    problem["attractor"] = parts.attractor(rng, problem, point)

    if rng.random() < 0.35:
        problem["on_exit"] = str(rng.choice(["clip", "clip", "forbid"]))
    if rng.random() < 0.25:
        problem["avoid"] = {"boxes": parts.boxes(rng, problem, 0.2)}
        if avoid_cells(problem) & attractor_cells(problem):
            del problem["avoid"]
    if rng.random() < 0.25:
        problem["measure"] = {"boxes": parts.boxes(rng, problem, 0.6)}
        if not measure_cells(problem):
            del problem["measure"]
    if system["kind"] == "ode":
        if rng.random() < 0.3:
            system["judged"] = str(rng.choice(["path", "endpoint", "endpoint"]))
        if rng.random() < 0.3:
            problem["cost_rate"] = problem.pop("stage_cost")
    if rng.random() < 0.2:
        problem["terminal_cost"] = parts.cost(rng, list(box), [], [], point)
    try:
        gamma = parts.gamma(rng, problem)
    except ValueError:  # the cost is not valid: the caller draws again
        gamma = None
    if gamma is not None:
        problem["gamma"] = gamma
    return problem


def describe(problem: Problem) -> str:
    """One line for the message of a failing test."""
    shape = [a.cells for a in read_axes(problem)]
    samples = len(sample_offsets(problem)) * len(noise_nodes(problem))
    return f"{problem.get('name', '')}: cells {shape}, {samples} samples"
