"""The contest: all contestants on one model at one gamma, by turns, each in its own process."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import select
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.process import ROOT, Failed, call, ended, environment
from benchmarks.rivals import OURS, Contestant

Log = Callable[[str], None]

GRACE = 60.0
"""Seconds to start a process, import its packages and solve the tiny model."""


@dataclass(frozen=True)
class Rules:
    """How a contest is held.

    Attributes
    ----------
    repeats
        Timed solves of each contestant.
    limit
        Seconds after which a contestant is stopped, for building (and GRACE more, to start) and
        for each solve.
    budget
        Seconds of timed solves per contestant: a slow one solves less often.
    spare
        Share of memory that must stay free for a process to be kept between its turns.
    at_once
        Start all processes together: quicker, but they disturb each other's first solve.
    """

    repeats: int = 5
    limit: float = 600.0
    budget: float = 120.0
    spare: float = 0.4
    at_once: bool = False


class Session:
    """A contestant's process."""

    def __init__(self, one: Contestant, folder: Path, limit: float) -> None:
        self.limit = limit
        self.log = tempfile.TemporaryFile()  # noqa: SIM115
        command = [sys.executable, "-m", "benchmarks.worker", one.module, one.algorithm]
        self.process = subprocess.Popen(
            [*command, str(folder / "warm.npz"), str(folder / "model.npz")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            cwd=ROOT,
            env=environment(),
            start_new_session=True,
        )

    def ready(self) -> dict[str, Any]:
        """Wait until it has built the model."""
        return self._answer(self.limit + GRACE, " to build")

    def solve(self) -> dict[str, Any]:
        """Have it solve once."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(b"solve\n")
            self.process.stdin.flush()
        return self._answer(self.limit)

    def _answer(self, limit: float, what: str = "") -> dict[str, Any]:
        """Read one line; whatever else happens is a failure that says what."""
        assert self.process.stdout is not None
        deadline, text = time.monotonic() + limit, b""
        while not text.endswith(b"\n"):
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([self.process.stdout], [], [], left)[0]:
                raise Failed(f"> {self.limit:g} s{what}")
            piece = os.read(self.process.stdout.fileno(), 65536)
            if not piece:
                raise Failed(f"failed: {ended(self.process.wait())}{self._last_words()}")
            text += piece
        answer: dict[str, Any] = json.loads(text)
        if "failure" in answer:
            raise Failed(f"{answer['failure']}: {answer['reason']}")
        return answer

    def _last_words(self) -> str:
        self.log.seek(0)
        lines = [line for line in self.log.read().decode(errors="replace").splitlines() if line]
        return f" ({lines[-1][:200]})" if lines else ""

    def close(self) -> None:
        """End the process and whatever it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self.log):
            with contextlib.suppress(OSError):
                pipe.close()


@dataclass
class Row:
    """What is known of a contestant on a model; ``status`` is ``"ok"`` or says what went wrong."""

    contestant: str
    status: str = "ok"
    note: str = ""
    build: float | None = None
    first: float | None = None
    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    peak: int | None = None
    error: float | None = None
    accuracy: float | None = None
    median: float | None = None
    ratio: float | None = None

    @property
    def ranked(self) -> bool:
        """Whether its time counts."""
        return self.status == "ok"


class Entry:
    """A contestant in a contest."""

    def __init__(self, one: Contestant, folder: Path, rules: Rules) -> None:
        self.one, self.folder, self.rules = one, folder, rules
        self.row = Row(one.name, note=one.note, accuracy=one.accuracy)
        if missing(one):
            self.row.status = "not installed"
        self.session: Session | None = None
        self.ready = False
        self.runs = rules.repeats

    def start(self) -> None:
        """Start its process, unless it runs or would be of no use."""
        if self.session is None and self.row.ranked:
            self.session = Session(self.one, self.folder, self.rules.limit)

    def turn(self, timed: bool) -> None:
        """Solve once; the untimed first turn checks the value and settles the number of runs."""
        row = self.row
        if not row.ranked or (timed and len(row.wall) >= self.runs):
            return
        try:
            if not self.ready:
                self.start()
                row.build = self.session.ready()["build"]
                self.ready = True
            answer = self.session.solve()
        except Failed as error:
            self.close()
            row.status = str(error)
            return
        row.peak = max(row.peak or 0, answer["peak"])
        if answer["error"] is not None:
            row.error = max(row.error or 0.0, answer["error"])
            if not row.error <= self.one.accuracy:
                row.status = "wrong value"
        if not timed:
            row.first = answer["wall"]
            self.runs = min(self.runs, int(self.rules.budget / max(answer["wall"], 1e-9)))
        if timed or self.runs == 0:
            row.wall.append(answer["wall"])
            row.cpu.append(answer["cpu"])
        done = not row.ranked or len(row.wall) >= self.runs
        if done or _free_share() < self.rules.spare:
            self.close()

    def close(self) -> None:
        """End its process, if there is one."""
        if self.session is not None:
            self.session.close()
        self.session, self.ready = None, False


def contest(
    facts: dict[str, Any],
    contestants: Sequence[Contestant],
    folder: Path,
    rules: Rules,
    log: Log = print,
) -> list[Row]:
    """Measure contestants on the model in a folder, round by round.

    A contestant without its package, with another value than the certified one, over the limit
    or crashed keeps a row that says so.
    """
    entries = [Entry(one, folder, rules) for one in contestants]
    title = f"{facts['model']}, gamma {facts['gamma']:g}"
    try:
        for entry in entries if rules.at_once else ():
            entry.start()
        for entry in entries:
            entry.turn(timed=False)
            shown = "" if entry.row.first is None else f" ({entry.row.first:.3g} s)"
            log(f"{title}: {entry.one.name}: {entry.row.status}{shown}")
        for _ in range(rules.repeats):
            for entry in entries:
                entry.turn(timed=True)
    finally:
        for entry in entries:
            entry.close()
    return finish([entry.row for entry in entries])


def finish(rows: list[Row]) -> list[Row]:
    """Add medians and ratios to lmdsl."""
    for row in rows:
        if row.wall and row.ranked:
            row.median = statistics.median(row.wall)
    ours = next((row.median for row in rows if row.contestant == OURS), None)
    for row in rows:
        if ours and row.median is not None:
            row.ratio = row.median / ours
    return rows


def missing(one: Contestant) -> bool:
    """Return whether a contestant's package is not installed."""
    return bool(one.package) and importlib.util.find_spec(one.package) is None


def prepared(name: str, gamma: float, folder: Path, limit: float) -> dict[str, Any]:
    """Compile and certify a model in a process of its own."""
    facts: dict[str, Any] = call(
        "benchmarks.prepare:prepare", name, gamma, str(folder), limit=limit
    )
    return facts


def _free_share() -> float:
    """Return the free share of memory, 1 where it is not known."""
    with contextlib.suppress(OSError, ValueError, KeyError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        sizes = {line.split(":")[0]: int(line.split()[1]) for line in lines}
        return sizes["MemAvailable"] / sizes["MemTotal"]
    return 1.0
