"""Shared by the tests of machine."""

from __future__ import annotations

import json
import os

import pytest
from noisy_backend import NOISY, ROOT
from problems import steps


@pytest.fixture
def noisy(tmp_path):
    """The environment of a process in which a noisy backend is installed."""
    (tmp_path / "noisy.py").write_text(NOISY)
    info = tmp_path / "noisy-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: noisy\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[lmdsl.backends]\nnoisy = noisy:BACKEND\n")
    (tmp_path / "problem.json").write_text(json.dumps(steps()))
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    return {**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": ""}
