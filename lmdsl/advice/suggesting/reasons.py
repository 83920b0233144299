"""Why something is suggested: what became of trials that differ in one thing."""

from collections.abc import Callable
from typing import Any

from lmdsl.advice.suggesting.pilots import Attempt, sampling_words
from lmdsl.problem.problem import Problem

SURE = 0.9  # share that arrives from which on a trial is told where the best one has less
TOLD = 3  # neighbours that are told
WORDS: dict[str, Callable[[Attempt], str]] = {
    "step": lambda p: f"a step of {p.step:.3g}",
    "cells": lambda p: f"cells {'x'.join(map(str, p.cells.values()))}",
    "sampling": lambda p: sampling_words(p.sampling),
}


def reasons(problem: Problem, pilots: list[Attempt], best: Attempt, changed: Problem) -> list[str]:
    """Return sentences: how trials are judged, what becomes of neighbours, and what to mind."""
    found = [
        "trials are judged by the share of the box that is stabilizable times the fourth power of "
        "the share of its runs on the true map that arrive"
    ]
    for name in WORDS:
        found += _neighbours(name, pilots, best)
    surer = [p for p in pilots if p.arrives is not None and p.arrives >= SURE and p.coverage]
    if surer and (best.arrives or 0.0) < SURE:
        widest = max(surer, key=lambda p: p.coverage or 0.0)
        found.append(f"surer, of the trials: {widest}")
    longer = getattr(problem.system, "step", None) != getattr(changed.system, "step", None)
    if longer and problem.cost_rate is None:
        found.append(
            "stage_cost is paid in each step: with another step it is another cost; a cost_rate "
            "is not"
        )
    if problem.measure is not None and changed.measure is None:
        found.append("measure.weights, one for each cell, were left out: write them anew")
    return found


def _neighbours(name: str, pilots: list[Attempt], best: Attempt) -> list[str]:
    """Return what becomes where one thing is another one; all else as in the best trial.

    Where no such trial was made, beside the best trial that has this one thing as well.
    """

    def rest(pilot: Attempt) -> list[Any]:
        return [getattr(pilot, other) for other in WORDS if other != name]

    wanted = getattr(best, name)
    alike = [p for p in pilots if getattr(p, name) == wanted]
    for pilot in sorted(alike, key=lambda p: (p is not best, -p.score)):
        others = [p for p in pilots if getattr(p, name) != wanted and rest(p) == rest(pilot)]
        if others:
            others.sort(key=lambda p: -p.score)
            told = "; ".join(f"{WORDS[name](p)}: {_became(p)}" for p in others[:TOLD])
            where = "" if pilot is best else f" with {_others(pilot, name)}"
            return [f"{WORDS[name](pilot)}{where} ({_became(pilot)}), all else the same: {told}"]
    return []


def _others(pilot: Attempt, name: str) -> str:
    own = [key for key in WORDS if key != name and getattr(pilot, key) is not None]
    return ", ".join(WORDS[key](pilot) for key in own)


def _became(pilot: Attempt) -> str:
    if pilot.coverage is None or pilot.arrives is None:
        return "nothing can be stabilized" if pilot.coverage is not None else "no such problem"
    return f"coverage {100 * pilot.coverage:.3g} %, {100 * pilot.arrives:.3g} % arrive"
