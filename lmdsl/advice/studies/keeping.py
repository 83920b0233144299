"""The folder of a study: every finished variant is kept, so that a study goes on where it ended.

``study.json`` holds the rows under the SHA-256 of what was asked for: the variant as a problem
file, the backend and the options. ``variants/KEY`` are result directories, KEY the first digits.
"""

import csv
import hashlib
import io
import json
import math
import os
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

from lmdsl.advice.studies.record import Study, StudyRow
from lmdsl.common import inputs
from lmdsl.common.files import parsed, read_bytes, reason, write_whole
from lmdsl.errors import BadInput, shown
from lmdsl.problem.problem import Problem
from lmdsl.results.result import Result

FORMAT = "lmdsl-study/1"
NAME, VARIANTS = "study.json", "variants"
DIGITS = 16  # of the key in the name of a directory
MAY_BE_INFINITE = ("cost", "gap")  # fields whose infinity stands as text in the file


class Folder:
    """Where a study is kept."""

    def __init__(self, path: str | os.PathLike[str], options: dict[str, Any]) -> None:
        self.path, self.options = inputs.path(path, "out"), options
        self.file = self.path / NAME
        self.rows = self._known()

    def key(self, problem: Problem, backend: str) -> str:
        """Return what a variant is known by."""
        asked = {"problem": problem.to_dict(), "backend": backend, **self.options}
        return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()

    def add(self, key: str, row: StudyRow, result: Result | None) -> None:
        """Keep a finished variant: its result first, so that a row that is there has one."""
        if result is not None and result.lp is not None:
            (self.path / VARIANTS).mkdir(parents=True, exist_ok=True)
            result.save(self.place(key))
        self.path.mkdir(parents=True, exist_ok=True)
        self.rows[key] = row
        content = {"format": FORMAT, "rows": {k: r.to_dict() for k, r in self.rows.items()}}
        write_whole(self.file, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())

    def place(self, key: str) -> Path:
        """Return the result directory of a variant."""
        return self.path / VARIANTS / key[:DIGITS]

    def result(self, key: str) -> Result | None:
        """Return the result of a variant, None where there is none to read."""
        try:
            return Result.load(self.place(key))
        except BadInput:
            return None

    def write_table(self, study: Study) -> None:
        """Write the rows as comma-separated values."""
        text, records = io.StringIO(), study.records()
        table = csv.DictWriter(text, list(records[0]))
        table.writeheader()
        table.writerows(records)
        write_whole(self.path / "study.csv", text.getvalue().encode())

    def _known(self) -> dict[str, StudyRow]:
        """Return the rows that are there; BadInput where the folder is no study's."""
        text = shown(str(self.path), 200)
        try:
            there = self.path.exists()
            foreign = there and not self.file.exists() and bool(os.listdir(self.path))
        except OSError as error:
            raise BadInput(f"cannot use {text}: {reason(error)}", "out") from None
        if foreign:
            raise BadInput(f"{text} is not empty and holds no study; choose another name", "out")
        if not self.file.exists():
            return {}
        data = parsed(self.file, read_bytes(self.file), null=True)
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise BadInput(f'it is no study: its format is not "{FORMAT}"', NAME)
        rows = data.get("rows")
        if not isinstance(rows, dict):
            raise BadInput("rows are missing", NAME)
        return {key: _row(value, f"{NAME}: rows.{key[:DIGITS]}") for key, value in rows.items()}


def _row(data: Any, where: str) -> StudyRow:
    """Return a row that was kept; BadInput where it is none."""
    names, kinds = [f.name for f in fields(StudyRow)], get_type_hints(StudyRow)
    if not isinstance(data, dict) or {*data, "attractor"} != set(names):
        raise BadInput("its keys are not those of a row; remove the folder to start anew", where)
    found = {"attractor": None, **data}  # which came later
    if isinstance(found["interval"], list):
        found["interval"] = tuple(found["interval"])
    for name in names:
        if not _fits(name, found[name], kinds[name]):
            raise BadInput(f"{shown(found[name])} is not accepted", f"{where}.{name}")
    for name in MAY_BE_INFINITE:
        found[name] = math.inf if found[name] == "inf" else found[name]
    return StudyRow(**found)


def _fits(name: str, value: Any, kind: Any) -> bool:
    """Return whether plain data fit a field and its type."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind == dict[str, int]:
        return isinstance(value, dict) and bool(value) and all(
            isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in value.values()
        )  # fmt: skip
    if kind == tuple[float, float] | None:
        return value is None or (
            isinstance(value, tuple) and len(value) == 2
            and all(isinstance(x, int | float) and not isinstance(x, bool) for x in value)
        )  # fmt: skip
    if kind is str:
        return isinstance(value, str)
    if kind is float:
        return number
    if kind == float | None:
        return value is None or number or (value == "inf" and name in MAY_BE_INFINITE)
    return value is None or (isinstance(value, int) and not isinstance(value, bool))
