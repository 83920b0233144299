"""Measure in a fresh process what one solve takes: its peak, and what was asked for before."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import lmdsl as lm
from lmdsl import memory

asked: list[int] = []
require, fits = memory.require, memory.fits


def noted(estimate, what):
    asked.append(int(estimate))
    return require(estimate, what)


def status(name):
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if name in x)
    return int(line.split()[1]) * 1024


def main():
    data, small, command = json.load(sys.stdin)
    lm.solve(lm.Problem.model_validate(small))  # imports, kernels
    problem = lm.Problem.model_validate(data)
    memory.require = noted
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    before = status("VmRSS")
    found = getattr(lm, command)(problem)
    print(
        json.dumps(
            {
                "asked": max(asked),
                "taken": status("VmHWM") - before,
                "status": getattr(found, "status", ""),
            }
        )
    )


main()
