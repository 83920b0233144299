"""Kernels: what keeps them may be missing, full, broken or out of date; the answer stays."""

import errno
import gc
import importlib
import io
import json
import logging
import os
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest

from lmdsl.cli.output import Narrator
from lmdsl.machine import kernels

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Keep kernels in a folder of the test, and forget what was said."""
    monkeypatch.setattr(kernels, "folders", lambda: (tmp_path,))
    monkeypatch.setattr(kernels, "_said", [])
    return tmp_path


@pytest.fixture
def said(caplog):
    caplog.set_level(logging.INFO, "lmdsl")
    return lambda level: [r.getMessage() for r in caplog.records if r.levelno == level]


def double():
    """Make the same kernel anew, as another process would."""

    def double(x):
        return 2.0 * x

    double.__qualname__ = "double"
    return kernels.kernel(double)


def compiled(said):
    return sum(text.startswith("compiling") for text in said(logging.INFO))


def test_kernels_are_compiled_once_for_the_types_of_their_arguments(folder, said):
    assert double()(1.5) == 3.0
    assert double()(2.5) == 5.0
    assert compiled(said) == 1
    assert len(list(folder.iterdir())) == 1
    assert double()(np.float32(2.5)) == 5.0
    assert compiled(said) == 2
    assert len(list(folder.iterdir())) == 2
    assert not said(logging.WARNING)


def test_named_tuples_are_told_apart_by_the_order_of_their_fields(folder, said):
    """Numba's names of their types say only what they hold, and a kernel may name no place."""

    def difference(pair):
        return pair.a - pair.b

    def outer(pair):
        return pair.inner.a - pair.inner.b

    for names, value in (("a b", 1.0), ("b a", -1.0)):
        pair = namedtuple("Pair", names)(3.0, 2.0)
        assert kernels.kernel(difference)(pair) == value
        assert kernels.kernel(outer)(namedtuple("Outer", "inner")(pair)) == value
    assert compiled(said) == 4


