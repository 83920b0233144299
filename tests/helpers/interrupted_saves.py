"""Kill a process that saves results, again and again, and look at what it leaves behind.

Run as a program of its own: it forks, which only a process without threads of solvers should do.
Prints one JSON object; an inconsistent directory ends it with an AssertionError.
"""

from __future__ import annotations

import itertools
import json
import os
import random
import shutil
import signal
import statistics
import sys
import time
from collections import Counter
from pathlib import Path

from problems import made, standard_map

import lmdsl as lm
from lmdsl.results.directory import archive, writing

GAMMAS = (1.0, 1.01, 1.02)  # save k has GAMMAS[k % 3]: the saves before and after it differ


def solved() -> list[lm.Result]:
    return [lm.solve(made(standard_map(10, gamma))) for gamma in GAMMAS]


def gamma_held(target: Path, results: list[lm.Result]) -> float | None:
    """Return the gamma of a whole result directory, None if there is no directory."""
    if not target.exists():
        return None
    loaded = lm.Result.load(target)
    assert loaded.problem.gamma == loaded.gamma
    expected = results[GAMMAS.index(loaded.gamma)]
    for name in archive.TYPES:
        assert getattr(loaded, name).tobytes() == getattr(expected, name).tobytes(), name
    return loaded.gamma


def leftovers(target: Path) -> list[Path]:
    inside = list(target.glob(".*")) if target.exists() else []
    return inside + [path for path in target.parent.iterdir() if path != target]


def at_line(number: int, act) -> None:
    """Call ``act`` just before the given line, counted as executed, of the modules of a save."""
    left = itertools.count(number - 1, -1)

    def trace(frame, event, _):
        if frame.f_code.co_filename not in (archive.__file__, writing.__file__):
            return None
        if event == "line" and next(left) == 0:
            act()
        return trace

    sys.settrace(trace)


def reap(child: int) -> bool:
    """Wait for a child; return whether it was killed."""
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        assert os.WTERMSIG(status) == signal.SIGKILL
        return True
    assert os.waitstatus_to_exitcode(status) == 0
    return False


def forked(work) -> int:
    child = os.fork()
    if child:
        return child
    try:
        work()
    except BaseException:
        os._exit(1)
    os._exit(0)


def saved_forever(results: list[lm.Result], target: Path, first: int, pipe: int) -> None:
    os.write(pipe, b"+")
    for k in itertools.count(first):
        results[k % 3].save(target)
        os.write(pipe, b".")


def random_kills(target: Path, kills: int, seed: int) -> dict:
    """Kill at random moments of a save; a save that was reported is never lost for an older one."""
    results = solved()
    seconds = []
    for k in range(9):
        started = time.perf_counter()
        results[k % 3].save(target)
        seconds.append(time.perf_counter() - started)
    duration = statistics.median(seconds)
    random_delay = random.Random(seed)
    found: Counter[str] = Counter()
    for kill in range(kills):
        if kill % 4 == 0:
            shutil.rmtree(target, ignore_errors=True)
        held = gamma_held(target, results)
        first = 0 if held is None else GAMMAS.index(held) + 1
        reading, writing = os.pipe()
        child = forked(lambda: saved_forever(results, target, first, writing))  # noqa: B023
        os.close(writing)
        assert os.read(reading, 1) == b"+"
        time.sleep(random_delay.uniform(0, 2 * duration))
        os.kill(child, signal.SIGKILL)
        assert reap(child)
        done = 0
        while said := os.read(reading, 1000):
            done += len(said)
        os.close(reading)
        before = held if not done else GAMMAS[(first + done - 1) % 3]
        after = GAMMAS[(first + done) % 3]
        held = gamma_held(target, results)
        assert held in {before, after}, (kill, before, after)
        found["left behind"] += bool(leftovers(target))
        found["none" if held is None else "new" if held == after else "old"] += 1
        found["saves finished"] += done
    return finish(target, results, found, duration)


def kills_at_every_line(target: Path, new: bool) -> dict:
    """Kill just before each line of the modules that save executes, over an older directory."""
    results = solved()
    found: Counter[str] = Counter()
    for line in itertools.count(1):
        if new:
            shutil.rmtree(target, ignore_errors=True)
        else:
            results[0].save(target)

        def work(line: int = line) -> None:
            at_line(line, lambda: os.kill(os.getpid(), signal.SIGKILL))
            results[1].save(target)

        if not reap(forked(work)):
            break
        held = gamma_held(target, results)
        assert held in ((None if new else GAMMAS[0]), GAMMAS[1])
        left = leftovers(target)
        assert len(left) <= (3 if new else 4)
        found["left behind"] += bool(left)
        found["new" if held == GAMMAS[1] else "old"] += 1
    return finish(target, results, found)


def finish(target: Path, results: list[lm.Result], found: Counter[str], seconds=None) -> dict:
    """Save once more among what the killed processes left, and verify."""
    left = leftovers(target)
    assert all(path.name.startswith(".") for path in left)
    results[2].save(target)
    assert gamma_held(target, results) == GAMMAS[2]
    assert lm.verify(target).holds
    assert leftovers(target) == []
    return {**found, "seconds per save": seconds}


if __name__ == "__main__":
    kind, folder, *numbers = sys.argv[1:]
    run = {"random": random_kills, "lines": kills_at_every_line}[kind]
    print(json.dumps(run(Path(folder) / "out", *map(int, numbers))))
