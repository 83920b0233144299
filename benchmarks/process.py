"""What a process knows of itself, and Python code run in a fresh process."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
MARK = "benchmarks-result "


class Failed(Exception):
    """A process crashed, raised or exceeded its limit; the text says which."""


def peak() -> int:
    """Return the peak resident memory of this process in bytes.

    Not ``ru_maxrss`` where it can be avoided: a child inherits its parent's.
    """
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def depend() -> None:
    """Go first where memory runs out, and go with the harness when it is killed (on Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def environment(**more: str) -> dict[str, str]:
    """Return the environment in which a child finds this package, and lmdsl beside it."""
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path, **more}


def ended(code: int) -> str:
    """Say how a process ended."""
    if code == -9:
        return "killed, probably for want of memory"
    return f"died of signal {-code}" if code < 0 else f"exited with status {code}"


def call(
    function: str, *arguments: Any, limit: float = 600, variables: Mapping[str, str] | None = None
) -> Any:
    """Call ``module:name`` in a fresh process and return what it returns, by way of JSON.

    Raises
    ------
    Failed
        With the last line the process wrote, or the limit.
    """
    command = [sys.executable, "-m", "benchmarks.process", function, json.dumps(arguments)]
    try:
        done = subprocess.run(
            command,
            env=environment(**(variables or {})),
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise Failed(f"> {limit:g} s") from None
    for line in reversed(done.stdout.splitlines()):
        if line.startswith(MARK):
            return json.loads(line.removeprefix(MARK))
    last = [line for line in done.stderr.splitlines() if line.strip()]
    raise Failed(last[-1][:300] if last and done.returncode > 0 else ended(done.returncode))


def main() -> None:
    """Run one call."""
    depend()
    module, _, name = sys.argv[1].partition(":")
    result = getattr(importlib.import_module(module), name)(*json.loads(sys.argv[2]))
    print("\n" + MARK + json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
