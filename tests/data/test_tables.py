"""Tables of recorded transitions in files, and files that are none."""

import io
import pickle
import zipfile

import numpy as np
import pytest

import lmdsl as lm

COLUMNS = {"x": [0.6, 1.2], "u": [-1.0, 1.0], "x_next": [0.1, 0.5]}
KEYS = {
    "state_box": {"x": {"low": 0, "high": 2, "cells": 4}},
    "control_grid": {"u": {"values": [-1, 1]}},
    "stage_cost": "1",
    "attractor": {"boxes": [{"x": [0, 0.5]}]},
}
CSV = b"x,u,x_next\n0.6,-1,0.1\n1.2,1,0.5\n"


def npz(**arrays):
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def parquet():
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    buffer = io.BytesIO()
    parquet.write_table(pyarrow.table(COLUMNS), buffer)
    return buffer.getvalue()


def test_csv_and_npz_hold_the_same(tmp_path):
    expected = lm.from_data(*COLUMNS.values(), **KEYS)
    for name, content in (("a.csv", CSV), ("b.npz", npz(**COLUMNS)),
                          ("c.CSV", b"\xef\xbb\xbf" + CSV.replace(b"\n", b"\r\n"))):  # fmt: skip
        (tmp_path / name).write_bytes(content)
        read = lm.read_data(tmp_path / name)
        assert {key: column.tolist() for key, column in read.items()} == COLUMNS
        assert lm.from_data(tmp_path / name, **KEYS) == expected
        assert lm.from_data(str(tmp_path / name), **KEYS) == expected


def test_parquet_holds_the_same(tmp_path):
    (tmp_path / "a.parquet").write_bytes(parquet())
    assert lm.from_data(tmp_path / "a.parquet", **KEYS) == lm.from_data(*COLUMNS.values(), **KEYS)
    (tmp_path / "b.parquet").write_bytes(parquet()[:-9])
    with pytest.raises(lm.BadInput, match="not a readable table"):
        lm.read_data(tmp_path / "b.parquet")


def test_a_table_without_a_column_names_those_it_has(tmp_path):
    (tmp_path / "a.csv").write_bytes(CSV.replace(b"x_next", b"xnext"))
    with pytest.raises(lm.BadInput, match=r"^x: the columns are 'x', 'u', 'xnext', "):
        lm.from_data(tmp_path / "a.csv", **KEYS)
    with pytest.raises(lm.BadInput, match="leave u and x_next out"):
        lm.from_data(tmp_path / "a.csv", [1], [1], **KEYS)


class Trap:
    def __reduce__(self):
        return (print, ("a stranger's file ran code",))


def bomb():
    """An archive that says it unpacks to 100 GB."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", npy(np.zeros(4)))
        archive.infolist()[0].file_size = 100 * 10**9
    return buffer.getvalue()


def npy(array):
    content = io.BytesIO()
    np.save(content, array, allow_pickle=array.dtype == object)
    return content.getvalue()


def header(text):
    """An array whose header claims what it likes."""
    body = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(body).to_bytes(2, "little") + body


def archive(**members):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", members.pop("how", zipfile.ZIP_STORED)) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.txt", CSV, r"ends in none of \.csv, \.npz, \.parquet"),
        ("a.csv", b"", "stand twice|are empty"),
        ("a.csv", b"0.6,-1,0.1\n", "first line holds numbers"),
        ("a.csv", b"x,x,u\n1,2,3\n", "stand twice"),
        ("a.csv", b"x,u\n1,2\n1,two\n", "two"),
        ("a.csv", b"x;u\n1;2\n", "not separated by commas"),
        ("a.csv", b"x\tu\n1\t2\n", "not separated by commas"),
        ("a.csv", b"x,u\n1,2\n1,2,3\n", "columns changed|number of columns"),
        ("a.csv", b"x,u,v\n1,2\n", "3 names for 2 columns"),
        ("a.csv", b"\xff\xfe\n1\n", "no UTF-8"),
        ("a.csv", b"x\n\xff\n", "no UTF-8"),
        ("a.csv", b"x," * 60_000 + b"\n", "longer than"),
        ("a.csv", b"a" + b"".join(b",a%d" % i for i in range(2000)) + b"\n", "2001 columns"),
        ("a.npz", b"PK nothing", "not a readable archive"),
        ("a.npz", archive(x=npy(np.array([Trap()], dtype=object))), "no array of numbers"),
        ("a.npz", archive(x=pickle.dumps(Trap())), "not a readable archive"),
        ("a.npz", bomb(), "memory|not a readable archive|holds"),
        (
            "a.npz",
            archive(x=header("{'descr': '<f8', 'fortran_order': False, 'shape': (10**14,), }")),
            "not a readable archive",
        ),
        (
            "a.npz",
            archive(
                x=header("{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999,), }")
            ),
            "no array of numbers",
        ),
        ("a.npz", archive(x=npy(np.zeros(3)), how=zipfile.ZIP_BZIP2), "compression method"),
        ("a.npz", npz(x=[1.0], u=[1.0, 2.0]), "different lengths: 'x' 1, 'u' 2"),
        ("a.npz", npz(x=[[1.0]]), r"'x.npy' is no array of numbers of shape \(T,\)"),
        ("a.npz", npz(x=["a"]), "'x.npy' is no array of numbers"),
        ("a.npz", npz(x=[1j]), "'x.npy' is no array of numbers"),
    ],
)
def test_files_that_are_no_table(tmp_path, capsys, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(lm.BadInput, match=message) as found:
        lm.read_data(tmp_path / name)
    assert "\n" not in str(found.value)
    assert not capsys.readouterr().out


def test_what_is_no_file(tmp_path):
    with pytest.raises(lm.BadInput, match="cannot read"):
        lm.read_data(tmp_path / "nothing.csv")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(lm.BadInput, match="directory"):
        lm.read_data(tmp_path / "folder.csv")
    with pytest.raises(lm.BadInput):
        lm.read_data(3)


def test_parquet_without_its_package_names_the_extra(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    with pytest.raises(lm.BadInput, match=r'pip install "lmdsl\[data\]"'):
        lm.read_data(tmp_path / "a.parquet")


def test_a_table_without_transitions(tmp_path, recwarn):
    (tmp_path / "a.csv").write_bytes(b"x,u,x_next\n")
    with pytest.raises(lm.BadInput, match=r"^x: no transition is given; record"):
        lm.from_data(tmp_path / "a.csv", **KEYS)
    assert not recwarn.list
