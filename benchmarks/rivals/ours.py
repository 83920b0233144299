"""lmdsl: the solve that compares with the rivals', and the rest of the way to an answer."""

from __future__ import annotations

from typing import Any

from benchmarks.arrays import Arrays
from benchmarks.rivals.base import Contestant

CONTESTANTS = [
    Contestant("lmdsl", __name__, "backend", accuracy=1e-9, note="policy iteration, solve only"),
    Contestant(
        "lmdsl, certified", __name__, "pipeline", accuracy=1e-9,
        note="solve, tie-breaking and certificate",
    ),
    Contestant(
        "lmdsl, compile", __name__, "compile", at="own", note="assembly and stabilizable set"
    ),
]  # fmt: skip


class Solver:
    """A cold LP for every solve: nothing remembered from the last one."""

    def __init__(self, model: Arrays, algorithm: str) -> None:
        import lmdsl as lm
        from benchmarks import internals, models

        self.cold = internals.cold
        self.lm, self.model, self.algorithm = lm, model, algorithm
        self.lp = models.get(model.name).compiled(model.gamma)
        self._check(self.lp)
        if algorithm == "compile" and not isinstance(models.get(model.name).make(), lm.Problem):
            raise NotImplementedError("the model has no dynamics to compile")
        self.found: Any = None

    def _check(self, lp: Any) -> None:
        if lp.digest != self.model.digest:
            raise RuntimeError("lmdsl compiled another model than the rivals got")

    def renew(self) -> None:
        self.found = None
        self.lp = self.cold(self.lp)

    def solve(self) -> None:
        if self.algorithm == "compile":
            self.found = self.lm.compile(self.lp.problem)
        elif self.algorithm == "pipeline":
            self.found = self.lm.solve(self.lp)
        else:
            backend = self.lm.backends.get("policy-iteration")
            self.found = backend.solve(self.lp, self.lm.backends.Options())

    def value(self) -> Any:
        if self.algorithm == "compile":
            self._check(self.found)
            return None
        if self.algorithm == "pipeline":
            return self.found.value[self.lp.cells]
        return self.found.value
