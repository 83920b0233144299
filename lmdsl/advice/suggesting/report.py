"""What a suggestion says: what to write, what it changes, and why."""

import json
from dataclasses import dataclass, fields
from typing import Any

from lmdsl.advice.suggesting.pilots import Attempt, plain
from lmdsl.common import html
from lmdsl.common.records import Reported, jsonable
from lmdsl.problem.problem import Problem


@dataclass(frozen=True)
class Suggestion(Reported):
    """Step, cells and samples that serve better, as far as trials show.

    Attributes
    ----------
    problem
        The problem with what is suggested; as it was, where nothing better was found.
    better
        Whether something better was found.
    changes
        What to write: ``step``, ``substeps``, ``cells`` of each axis, ``sampling``, ``attractor``,
        as far as they change.
    before, after
        What becomes of the problem as it was, and as is suggested: by trials of its own size where
        ``whole``, else of smaller ones.
    whole
        Whether the two were tried on about as many cells as the problem has, with all controls.
    reasons
        Why, a sentence each.
    pilots
        All trials, in their order.
    cut
        Whether the time was up before the search was at its end.
    """

    problem: Problem
    better: bool
    changes: dict[str, Any]
    before: Attempt
    after: Attempt
    whole: bool
    reasons: tuple[str, ...]
    pilots: tuple[Attempt, ...]
    cut: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data: every field but the problem, whose changes are there."""
        names = [f.name for f in fields(self) if f.name != "problem"]
        return {name: jsonable(getattr(self, name)) for name in names}

    def text(self) -> str:
        """Return the suggestion for people."""
        count = f"{len(self.pilots)} trial{'s' * (len(self.pilots) != 1)}"
        cut = ", then the time was up" * self.cut
        if not self.better:
            lines = [f"suggestion: nothing better was found in {count}{cut}", f"  {self.before}"]
            return "\n".join([*lines, *(f"  {reason}" for reason in self.reasons)])
        lines = ["suggestion: write"]
        lines += [f"  {_short(key, value)}" for key, value in self.changes.items()]
        size = "" if self.whole else ", on fewer cells"
        lines += [f"as declared{size}: {self.before}", f"as suggested{size}: {self.after}"]
        lines += [f"why: {self.reasons[0]}", *(f"     {reason}" for reason in self.reasons[1:])]
        return "\n".join([*lines, f"({count}{cut})"])

    __str__ = text

    def _repr_html_(self) -> str:
        rows = [(key, json.dumps(value)) for key, value in self.changes.items()]
        rows += [("as declared", str(self.before))]
        rows += [("as suggested", str(self.after)), ("why", "\n".join(self.reasons))] * self.better
        return html.facts(rows, "Suggestion" if self.better else "Nothing better was found")


def _short(key: str, value: Any) -> str:
    if key == "cells":
        return ", ".join(f'"cells": {count} for {name}' for name, count in value.items())
    return f'"{key}": {json.dumps(value)}' + " in system" * (key in ("step", "substeps"))


def changes(old: Problem, new: Problem) -> dict[str, Any]:
    """Return what to write in a problem file to make of one problem the other."""
    found: dict[str, Any] = {}
    for key in ("step", "substeps"):
        value = getattr(new.system, key, None)
        if value != getattr(old.system, key, None):
            found[key] = value
    if old.state_box != new.state_box:
        found["cells"] = {name: axis.cells for name, axis in new.state_box.items()}
    if old.sampling != new.sampling:
        found["sampling"] = plain(new.sampling)
    if old.attractor != new.attractor:
        data = new.attractor.model_dump(mode="json", exclude_none=True)
        found["attractor"] = {key: value for key, value in data.items() if value}
    return found
