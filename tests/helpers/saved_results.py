"""Results to save, and what a folder holds."""

from __future__ import annotations

import itertools
import os

import pytest

OURS = {"certificate.json", "problem.json", "solution.npz"}
posix = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes and links")


def names(path):
    return {entry.name for entry in path.iterdir()}


def refusing(number, *calls):
    """Return a stand-in for a function of ``os`` that fails, at the given calls or always."""
    count = itertools.count(1)

    def fail(*_, **__):
        if not calls or next(count) in calls:
            raise OSError(number, os.strerror(number))

    return fail