@pytest.mark.parametrize("spoil", [
    lambda path, data: path.write_bytes(b""),
    lambda path, data: path.write_bytes(data[: len(data) // 2]),
    lambda path, data: path.write_bytes(data[:-1]),
    lambda path, data: path.write_bytes(bytes(len(data))),
    lambda path, data: path.write_bytes(bytes([data[0] ^ 1]) + data[1:]),
    lambda path, data: path.write_bytes(data[:40] + bytes([data[40] ^ 1]) + data[41:]),
    lambda path, data: path.write_bytes(data[:2000] + bytes([data[2000] ^ 4]) + data[2001:]),
    lambda path, data: path.write_bytes(data[:64] + b"no pickle"),
    lambda path, data: (path.unlink(), path.mkdir()),
    lambda path, data: (path.unlink(), path.symlink_to(path)),
])  # fmt: skip
def test_a_file_that_is_not_what_was_written_is_compiled_again(folder, said, spoil):
    double()(1.5)
    [path] = folder.iterdir()
    spoil(path, path.read_bytes())
    assert double()(1.5) == 3.0
    assert compiled(said) == 2


def test_a_repaired_file_serves_again(folder, said):
    double()(1.5)
    [path] = folder.iterdir()
    path.write_bytes(b"cut")
    for _ in range(3):
        assert double()(1.5) == 3.0
    assert compiled(said) == 2
    assert [p.name for p in folder.iterdir()] == [path.name]  # and no draft is left


def test_a_folder_that_cannot_be_written_is_said_once_and_the_next_is_used(
    tmp_path, monkeypatch, said
):
    (tmp_path / "file").write_text("")
    first, second = tmp_path / "file" / "below", tmp_path / "second"
    monkeypatch.setattr(kernels, "folders", lambda: (first,))
    monkeypatch.setattr(kernels, "_said", [])
    for k in range(3):
        assert double()(float(k)) == 2.0 * k
    assert compiled(said) == 3
    [warning] = said(logging.WARNING)
    assert "NUMBA_CACHE_DIR" in warning
    assert "Not a directory" in warning

    monkeypatch.setattr(kernels, "folders", lambda: (first, second))
    for k in range(3):
        assert double()(float(k)) == 2.0 * k
    assert compiled(said) == 4
    assert len(said(logging.WARNING)) == 1


def test_no_folder_at_all(monkeypatch, said):
    monkeypatch.setattr(kernels, "folders", lambda: ())
    monkeypatch.setattr(kernels, "_said", [])
    assert double()(1.5) == 3.0
    assert len(said(logging.WARNING)) == 1


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_a_disk_that_takes_no_file(folder, monkeypatch, said, number):
    def replace(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(kernels.os, "replace", replace)
    assert double()(1.5) == 3.0
    assert double()(1.5) == 3.0
    [warning] = said(logging.WARNING)
    assert os.strerror(number) in warning
    assert not list(folder.iterdir())


def test_folders_in_order(tmp_path, monkeypatch):
    find = kernels.folders.__wrapped__
    monkeypatch.setattr(kernels.numba.config, "CACHE_DIR", "")
    own = find()
    assert own[0] == Path(kernels.__file__).parent / "__pycache__"
    assert len(own) == 2
    monkeypatch.setattr(kernels.numba.config, "CACHE_DIR", str(tmp_path))
    [only] = find()
    assert only.parent == tmp_path
    monkeypatch.setattr(kernels.numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(kernels.numba.misc.appdirs, "user_cache_dir", lambda *_, **__: "~/x")
    assert find() == own[:1]  # no home: never a folder named ~


@pytest.mark.parametrize("named", ["", "called."])
@pytest.mark.parametrize(
    ("change", "times"),
    [
        (("return x + STEP", "return x - STEP"), 2),
        (("STEP = 1.0", "STEP = 3.0"), 2),
        (('"""Add."""', '"""Add."""\n    # a comment'), 1),
        (("unrelated = 1", "unrelated = 2"), 1),
    ],
)
def test_a_change_in_a_kernel_or_constant_of_another_file_is_noticed(
    folder, said, monkeypatch, change, times, named
):
    source = folder / "source"
    source.mkdir()
    monkeypatch.syspath_prepend(str(source))
    monkeypatch.setattr(kernels, "folders", lambda: (folder / "kept",))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    called = (
        "from lmdsl.machine.kernels import kernel\n\nSTEP = 1.0\nunrelated = 1\n\n\n"
        '@kernel\ndef add(x):\n    """Add."""\n    return x + STEP\n'
    )
    caller = (
        f"{'import called' if named else 'from called import add'}\n"
        "from lmdsl.machine.kernels import kernel\n\n\n"
        f"@kernel\ndef twice(x):\n    return {named}add({named}add(x))\n"
    )

    def run():
        for name in ("called", "caller"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        caller = importlib.import_module("caller")
        return caller.twice(10.0), caller.twice.py_func(10.0)

    (source / "called.py").write_text(called)
    (source / "caller.py").write_text(caller)
    assert run() == (12.0, 12.0)
    assert change[0] in called
    (source / "called.py").write_text(called.replace(*change))
    found, expected = run()
    assert found == expected
    for name in ("called", "caller"):
        sys.modules.pop(name, None)
    texts = said(logging.INFO)
    assert texts.count("compiling caller.twice") == times


def test_arrays_that_can_be_written_to_and_others_share_code(folder, said):
    @kernels.kernel
    def first(x):
        return x[0]

    x = np.arange(3.0)
    y = x.copy()
    y.setflags(write=False)
    assert first(kernels.fixed(x)) == first(kernels.fixed(y)) == 0.0
    assert compiled(said) == 1
    assert x.flags.writeable


def test_no_garbage_is_looked_for_while_a_kernel_is_compiled_and_again_after(folder, monkeypatch):
    seen = []
    on_end = kernels.Uncollected.on_end

    def watched(self, event):
        seen.append(gc.isenabled())
        on_end(self, event)

    monkeypatch.setattr(kernels.Uncollected, "on_end", watched)
    inner = double()

    @kernels.kernel
    def outer(x):
        return inner(x) + 1.0

    @kernels.kernel
    def wrong(x):
        return x.nothing

    assert outer(1.5) == 4.0
    with pytest.raises(kernels.numba.TypingError):
        wrong(1.5)
    assert seen == [False] * 3
    assert gc.isenabled()
    gc.disable()
    try:
        assert double()(1.5) == 3.0
        assert not gc.isenabled()  # as the caller had it
    finally:
        gc.enable()
    foreign = kernels.numba.njit(lambda x: x + 1.0)
    assert foreign(1.0) == 2.0
    assert seen[-1] is True  # Numba tells of it; it is left alone


def test_a_kernel_that_allocates_says_so(folder):
    def ones(n):
        return np.ones(n)

    assert (kernels.kernel(ones, allocates=True)(3) == 1.0).all()


def test_options_that_numba_may_drop_are_not_needed(folder, monkeypatch):
    monkeypatch.setattr(kernels, "COUNTS", "_no_such_option")
    assert double()(1.5) == 3.0


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("stream", "shown"), [(Terminal(), True), (io.StringIO(), False)])
def test_the_command_line_says_that_kernels_are_compiled_on_a_terminal(monkeypatch, stream, shown):
    monkeypatch.setattr(sys, "stderr", stream)
    log, narrator = logging.Logger("test"), Narrator()
    log.addHandler(narrator)
    log.info("compiling one", extra={"busy": True})
    assert ("compiling kernels, once" in stream.getvalue()) == shown
    log.info("compiled one", extra={"busy": False})
    assert stream.getvalue().endswith("\r\x1b[K" if shown else "")
    log.warning("look\x1b")
    assert stream.getvalue().endswith("lmdsl: look\\x1b\n")


@pytest.mark.parametrize("stream", [None, io.StringIO()])
def test_a_closed_stderr_is_no_error(monkeypatch, stream):
    if stream:
        stream.close()
    monkeypatch.setattr(sys, "stderr", stream)
    log = logging.Logger("test")
    log.addHandler(Narrator())
    log.info("compiling one", extra={"busy": True})
    log.warning("look")


def command(*arguments, **variables):
    return subprocess.run(
        [sys.executable, "-m", "lmdsl", *arguments],
        cwd=ROOT, env={**os.environ, **variables}, capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("setting", [
    "NUMBA_NUM_THREADS=0", "NUMBA_NUM_THREADS=-1", "NUMBA_NUM_THREADS=two", "NUMBA_NUM_THREADS=",
    "NUMBA_OPT=9", "NUMBA_BOUNDSCHECK=yes",
])  # fmt: skip
def test_a_setting_that_numba_cannot_use_is_named(setting):
    name, value = setting.split("=")
    done = command("solve", "examples/logistic_map.json", "--json", **{name: value})
    assert done.returncode == 2
    report = json.loads(done.stdout)
    assert report["status"] == "bad_input"
    assert setting in report["message"]
    assert done.stderr == f"lmdsl: {report['message']}\n"


@pytest.mark.parametrize(
    "setting", ["NUMBA_NUM_THREADS=1", "NUMBA_NUM_THREADS=100000", "OMP_NUM_THREADS=none"]
)
def test_a_setting_that_can_be_used_is(setting):
    name, value = setting.split("=")
    done = command("solve", "examples/logistic_map.json", **{name: value})
    assert done.returncode == 0, done.stderr
    assert not done.stderr


@pytest.mark.long
def test_a_command_without_any_folder_for_kernels(tmp_path):
    run = (
        "import sys; from lmdsl.machine import kernels; kernels.folders = lambda: (); "
        "from lmdsl.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", run, "solve", "examples/logistic_map.json", "--json"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0
    assert json.loads(done.stdout)["status"] == "verified"
    [line] = done.stderr.splitlines()
    assert "NUMBA_CACHE_DIR" in line


def test_only_the_module_of_kernels_imports_numba():
    for path in (ROOT / "lmdsl").rglob("*.py"):
        if path.name != "kernels.py":
            assert "import numba" not in path.read_text(), path
            assert "from numba" not in path.read_text(), path
