"""Certificates written to files, and what the script says of them."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

from problems import steps

from lmdsl.results.exports import export_certificate

SCRIPT = Path(__file__).parents[2] / "tools/check_certificate.py"
NOISE = {"w": {"values": [0.1, -0.2, 0.02], "weights": [0.1, 0.2, 0.7]}}


def checked(path):
    """Run the stand-alone script with nothing of the environment; return status and output."""
    done = subprocess.run(
        [sys.executable, "-I", "-S", SCRIPT, path], capture_output=True, text=True, check=False
    )
    assert not done.stderr, done.stderr
    return done.returncode, done.stdout


def exported(result, folder):
    path = folder / "certificate.jsonl"
    export_certificate(result, path)
    return path


def noisy(**more):
    """A map with noise whose weights do not sum to 1 as doubles."""
    system = {"kind": "map", "next": {"x": "0.9*x - 0.25*u + w"}}
    box = {"x": {"low": -2, "high": 2, "cells": 40}}
    data = steps(cost="1 + x**2", system=system, state_box=box, noise=NOISE)
    return {**data, "attractor": {"cells": [[19], [20]]}, "on_exit": "clip", **more}


def fails(said, claim):
    (line,) = [line for line in said.splitlines() if line.startswith(f"claim {claim} ")]
    return "FAILS" in line


def parsed(path):
    """A small reader of DRN files: labels, and per state a list of (name, cost, row)."""
    head, body = path.read_text().split("@model\n")
    keys = [line for line in head.splitlines() if not line.startswith("//")]
    assert keys[0] == "@type: MDP"
    assert keys[1:3] == ["@parameters", ""]
    assert keys[3:5] == ["@reward_models", "cost"]
    states, labels = [], []
    for line in body.splitlines():
        words = line.split()
        if words[0] == "state":
            assert int(words[1]) == len(states)
            assert words[2] == "[0]"
            labels.append(words[3:])
            states.append([])
        elif words[0] == "action":
            assert words[2][0] + words[2][-1] == "[]"
            states[-1].append((words[1], Fraction(words[2][1:-1]), {}))
        else:
            target, colon, probability = words
            assert colon == ":"
            row = states[-1][-1][2]
            assert int(target) > max(row, default=-1), "targets ascend, each once"
            row[int(target)] = Fraction(probability)
    assert keys[5:7] == ["@nr_states", str(len(states))]
    assert keys[7:9] == ["@nr_choices", str(sum(map(len, states)))]
    return labels, states
