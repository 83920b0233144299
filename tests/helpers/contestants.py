"""What the fake rivals come to; importing this makes `benchmarks` importable."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

FATES = {
    "behaves": "ok",
    "prints": "ok",
    "is slow": "ok",
    "lies": "wrong value",
    "lies later": "wrong value",
    "returns nan": "wrong value",
    "returns too few": "wrong value",
    "raises": "failed: ZeroDivisionError: by nothing",
    "cannot build": "failed: MemoryError: no room",
    "is unable": "not supported: NotImplementedError: not this form",
    "exits": "failed: exited with status 3",
    "is killed": "failed: killed, probably for want of memory",
    "hangs": "> 3 s",
    "hangs later": "> 3 s",
}
