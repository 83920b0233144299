"""Measure in a fresh process the peak of one call, and what was asked for before it was taken."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import lmdsl as lm
from lmdsl.machine import memory

require, fits = memory.require, memory.fits
data, small, command = json.load(sys.stdin)
held = [0]  # what was held, and asked for beside it


def status(name):
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if name in x)
    return int(line.split()[1]) * 1024


def require_noted(estimate, what, *remedy):
    held.append(status("VmRSS") - before + int(estimate))
    return require(estimate, what, *remedy)


def fits_noted(estimate):
    held.append(status("VmRSS") - before + int(estimate))
    return fits(estimate)


for backend in ("policy-iteration", "highs"):
    lm.solve(lm.Problem.model_validate(small), backend)  # imports, kernels
problem = lm.Problem.model_validate(data)
before = status("VmRSS")
memory.require, memory.fits = require_noted, fits_noted
Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
try:
    found = getattr(lm, command)(problem).__repr__()
except lm.BadInput as error:
    found = str(error)
print(json.dumps({"asked": max(held), "taken": status("VmHWM") - before, "found": found}))
