"""The digest of a model that is spread over ranks: equal for every number of ranks.

What a model holds of its cells is hashed in *blocks* of consecutive cells, in global numbers; the
digest is the hash of the blocks' hashes, in order. A block that ranks share is hashed by the rank
of its first cell; the others send it their parts. So no rank reads more than its own cells and a
block, and where cells are cut does not matter.
"""

import hashlib
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Indices
from lmdsl.model.lp import StabilizationLP
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.verbs import Ranks

BLOCK = 1024  # cells of a block
TITLE = b"lmdsl model 2\n"


class ByCell(NamedTuple):
    """What a model holds of own cells, one after the other."""

    array: NDArray[Any]
    kind: str  # as what its entries count
    start: Indices | None = None  # where each own cell begins, and the end; None: one entry each
    meant: NDArray[Any] | None = None  # what stands for each value of the array
    steps: bool = False  # whether the array, one entry longer, holds ends: its differences count


def digest(ranks: Ranks, division: Division, header: bytes, streams: Sequence[ByCell]) -> str:
    """Return the SHA-256 of streams by cell, the same on every rank; collective."""
    first, last = division.own(ranks.rank)
    cut = [first, *range((first // BLOCK + 1) * BLOCK, last, BLOCK), last] if last > first else []
    parts: dict[int, list[bytes]] = {}  # of blocks that may be shared with other ranks
    hashes: dict[int, bytes] = {}
    for a, b in itertools.pairwise(cut):
        part = _part(streams, a - first, b - first)
        if a % BLOCK or b == last:
            parts[a // BLOCK] = part
        else:
            hashes[a // BLOCK] = _hash(part)
    away = {}
    if last > first and first % BLOCK:  # its first block begins with another rank's cell
        owner = int(division.owner(np.array([first - first % BLOCK]))[0])
        if owner != ranks.rank:
            away[owner] = _packed(parts.pop(first // BLOCK))
    for other, came in ranks.exchange(away).items():
        block = (division.own(other)[0]) // BLOCK
        parts[block] = [
            mine + more for mine, more in zip(parts[block], _unpacked(came), strict=True)
        ]
    hashes |= {block: _hash(part) for block, part in parts.items()}
    every = ranks.collect(b"".join(hashes[block] for block in sorted(hashes)))
    sizes = repr((division.cells, BLOCK, [stream.kind for stream in streams])).encode()
    return hashlib.sha256(TITLE + header + sizes + b"".join(every)).hexdigest()


def of_model(ranks: Ranks, lp: StabilizationLP) -> str:
    """Return the digest of a model, whole or spread over ranks; collective.

    Its blocks hold the status of every cell of the box; then, of every cell of C, its index in the
    box, the pairs with their controls and costs, their rows with targets among the cells of C, and
    its weight. The header holds what every rank has: gamma, the meaning of codes, the controls.
    """
    rows, shares, mesh = lp.rows, lp.rows.shares, lp.mesh
    division = mesh.division if mesh else Division.cut(np.ones(lp.n, dtype=np.int64), 1)
    below = [*shares.denominator] if shares.total is None else shares.total
    header = hashlib.sha256(repr((below, [*shares.numerator])).encode()).digest()
    header += np.array([lp.gamma], dtype="<f8").tobytes()
    header += hashlib.sha256(np.ascontiguousarray(lp.controls, dtype="<f8").tobytes()).digest()
    counts = ranks.collect(len(lp.cell_status))
    box = Division(np.append(0, np.cumsum(counts)), np.arange(len(counts) + 1))
    header += digest(ranks, box, b"", [ByCell(lp.cell_status, "<u1")]).encode()
    if lp.hold is not None:
        header += digest(ranks, box, b"hold", [ByCell(lp.hold, "<i4")]).encode()
    if lp.dropped is not None:
        header += b"dropped" + np.ascontiguousarray(lp.dropped, dtype="<i8").tobytes()
    entries = rows.pointer[lp.pair_pointer]
    return digest(ranks, division, header, (
        ByCell(lp.cells, "<i8"),
        ByCell(lp.pair_pointer, "<i8", steps=True),
        ByCell(lp.control, "<i4", lp.pair_pointer),
        ByCell(lp.cost, "<f8", lp.pair_pointer),
        ByCell(rows.pointer, "<i8", lp.pair_pointer, steps=True),
        ByCell(rows.target, "<i8", entries, mesh.numbers if mesh else None),
        ByCell(rows.code, "<u4", entries),
        ByCell(lp.weight, "<f8"),
    ))  # fmt: skip


def _part(streams: Sequence[ByCell], a: int, b: int) -> list[bytes]:
    """Return the bytes of the own cells a..b-1, by stream."""
    found = []
    for array, kind, start, meant, steps in streams:
        i, k = (a, b) if start is None else (int(start[a]), int(start[b]))
        values = np.diff(array[i : k + 1]) if steps else array[i:k]
        values = values if meant is None else meant[values]
        found.append(np.ascontiguousarray(values, dtype=kind).tobytes())
    return found


def _hash(part: list[bytes]) -> bytes:
    sha = hashlib.sha256()
    for stream in part:
        sha.update(len(stream).to_bytes(8, "little"))
        sha.update(stream)
    return sha.digest()


def _packed(part: list[bytes]) -> NDArray[np.uint8]:
    sizes = np.array([len(part), *map(len, part)], dtype="<i8")
    return np.frombuffer(sizes.tobytes() + b"".join(part), dtype=np.uint8)


def _unpacked(array: NDArray[np.uint8]) -> list[bytes]:
    data = array.tobytes()
    count = int.from_bytes(data[:8], "little")
    sizes = np.frombuffer(data[8 : 8 * (count + 1)], dtype="<i8").tolist()
    ends = np.cumsum([8 * (count + 1), *sizes]).tolist()
    return [data[a:b] for a, b in itertools.pairwise(ends)]
