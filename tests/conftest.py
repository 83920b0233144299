"""Shared by all tests."""

import os
import signal
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "helpers"))

# Many tests start processes, which need not parse all of lmdsl each time.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A shell starts what runs in its background with Ctrl-C ignored, and so would the commands that
# tests interrupt; a handler is not inherited.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_xdist_auto_num_workers(config):
    """Share the whole suite between up to four processes; a few files are run in one."""
    whole = list(config.args) == list(config.getini("testpaths"))
    return min(os.cpu_count() or 1, 4) if whole else 0
