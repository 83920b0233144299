"""Shared by the tests of cli."""

from __future__ import annotations

import json

import pytest


@pytest.fixture
def file(tmp_path):
    def write(data, name="problem.json"):
        path = tmp_path / name
        path.write_text(json.dumps(data))
        return str(path)

    return write
