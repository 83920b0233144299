"""Shared by the tests of results."""

from __future__ import annotations

import interrupted_saves
import pytest


@pytest.fixture(scope="module")
def results():
    return interrupted_saves.solved()
