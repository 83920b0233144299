"""Saves that were killed, and saves at the same time: one whole result, nothing left over."""

from __future__ import annotations

import errno
import json
import shutil
import sys
import threading
from dataclasses import replace

import interrupted_saves
import numpy as np
import pytest
from saved_results import OURS, names, refusing

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.results.directory import reading, writing


@pytest.fixture
def often():
    """Threads that take turns every ten microseconds, so that they meet in awkward places."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(interval)


# Leftovers ------------------------------------------------------------------------------------


def test_leftovers_of_killed_saves_are_removed(tmp_path, results):
    target = tmp_path / "out"
    beside = tmp_path / ".out.0123456789abcdef"
    beside.mkdir()
    (beside / "problem.json").write_text("{")
    kept = [".out.0123456789abcdeX", ".out2.0123456789abcdef", "out.0123456789abcdef",
            ".out.1111111111111111"]  # fmt: skip
    for name in kept:
        (tmp_path / name).mkdir()
    (tmp_path / ".out.1111111111111111" / "mine").write_text("x")
    results[0].save(target)
    assert names(tmp_path) == {"out", *kept}
    inside = [".problem.json.0123456789abcdef", ".certificate.json.fedcba9876543210"]
    for name in inside:
        (target / name).write_text("{")
    (target / ".solution.npz.0123456789abcdef").mkdir()
    results[1].save(target)
    assert names(target) == OURS | {".solution.npz.0123456789abcdef"}
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / inside[0]).write_text("{")
    results[1].save(empty)
    assert names(empty) == OURS


def test_long_names(tmp_path, results):
    for name in ("n" * 255, "\u00e9" * 127):
        results[0].save(tmp_path / name)
        results[1].save(tmp_path / name)
        assert interrupted_saves.gamma_held(tmp_path / name, results) == 1.01
        shutil.rmtree(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


# Two at once ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["problem.json", "solution.npz"])
def test_files_of_two_saves_are_refused(tmp_path, results, name):
    results[0].save(tmp_path / "a")
    results[1].save(tmp_path / "b")
    shutil.copy(tmp_path / "b" / name, tmp_path / "a" / name)
    with pytest.raises(lm.BadInput, match=f"{name} is not the one"):
        lm.Result.load(tmp_path / "a")
    assert main(["verify", str(tmp_path / "a")]) == 2
    assert main(["plot", str(tmp_path / "a")]) == 2
    results[2].save(tmp_path / "a")
    assert interrupted_saves.gamma_held(tmp_path / "a", results) == 1.02


def test_a_save_that_stops_between_its_renames_is_complete(tmp_path, results):
    """The certificate in place is the new one; the other files wait under hidden names."""
    target = tmp_path / "out"
    results[1].save(target)
    save = json.loads((target / "certificate.json").read_text())["save"]
    for name in OURS - {"certificate.json"}:
        (target / name).rename(target / f".{name}.{save}")
    assert interrupted_saves.gamma_held(target, results) == 1.01
    results[0].save(tmp_path / "old")
    for name in OURS - {"certificate.json"}:
        shutil.copy(tmp_path / "old" / name, target / name)
    assert interrupted_saves.gamma_held(target, results) == 1.01
    assert lm.verify(target).holds
    # A hidden file that is not what the certificate names proves nothing.
    shutil.copy(tmp_path / "old" / "solution.npz", target / f".solution.npz.{save}")
    with pytest.raises(lm.BadInput, match=r"solution.npz is not the one"):
        lm.Result.load(target)


def test_a_replaced_certificate_is_noticed(tmp_path, results, monkeypatch):
    """Also where it names no save: a result of an earlier version that is replaced meanwhile."""
    target = tmp_path / "out"
    results[0].save(target)
    stored = json.loads((target / "certificate.json").read_text())
    del stored["save"], stored["files"]
    (target / "certificate.json").write_text(json.dumps(stored))
    true, done = reading.Reading._opened, []

    def opened(self, name):
        if not done:
            done.append(1)
            results[1].save(target)
        return true(self, name)

    monkeypatch.setattr(reading.Reading, "_opened", opened)
    assert interrupted_saves.gamma_held(target, results) == 1.01


@pytest.mark.parametrize(("writers", "locks"), [(1, True), (1, False), (3, True), (3, False)])
def test_reading_while_others_write(tmp_path, results, writers, locks, monkeypatch):
    """Where locks are refused, several writers may make a reader refuse, but never believe."""
    target = tmp_path / "out"
    if not locks and writing.fcntl:
        monkeypatch.setattr(writing.fcntl, "flock", refusing(errno.EBADF))
    results[0].save(target)
    stop, failures = threading.Event(), []

    def write(k):
        try:
            for i in range(25):
                results[(i + k) % 3].save(target)
        except Exception as error:
            failures.append(error)

    def load():
        try:
            while not stop.is_set():
                try:
                    assert interrupted_saves.gamma_held(target, results) in (1.0, 1.01, 1.02)
                except reading.Mixture:
                    assert writers > 1
                    assert not locks
        except BaseException as error:
            failures.append(error)

    readers = [threading.Thread(target=load) for _ in range(2)]
    saves = [threading.Thread(target=write, args=(k,)) for k in range(writers)]
    for thread in readers + saves:
        thread.start()
    for thread in saves:
        thread.join()
    stop.set()
    for thread in readers:
        thread.join()
    assert failures == []
    assert interrupted_saves.gamma_held(target, results) in (1.0, 1.01, 1.02)
    assert names(target) == OURS
    assert names(tmp_path) == {"out"}


@pytest.mark.long
def test_a_new_directory_by_several(tmp_path, results, often):
    """Each takes the others' unfinished folders for those of killed saves; none is left behind."""
    for k in range(40):
        target, failures = tmp_path / f"out{k}", []

        def write(i, target=target, failures=failures):
            try:
                results[i % 3].save(target)
            except Exception as error:
                failures.append(error)

        threads = [threading.Thread(target=write, args=(i,)) for i in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert failures == []
        assert interrupted_saves.gamma_held(target, results) in (1.0, 1.01, 1.02)
    assert names(tmp_path) == {f"out{k}" for k in range(40)}


def test_what_cannot_be_saved_leaves_nothing(tmp_path, results):
    results[0].save(tmp_path / "out")
    bad = replace(results[1], value=np.array([object()]))
    for target in (tmp_path / "out", tmp_path / "new"):
        with pytest.raises(ValueError, match="allow_pickle"):
            bad.save(target)
    assert names(tmp_path) == {"out"}
    assert interrupted_saves.gamma_held(tmp_path / "out", results) == 1.0
