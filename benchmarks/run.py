"""One run: what was asked, what has been measured so far, and how to measure more, once each."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import machine, models
from benchmarks.measure import Row, Rules, contest, prepared
from benchmarks.process import Failed, call
from benchmarks.report import write
from benchmarks.rivals import Contestant, chosen

DISCOUNT = 0.99
"""The gamma of the rivals that need one below 1."""


@dataclass
class Run:
    """A run and its results; the report is written anew after every measurement.

    Attributes
    ----------
    out
        Folder of ``results.json`` and ``results.md``.
    rules
        How contests are held.
    contestants
        Who takes part.
    """

    out: Path
    rules: Rules
    contestants: list[Contestant]
    log: Callable[[str], None] = print
    about: dict[str, Any] = field(default_factory=machine.facts)
    groups: dict[str, dict[str, Any]] = field(default_factory=dict)
    micro: dict[str, dict[str, Any]] = field(default_factory=dict)
    pipelines: dict[str, dict[str, Any]] = field(default_factory=dict)
    targets: list[dict[str, Any]] = field(default_factory=list)
    over_ranks: list[dict[str, Any]] = field(default_factory=list)
    exceeded: dict[tuple[str, str, float], str] = field(default_factory=dict)

    def group(
        self, name: str, gamma: float, contestants: list[Contestant] | None = None
    ) -> list[dict[str, Any]]:
        """Return the rows of a contest on a model at a gamma; hold it if that was not done yet."""
        key = f"{name} at {gamma:g}"
        if key not in self.groups:
            model = models.get(name)
            among = self.contestants if contestants is None else contestants
            taking_part = [one for one in among if one.serves(gamma, model.gamma)]
            self.groups[key] = self._contest(model, gamma, taking_part)
            self.save()
        return list(self.groups[key]["rows"])

    def _contest(
        self, model: models.Model, gamma: float, contestants: list[Contestant]
    ) -> dict[str, Any]:
        def key(name: str) -> tuple[str, str, float]:
            return name, model.family, gamma

        with tempfile.TemporaryDirectory(prefix="benchmarks-") as folder:
            try:
                facts = prepared(model.name, gamma, Path(folder), 2 * self.rules.limit)
            except Failed as error:
                self.log(f"{model.name}, gamma {gamma:g}: {error}")
                return {"model": model.name, "gamma": gamma, "failed": str(error), "rows": []}
            fit = [one for one in contestants if key(one.name) not in self.exceeded]
            rows = contest(facts, fit, Path(folder), self.rules, self.log)
        for row in rows:
            if row.status.startswith((">", "failed: killed")):
                self.exceeded[key(row.contestant)] = model.name
        for one in contestants:
            if one not in fit:
                smaller = self.exceeded[key(one.name)]
                note = f"not tried: exceeded its limits on {smaller}"
                rows.append(Row(one.name, f"> {self.rules.limit:g} s", note))
        return {**facts, "rows": [asdict(row) for row in rows]}

    def rivals(self, name: str) -> None:
        """Hold the contests of a model: at its own gamma, at 1, and discounted."""
        for gamma in sorted({models.get(name).gamma, 1.0, DISCOUNT}, reverse=True):
            self.group(name, gamma)

    def among(self, *words: str) -> list[Contestant]:
        """Return lmdsl and the contestants with these words in their names."""
        return chosen(list(words))

    def stages(self, name: str) -> dict[str, Any]:
        """Return the microbenchmarks of a model."""
        if name not in self.micro:
            self.log(f"{name}: microbenchmarks")
            self.micro[name] = self._called("benchmarks.micro:measure", name, self.rules.repeats)
            self.save()
        return self.micro[name]

    def pipeline(
        self, name: str, gamma: float | None = None, repeats: int = 1, processes: int = 1
    ) -> dict[str, Any]:
        """Return compile, solve and verify of a model, in fresh processes one after the other."""
        key = name if gamma is None else f"{name} at {gamma:g}"
        if key not in self.pipelines:
            self.log(f"{key}: compile, solve and verify")
            found = [
                self._called("benchmarks.pipeline:run", name, gamma, repeats)
                for _ in range(processes)
            ]
            self.pipelines[key] = _joined(found)
            self.save()
        return self.pipelines[key]

    def bracket(self, name: str, width: float) -> dict[str, Any]:
        """Return the times of enclosing gamma_bar of a model to a relative width."""
        self.log(f"{name}: gamma_bar to {width:g}")
        return self._called("benchmarks.pipeline:bracket", name, width, self.rules.repeats)

    def _called(self, function: str, *arguments: Any) -> dict[str, Any]:
        try:
            result: dict[str, Any] = call(function, *arguments, limit=2 * self.rules.limit)
        except Failed as error:
            self.log(str(error))
            return {"model": arguments[0], "failed": str(error)}
        return result

    def results(self) -> dict[str, Any]:
        """Return everything as data."""
        return {
            "about": self.about,
            "rules": asdict(self.rules),
            "targets": self.targets,
            "groups": list(self.groups.values()),
            "micro": list(self.micro.values()),
            "pipelines": list(self.pipelines.values()),
            "over_ranks": self.over_ranks,
        }

    def save(self) -> None:
        """Write both files."""
        write(self.out, self.results())


def _joined(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Join the same pipeline of several processes: all times, the largest peak."""
    failed = next((one for one in found if "failed" in one), None)
    if failed is not None:
        return failed
    stages = found[0]["seconds"]
    return {
        **found[0],
        "seconds": {stage: [t for one in found for t in one["seconds"][stage]] for stage in stages},
        "peak": max(one["peak"] for one in found),
    }
