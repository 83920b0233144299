"""How much memory a problem would need, and how much there is."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from lmdsl.errors import BadInput


def available() -> int:
    """Return the bytes this process may still use: free memory, cgroup and address-space limits."""
    limits = [_free()]
    with contextlib.suppress(OSError, ValueError):
        group = Path("/sys/fs/cgroup")
        limit = int((group / "memory.max").read_text())
        limits.append(limit - int((group / "memory.current").read_text()))
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        soft, _ = resource.getrlimit(resource.RLIMIT_AS)
        if soft != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            limits.append(soft - pages * os.sysconf("SC_PAGE_SIZE"))
    return max(min(limits), 0)


def _free() -> int:
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") * 3 // 4
    return 8 * 2**30


def require(estimate: int, what: str) -> None:
    """Refuse work whose estimate exceeds the available memory.

    Raises
    ------
    BadInput
        With the estimate, the limit and the fix.
    """
    free = available()
    if estimate > free:
        raise BadInput(
            f"the problem needs about {human(estimate)} of memory ({what}) and {human(free)} are "
            "available; use fewer cells, controls or sample points"
        )


def human(count: float) -> str:
    """Return bytes in a readable unit."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} PB"
