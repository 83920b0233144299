"""Result directories on strange file systems, beside a user's files, and with several at work."""

from __future__ import annotations

import errno
import itertools
import json
import os
import shutil
import stat
import sys
import threading
from dataclasses import replace

import interrupted_saves
import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.common import files
from lmdsl.results.directory import archive, reading, writing
from lmdsl.systems import FunctionSystem

OURS = {"certificate.json", "problem.json", "solution.npz"}
posix = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes and links")


@pytest.fixture(scope="module")
def results():
    return interrupted_saves.solved()


@pytest.fixture
def file(tmp_path):
    (tmp_path / "problem.json").write_text(json.dumps(steps()))
    return str(tmp_path / "problem.json")


@pytest.fixture
def often():
    """Threads that take turns every ten microseconds, so that they meet in awkward places."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(interval)


def names(path):
    return {entry.name for entry in path.iterdir()}


def refusing(number, *calls):
    """Return a stand-in for a function of ``os`` that fails, at the given calls or always."""
    count = itertools.count(1)

    def fail(*_, **__):
        if not calls or next(count) in calls:
            raise OSError(number, os.strerror(number))

    return fail


# Whose files ----------------------------------------------------------------------------------


def test_other_files_of_a_result_directory_stay(tmp_path, results):
    target = tmp_path / "out"
    results[0].save(target)
    own = {"figures.pdf": b"%PDF", ".DS_Store": b"\0", "figures.png": b"mine", "notes": b"x",
           ".problem.json.swp": b"vi", "model.npz.bak": b"y"}  # fmt: skip
    for name, content in own.items():
        (target / name).write_bytes(content)
    (target / "runs").mkdir()
    (target / "runs" / "certificate.json").write_text("{}")
    before = target.stat().st_ino
    results[1].save(target)
    assert interrupted_saves.gamma_held(target, results) == 1.01
    assert {name: (target / name).read_bytes() for name in own} == own
    assert (target / "runs" / "certificate.json").read_text() == "{}"
    assert names(target) == OURS | set(own) | {"runs"}
    assert target.stat().st_ino == before


MARKED = '{"format": "lmdsl-result/1"}'


@pytest.mark.parametrize(
    "held",
    [
        {"certificate.json": "{}"},
        {"certificate.json": "my diploma", "solution.npz": "x"},
        {"certificate.json": '{"format": "other/1"}', "problem.json": "{}"},
        {"certificate.json/content": "x"},
        {"problem.json": "{}", "solution.npz": "x"},
        {"figures.png": "x"},
        {".hidden": "x"},
        {".problem.json.0123456789abcdeX": "x"},
        {"certificate.json": MARKED, "solution.npz/thesis.tex": "x"},
        {"certificate.json": MARKED, "model.npz/thesis.tex": "x"},
        {"certificate.json": "[" * 100_000},
        {"certificate.json": "\xff"},
    ],
)
def test_a_folder_without_our_mark_is_refused_and_untouched(tmp_path, file, results, capsys, held):
    target = tmp_path / "out"
    for name, text in held.items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_text(text)
    assert main(["solve", file, "--out", str(target)]) == 2
    assert capsys.readouterr().out == ""  # before work starts
    with pytest.raises(lm.BadInput):
        results[0].save(target)
    assert {name: (target / name).read_text() for name in held} == held
    assert names(target) == {name.split("/")[0] for name in held}


@pytest.mark.parametrize("litter", [".DS_Store", "Thumbs.db", "lost+found", "._x"])
def test_what_systems_leave_in_an_empty_folder_is_nothing(tmp_path, results, litter):
    target = tmp_path / "out"
    (target / litter).mkdir(parents=True)
    results[0].save(target)
    assert names(target) == OURS | {litter}


@posix
def test_links(tmp_path, results):
    place, link = tmp_path / "place", tmp_path / "link"
    link.symlink_to(place)
    results[0].save(link)  # made where the link points to
    assert link.is_symlink()
    assert interrupted_saves.gamma_held(place, results) == 1.0
    results[1].save(link)
    assert link.is_symlink()
    assert interrupted_saves.gamma_held(link, results) == 1.01
    assert names(tmp_path) == {"place", "link"}
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(lm.BadInput):
        results[0].save(loop)


def test_a_directory_of_an_earlier_version(tmp_path, results):
    target = tmp_path / "out"
    results[0].save(target)
    path = target / "certificate.json"
    stored = json.loads(path.read_text())
    del stored["save"], stored["files"]
    path.write_text(json.dumps(stored))
    with np.load(target / "solution.npz") as held:
        np.savez(target / "solution.npz", **held)
    assert interrupted_saves.gamma_held(target, results) == 1.0
    assert lm.verify(target).holds
    results[1].save(target)
    assert interrupted_saves.gamma_held(target, results) == 1.01


def test_rows_of_an_older_function_go(tmp_path, results):
    own = made(steps()).replaced(system=FunctionSystem(next=lambda x, u: (x - 0.25 * u,)))
    target = tmp_path / "out"
    lm.solve(own).save(target)
    assert names(target) == OURS | {"model.npz"}
    loaded = lm.Result.load(target)
    with pytest.raises(lm.BadInput, match="copy that directory"):
        loaded.save(tmp_path / "again")
    results[1].save(target)
    assert names(target) == OURS
    assert lm.verify(target).holds


# File systems ---------------------------------------------------------------------------------


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EBADF])
def test_no_fsync(tmp_path, results, monkeypatch, number, there):
    if there:
        results[0].save(tmp_path / "out")
    monkeypatch.setattr(files.os, "fsync", refusing(number))
    results[1].save(tmp_path / "out")
    assert interrupted_saves.gamma_held(tmp_path / "out", results) == 1.01
    made(steps()).save(tmp_path / "p.json")
    assert lm.load(tmp_path / "p.json") == made(steps())


@pytest.mark.parametrize("there", [False, True])
def test_neither_modes_nor_locks_nor_the_mask_are_touched(tmp_path, results, monkeypatch, there):
    if there:
        results[0].save(tmp_path / "out")
    for name in ("chmod", "fchmod", "umask", "chown", "lockf"):
        if hasattr(os, name):
            monkeypatch.setattr(os, name, refusing(errno.EPERM))
    fcntl = pytest.importorskip("fcntl")
    for name in ("flock", "lockf"):
        monkeypatch.setattr(fcntl, name, refusing(errno.ENOSYS))
    results[1].save(tmp_path / "out")
    made(steps()).save(tmp_path / "p.json")
    assert names(tmp_path) == {"out", "p.json"}
    assert lm.verify(tmp_path / "out").holds


@posix
def test_permissions_are_those_of_the_mask(tmp_path, results):
    mask = os.umask(0o027)
    try:
        results[0].save(tmp_path / "out")
        made(steps()).save(tmp_path / "p.json")
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == 0o750
    for path in ("out/certificate.json", "out/solution.npz", "p.json"):
        assert stat.S_IMODE((tmp_path / path).stat().st_mode) == 0o640


@pytest.mark.parametrize("held", [[], ["lost+found"], ["result"]])
def test_a_mount_point(tmp_path, results, monkeypatch, held):
    """A directory that can neither be renamed nor replaced nor removed."""
    target = tmp_path / "out"
    target.mkdir()
    if held == ["result"]:
        results[0].save(target)
    elif held:
        (target / held[0]).mkdir()
    monkeypatch.setattr(writing.os, "rename", refusing(errno.EBUSY))
    monkeypatch.setattr(os, "rmdir", refusing(errno.EBUSY))
    results[1].save(target)
    assert interrupted_saves.gamma_held(target, results) == 1.01
    assert names(tmp_path) == {"out"}


def broken(number, at):
    """Return an ``os.replace`` that fails from the given call on."""
    count, true = itertools.count(1), os.replace

    def replaced(a, b):
        if next(count) >= at:
            raise OSError(number, os.strerror(number))
        true(a, b)

    return replaced


@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_directory_that_fails_half_way(tmp_path, results, monkeypatch, at):
    target = tmp_path / "out"
    results[0].save(target)
    with monkeypatch.context() as patch:
        patch.setattr(writing.os, "replace", broken(errno.EIO, at))
        with pytest.raises(lm.BadInput, match="input/output error"):
            results[1].save(target)
    assert interrupted_saves.gamma_held(target, results) == (1.0 if at == 1 else 1.01)
    assert lm.verify(target).holds
    results[2].save(target)
    assert interrupted_saves.gamma_held(target, results) == 1.02
    assert names(target) == OURS


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_full_disk(tmp_path, results, monkeypatch, there, at):
    target = tmp_path / "out"
    if there:
        results[0].save(target)
    before = {p.name: p.read_bytes() for p in target.iterdir()} if there else {}
    true, count = writing.write_new, itertools.count(1)

    def full(path, pieces):
        if next(count) >= at:
            path.write_bytes(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        true(path, pieces)

    monkeypatch.setattr(writing, "write_new", full)
    with pytest.raises(lm.BadInput, match="no space left"):
        results[1].save(target)
    assert {p.name: p.read_bytes() for p in target.iterdir()} == before if there else True
    assert names(tmp_path) == ({"out"} if there else set())


# The answer is never lost ---------------------------------------------------------------------


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_a_result_that_cannot_be_saved_is_rescued(tmp_path, file, monkeypatch, capsys, form):
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setattr(archive.tempfile, "tempdir", str(home))
    true = writing.write

    def fails(target, *rest):
        if target == tmp_path / "out":
            raise OSError(errno.EROFS, "Read-only file system")
        true(target, *rest)

    monkeypatch.setattr(writing, "write", fails)
    assert main(["solve", file, "--out", str(tmp_path / "out"), *form]) == 2
    said = capsys.readouterr()
    assert "verified" in said.out
    if form:
        assert json.loads(said.out)["status"] == "verified"
    (saved,) = home.glob("lmdsl-*/out")
    assert said.err.count("\n") == 1
    assert "read-only file system" in said.err
    assert str(saved) in said.err
    assert lm.verify(saved).holds
    monkeypatch.setattr(writing, "write", refusing(errno.ENOSPC))
    monkeypatch.chdir(home)
    monkeypatch.setattr(archive.Path, "home", lambda: home)
    shutil.rmtree(saved.parent)
    assert main(["solve", file, "--out", str(tmp_path / "out"), *form]) == 2
    said = capsys.readouterr()
    assert "verified" in said.out
    assert "nothing was saved" in said.err
    assert list(home.iterdir()) == []


def test_saved_also_where_nobody_reads_the_report(tmp_path, file, monkeypatch):
    class Gone:
        def write(self, *_):
            raise BrokenPipeError(errno.EPIPE, "Broken pipe")

        flush = write

    monkeypatch.setattr("sys.stdout", Gone())
    assert main(["solve", file, "--out", str(tmp_path / "out"), "--json"]) == 0
    assert lm.verify(tmp_path / "out").holds


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


# What is read ---------------------------------------------------------------------------------


@posix
@pytest.mark.parametrize("name", sorted(OURS))
@pytest.mark.parametrize("kind", ["fifo", "link", "device", "folder", "socket"])
def test_only_regular_files_are_read(tmp_path, results, name, kind, monkeypatch):
    import socket

    target = tmp_path / "out"
    results[0].save(target)
    path = target / name
    path.rename(tmp_path / name)
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to(tmp_path / name)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        monkeypatch.chdir(target)
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(name)
    for command in ("verify", "simulate", "plot"):
        assert main([command, str(target)]) == 2
    with pytest.raises(lm.BadInput, match=name):
        lm.Result.load(target)


def archive_with_directory(path, size):
    """A sparse archive whose directory is said to have the given size."""
    end = b"PK\x05\x06" + bytes(4) + b"\x01\x00\x01\x00"
    with open(path, "wb") as out:
        out.seek(size)
        out.write(end + size.to_bytes(4, "little") + bytes(4) + b"\x00\x00")


@pytest.mark.parametrize("size", [3 * 2**30, 2**20, 300_000])
def test_large_directories_of_archives(tmp_path, results, size, capsys):
    target = tmp_path / "out"
    results[0].save(target)
    archive_with_directory(target / "solution.npz", size)
    assert main(["verify", str(target)]) == 2
    assert "solution.npz" in capsys.readouterr().err


def test_many_members_are_not_listed(tmp_path, results, capsys):
    import zipfile

    target = tmp_path / "out"
    results[0].save(target)
    with zipfile.ZipFile(target / "solution.npz", "a") as out:
        for k in range(2500):
            out.writestr(f"{k:0100d}", b"")
        out.comment = b""
    assert main(["verify", str(target)]) == 2
    assert "at most" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_array_that_stands_twice(tmp_path, results, capsys):
    import zipfile

    target = tmp_path / "out"
    results[0].save(target)
    with zipfile.ZipFile(target / "solution.npz", "a") as out:
        out.writestr("value.npy", out.read("value.npy"))
        out.comment = b""
    assert main(["verify", str(target)]) == 2
    assert "solution.npz: an array stands twice" in capsys.readouterr().err


@pytest.mark.parametrize("method", ["ZIP_BZIP2", "ZIP_LZMA"])
def test_methods_that_may_ask_for_gigabytes(tmp_path, results, method, capsys):
    import zipfile

    target = tmp_path / "out"
    results[0].save(target)
    with zipfile.ZipFile(target / "solution.npz") as old:
        members = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(target / "solution.npz", "w", getattr(zipfile, method)) as out:
        for name, content in members.items():
            out.writestr(name, content)
    assert main(["verify", str(target)]) == 2
    assert "compression" in capsys.readouterr().err


def test_files_for_others(tmp_path):
    """write_whole: where a link stands its target is written, a pipe gets the bytes."""
    path, link = tmp_path / "p.json", tmp_path / "link.json"
    path.write_text("old")
    link.symlink_to(path)
    made(standard_map(5)).save(link)
    assert link.is_symlink()
    assert lm.load(path) == made(standard_map(5))
    assert names(tmp_path) == {"p.json", "link.json"}
    files.write_whole(tmp_path / os.devnull, b"x")
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)
