"""How much memory this process may still use, and the refusal of what needs more.

The least of several limits counts: what is free on the machine, every control group the process is
in (version 1 or 2; systemd's slices and containers are such groups) with all groups around it,
the address space and data of ``ulimit``, and the share of a Slurm job.
"""

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from lmdsl.errors import BadInput

SMALL = 2**24  # number of bytes above which it is asked whether they are there
UNKNOWN = 8 * 2**30  # where the operating system does not say
UNLIMITED = 2**60  # version 1 writes its largest number of pages


_processes = 1  # that work together on this machine, each with a part of what is free


def share(processes: int) -> None:
    """Count with a part of what is free on the machine from here on: so many processes use it."""
    global _processes
    _processes = max(1, processes)


def processes() -> int:
    """Return how many processes work together on this machine."""
    return _processes


class Memory(NamedTuple):
    """Bytes that may still be used, and what says so."""

    bytes: int
    limit: str


def available(root: Path = Path("/"), environ: Mapping[str, str] = os.environ) -> Memory:
    """Return the tightest limit; ``root`` holds ``proc`` and ``sys``, ``environ`` names Slurm."""
    of_all = [_free(root), *_groups(root), *_slurm(root, environ)]
    parts = [Memory(each.bytes // _processes, each.limit) for each in of_all]
    least = min([*parts, *_ulimits(root)])
    return Memory(max(least.bytes, 0), least.limit)


def fits(estimate: float) -> bool:
    """Return whether so many bytes are available."""
    return estimate <= SMALL or estimate <= available().bytes


def require(estimate: float, what: str, remedy: Callable[[], str] = str) -> None:
    """Refuse work whose estimate exceeds the available memory, before any of it is taken.

    ``remedy`` is asked then what else helps than a smaller problem.
    """
    if estimate <= SMALL:
        return
    free = available()
    if estimate > free.bytes:
        other = remedy()
        raise BadInput(
            f"the problem needs about {human(estimate)} of memory ({what}) and {human(free.bytes)} "
            f"are available ({free.limit}); use fewer cells, controls, sample points or noise nodes"
            + f", {other}"
            * bool(other)
        )


def human(count: float) -> str:
    """Return bytes in a readable unit."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} PB"


def _lines(path: Path) -> list[str]:
    with contextlib.suppress(OSError, ValueError):
        return path.read_text().splitlines()
    return []


def _number(path: Path) -> int | None:
    """Return the number in a file; None where there is none, or the word ``max``."""
    with contextlib.suppress(ValueError, IndexError):
        return int(_lines(path)[0])
    return None


def _table(path: Path) -> dict[str, int]:
    """Return the numbers of a file of lines ``name number``, with or without a colon."""
    found = re.findall(r"^(\w+):?\s+(\d+)", "\n".join(_lines(path)), re.MULTILINE)
    return {name: int(number) for name, number in found}


def _free(root: Path) -> Memory:
    free = _table(root / "proc/meminfo").get("MemAvailable")
    if free is not None:
        return Memory(free * 1024, "free memory")
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return Memory(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") * 3 // 4, "memory")
    return Memory(UNKNOWN, "memory not known")


def _groups(root: Path) -> Iterator[Memory]:
    """Yield what the control groups of this process and the groups around them leave."""
    places = {}  # of version 1 (its memory controller) and version 2: what is mounted where
    for line in _lines(root / "proc/self/mountinfo"):
        left, _, right = line.partition(" - ")
        kind, fields = right.split(" "), left.split(" ")
        one = kind[0] == "cgroup" and "memory" in kind[-1].split(",")
        if len(fields) > 4 and (one or kind[0] == "cgroup2"):
            places[one] = fields[3], root / fields[4].lstrip("/")
    for line in _lines(root / "proc/self/cgroup"):
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        one = "memory" in controllers.split(",")
        if (one or number == "0") and one in places:
            top, mount = places[one]
            # A container sees its own group as the top, and may be told a path from outside.
            inside = os.path.relpath(path, top) if path.startswith(top) else "."
            folder = Path(os.path.normpath(mount / inside))
            if not folder.is_relative_to(mount):
                folder = mount
            for group in (folder, *folder.parents):
                yield from _group(
                    group, f"control group {Path('/') / group.relative_to(mount)}", one
                )
                if group == mount:
                    break


def _group(group: Path, name: str, one: bool) -> Iterator[Memory]:
    names = ("memory.limit_in_bytes",) if one else ("memory.max", "memory.high")
    used = _number(group / ("memory.usage_in_bytes" if one else "memory.current")) or 0
    table = _table(group / "memory.stat")
    # Of files that were read, the kernel gives back those not used for some time.
    files = table.get("total_inactive_file" if one else "inactive_file", 0)
    limits = [_number(group / each) for each in names]
    if one:  # of groups that a container cannot see
        limits.append(table.get("hierarchical_memory_limit"))
    for limit in limits:
        if limit is not None and limit < UNLIMITED:
            yield Memory(limit - max(used - files, 0), name)


def _ulimits(root: Path) -> Iterator[Memory]:
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        used = _table(root / "proc/self/status")
        for limit, name, counted in (
            (resource.RLIMIT_AS, "ulimit -v", "VmSize"),
            (resource.RLIMIT_DATA, "ulimit -d", "VmData"),
        ):
            soft, _ = resource.getrlimit(limit)
            if soft != resource.RLIM_INFINITY:
                yield Memory(soft - used.get(counted, 0) * 1024, name)


def _slurm(root: Path, environ: Mapping[str, str]) -> Iterator[Memory]:
    """Yield what a Slurm job leaves, which may be enforced by ending it."""
    used = _table(root / "proc/self/status").get("VmRSS", 0) * 1024
    for per, counts in (
        ("NODE", ()),
        ("CPU", ("SLURM_CPUS_ON_NODE", "SLURM_JOB_CPUS_PER_NODE", "SLURM_CPUS_PER_TASK")),
        ("GPU", ("SLURM_GPUS_ON_NODE",)),
    ):
        found = re.fullmatch(r"(\d+)([KMGT]?)B?", environ.get(f"SLURM_MEM_PER_{per}", ""), re.I)
        if found is None or not int(found[1]):  # 0: all of the node
            continue
        shares = (re.search(r"\d+", environ.get(name, "")) for name in counts)
        count = next((int(share[0]) for share in shares if share), 1)
        unit = 2 ** (10 * (1 + "KMGT".index(found[2].upper() or "M")))
        yield Memory(int(found[1]) * unit * count - used, f"SLURM_MEM_PER_{per}")
