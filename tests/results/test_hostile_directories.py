"""What a result directory may hold: regular files of the size they should have."""

from __future__ import annotations

import os
import stat

import pytest
from problems import made, standard_map
from saved_results import OURS, names, posix

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.common import files


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
