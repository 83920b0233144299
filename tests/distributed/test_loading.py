"""Ranks share the hashing of a directory: what one process refuses all of them refuse, alike."""

import numpy as np
import pytest
from problems import made, standard_map
from saved_results import content, put_apart

import lmdsl as lm
from lmdsl import distributed
from lmdsl.distributed import loading
from lmdsl.ranks.threaded import as_threads
from lmdsl.results.directory import archive, reading, vectors

pytestmark = pytest.mark.long  # in other versions it would find nothing else

SMALL = 64  # bytes of a block, so that every rank has a share of every file


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(reading, "BLOCK", SMALL)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    target = tmp_path_factory.mktemp("saved") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reading, "BLOCK", SMALL)
        as_threads(2, lambda r: distributed.solve(made(standard_map(10)), out=target, ranks=r))
    return target


@pytest.fixture
def out(saved, tmp_path):
    put_apart(saved, tmp_path / "out")
    return tmp_path / "out"


def refusal(read):
    """What is said against a directory; nothing where it is read."""
    try:
        read()
    except lm.BadInput as error:
        return str(error)
    return None


def require_refused(path, counts=(3,), match=""):
    """Require every rank to say what one process says, whether it loads or verifies."""
    said = refusal(lambda: archive.read(path))
    assert said
    assert match in said
    for count in counts:
        found = as_threads(count, lambda r: refusal(lambda: loading.read(r, path)))
        assert found == [said] * count
        found = as_threads(count, lambda r: refusal(lambda: distributed.verify(path, ranks=r)))
        assert found == [said] * count


@pytest.mark.parametrize("name", ["value", "cell_status"])
def test_a_flipped_byte_is_refused_in_whosever_share_it_is(out, name):
    place = out / f"{name}.npy"
    whole = place.read_bytes()
    blocks = -(-len(whole) // SMALL)
    assert blocks >= 3
    for share in range(3):  # of each of three ranks the first byte and the last
        for at in (SMALL * (blocks * share // 3), SMALL * (blocks * (share + 1) // 3) - 1):
            at = min(at, len(whole) - 1)
            place.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
            require_refused(out, match="not the one this result was saved with")
    place.write_bytes(whole)
    assert as_threads(3, lambda r: loading.read(r, out).result.verified) == [True] * 3


def test_headers_lengths_and_missing_files(out):
    place = out / "measure.npy"
    whole = place.read_bytes()
    for other in (whole[:-1], whole + b"\0", whole[:SMALL], b"", whole[:30] + b"9" + whole[31:]):
        place.write_bytes(other)
        require_refused(out)
    place.unlink()
    require_refused(out, match="cannot read")


def test_files_of_another_kind_with_right_digests(saved, tmp_path):
    """Too short, of another header, and controls or statuses that there are not, of each rank."""
    value = lm.Result.load(saved).value
    for k, other in enumerate((value[:-1], value.astype("<f4"), value.reshape(10, 10))):
        kind = other.dtype.str
        put_apart(saved, tmp_path / f"value{k}", value=content(other, kind))
        require_refused(tmp_path / f"value{k}", match="value.npy")
    for name, wrong in (("control_index", 99), ("cell_status", 9)):
        for share in range(3):
            array = getattr(lm.Result.load(saved), name).copy()
            array[len(array) * share // 3] = wrong
            target = tmp_path / f"{name}{wrong}{share}"
            put_apart(saved, target, **{name: content(array, vectors.TYPES[name])})
            require_refused(target, match="code" if name == "cell_status" else "control grid")


def test_no_block_is_hashed_twice(saved, monkeypatch):
    hashed, whole, value = [], reading.block_hashes, lm.Result.load(saved).value

    def counted(blocks):
        found = whole(blocks)
        hashed.append(len(found) // 32)
        return found

    monkeypatch.setattr(reading, "block_hashes", counted)
    monkeypatch.setattr(archive, "read", None)  # as one process reads
    for count in (2, 3, 4):
        hashed.clear()
        every = as_threads(count, lambda r: loading.read(r, saved))
        sizes = [(saved / f"{name}.npy").stat().st_size for name in vectors.TYPES]
        assert sum(hashed) == sum(-(-size // SMALL) for size in sizes)
        assert max(hashed) <= -(-max(sizes) // SMALL) // count + 1
        for stored in every:
            assert np.array_equal(stored.result.value, value)


def test_ranks_that_see_other_files_read_them_whole(saved, monkeypatch):
    """No share of one file tells of another one."""
    seen, read = loading._seen, []
    whole = archive.read

    def odd(files):
        read.append("looked")
        return (*seen(files), len(read))

    monkeypatch.setattr(loading, "_seen", odd)
    monkeypatch.setattr(archive, "read", lambda path: read.append("whole") or whole(path))
    assert as_threads(2, lambda r: loading.read(r, saved).result.verified) == [True] * 2
    assert read.count("whole") == 3  # by rank 0 first


def test_a_rank_that_hashes_something_else_is_found_out(saved, monkeypatch):
    true, read = loading._hashes, []
    whole = archive.read

    def other(files, ranks):
        found = true(files, ranks)
        if ranks.rank == 1:
            found["value.npy"] = found["value.npy"][::-1]
        return found

    monkeypatch.setattr(loading, "_hashes", other)
    monkeypatch.setattr(archive, "read", lambda path: read.append("whole") or whole(path))
    assert as_threads(3, lambda r: loading.read(r, saved).result.verified) == [True] * 3
    assert len(read) == 4


def test_no_directory(tmp_path):
    for path in (tmp_path / "none", tmp_path):
        require_refused(path)
