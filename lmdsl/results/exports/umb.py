"""The finite model as a unified Markov binary (UMB), which Storm, PRISM and Modest read.

A tar archive: ``index.json``, and arrays of little-endian numbers. States, actions and costs are
those of DRN, see markov.py. Probabilities are exact: a numerator and a denominator of 64 bits each,
or of as many times more as it takes; costs are doubles, as they are.
"""

import json
import os
import tarfile
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.files import write_whole
from lmdsl.common.types import Bools
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.lp import StabilizationLP
from lmdsl.results.directory.writing import refuse_own_file
from lmdsl.results.exports.markov import exact_row, last_states, require_model
from lmdsl.results.result import Result

WORD = 64  # bits of a word
FOLDERS = {"aps": "annotations/aps", "rewards": "annotations/rewards", "actions": "actions/choices"}


@own_arithmetic
def export_umb(lp: StabilizationLP, path: str | os.PathLike[str]) -> None:
    """Write the finite model as a unified Markov binary; only for gamma = 1.

    Parameters
    ----------
    lp
        The finite model; its gamma must be 1.
    path
        The file to write; it appears whole or not at all.

    Notes
    -----
    The same model as :func:`export_drn` writes as text: the reward is ``cost``, the labels are
    ``attractor``, with a discount ``ended``; where m > 0 a state is initial.

    Raises
    ------
    BadInput
        Gamma is not 1, C is empty, no cell of C has m > 0, or the file cannot be written.
    """
    require_model(lp)
    refuse_own_file(inputs.path(path))
    write_whole(inputs.path(path), _archive(_contents(lp)))


def write(result: Result, lp: StabilizationLP, path: str) -> None:
    """Write the model of a result for ``lmdsl export``."""
    export_umb(lp, path)


def _contents(lp: StabilizationLP) -> dict[str, bytes]:
    """Return the files of the archive, the index first."""
    last, rows = last_states(lp), [exact_row(lp, k) for k in range(lp.K)]
    rows += [[(j, Fraction(1))] for j in last]
    states, choices = lp.n + len(last), len(rows)
    shares = [share for row in rows for _, share in row]
    bits = _bits(shares)
    names = [str(i) for i in range(len(lp.controls))] + ["stay"]
    start = np.zeros(states, dtype=np.bool_)
    start[: lp.n] = lp.weight > 0
    files = {
        "state-to-choices.bin": _words([*lp.pair_pointer, *range(lp.K + 1, choices + 1)]),
        "state-is-initial.bin": _bitset(start),
        "choice-to-branches.bin": _words(np.cumsum([0, *map(len, rows)])),
        "branch-to-target.bin": _words([j for row in rows for j, _ in row]),
        "branch-to-probability.bin": b"".join(_rational(share, bits) for share in shares),
        f"{FOLDERS['actions']}/values.bin": np.append(
            lp.control, np.full(len(last), len(lp.controls))
        ).astype("<u4").tobytes(),
        f"{FOLDERS['actions']}/string-mapping.bin": _words(np.cumsum([0, *map(len, names)])),
        f"{FOLDERS['actions']}/strings.bin": "".join(names).encode(),
        f"{FOLDERS['rewards']}/cost/choices/values.bin": np.append(
            lp.cost, np.zeros(len(last))
        ).astype("<f8").tobytes(),
    }  # fmt: skip
    for j, label in last.items():
        files[f"{FOLDERS['aps']}/{label}/states/values.bin"] = _bitset(np.arange(states) == j)
    counts = {
        "states": states,
        "initial-states": int(start.sum()),
        "choices": choices,
        "choice-actions": len(names),
        "branches": len(shares),
    }
    index = _index(lp, counts, bits, list(last.values()))
    return {"index.json": json.dumps(index, indent=1).encode(), **files}


def _index(
    lp: StabilizationLP, counts: dict[str, int], bits: int, labels: list[str]
) -> dict[str, Any]:
    from lmdsl import __version__

    assumes = lp.problem.system.assumes
    return {
        "format-version": 0,
        "format-revision": 0,
        "model-data": {
            "name": lp.problem.name or "unnamed",
            "comment": f"model {lp.digest}" + (f"; assumed: {assumes}" if assumes else ""),
        },
        "file-data": {"tool": "lmdsl", "tool-version": __version__},
        "transition-system": {
            "time": "discrete",
            "#players": 1,
            **{f"#{name}": count for name, count in counts.items()},
            "#branch-actions": 0,
            "#observations": 0,
            "branch-probability-type": {"type": "rational", "size": bits},
        },
        "annotations": {
            "rewards": {
                "cost": {
                    "alias": "cost",
                    "applies-to": ["choices"],
                    "type": {"type": "double", "size": 64},
                }
            },
            "aps": {
                label: {
                    "alias": label,
                    "applies-to": ["states"],
                    "type": {"type": "bool", "size": 1},
                }
                for label in labels
            },
        },
    }


def _words(numbers: Any) -> bytes:
    return np.asarray(numbers, dtype="<u8").tobytes()


def _bitset(mask: Bools) -> bytes:
    """Return bits, lowest first, filled up to whole words."""
    packed = np.packbits(mask, bitorder="little").tobytes()
    return packed.ljust(-(-len(mask) // WORD) * 8, b"\0")


def _bits(shares: list[Fraction]) -> int:
    """Return the size of a numerator (signed) and a denominator in bits, a multiple of 128."""
    most = max(max(share.numerator.bit_length() + 1, share.denominator.bit_length())
               for share in shares)  # fmt: skip
    return -(-most // WORD) * WORD * 2


def _rational(share: Fraction, bits: int) -> bytes:
    half = bits // 16
    numerator = share.numerator.to_bytes(half, "little", signed=True)
    return numerator + share.denominator.to_bytes(half, "little")


def _archive(contents: dict[str, bytes]) -> Iterator[bytes]:
    """Yield a tar archive of files, the same for the same files."""
    written = 0
    for name, content in contents.items():
        entry = tarfile.TarInfo(name)
        entry.size = len(content)
        head = entry.tobuf(format=tarfile.USTAR_FORMAT)
        filled = content.ljust(-(-len(content) // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE, b"\0")
        written += len(head) + len(filled)
        yield head
        yield filled
    yield b"\0" * (-(-(written + 2 * tarfile.BLOCKSIZE) // tarfile.RECORDSIZE)
                   * tarfile.RECORDSIZE - written)  # fmt: skip
