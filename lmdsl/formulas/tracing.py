"""Recording arithmetic as formulas: code written for arrays, followed step by step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lmdsl.formulas.language import Formula, Step


class Recorder:
    """Notes what is done with its terms."""

    def __init__(self) -> None:
        self.steps: list[Step] = []

    def name(self, name: str) -> Term:
        """Return the term of a name."""
        return self._note(Step("name", name=name))

    def replay(self, formulas: Sequence[Formula], values: Mapping[str, Term]) -> tuple[Term, ...]:
        """Return the terms of formulas of some terms; other names stay names."""
        results = []
        for formula in formulas:
            terms: list[Term] = []
            for step in formula.steps:
                if step.name in values:
                    terms.append(values[step.name])
                else:
                    operands = tuple(terms[k].place for k in step.operands)
                    terms.append(self._note(step._replace(operands=operands)))
            results.append(terms[-1])
        return tuple(results)

    def formula(self, term: Term) -> Formula:
        """Return a term as a formula."""
        steps = tuple(self.steps[: term.place + 1])
        return Formula("", frozenset(step.name for step in steps if step.name), steps)

    def operation(self, operation: str, *operands: Term | float) -> Term:
        """Return the term of an operation."""
        places = tuple(
            (x if isinstance(x, Term) else self._note(Step("constant", value=float(x)))).place
            for x in operands
        )
        return self._note(Step(operation, places))

    def _note(self, step: Step) -> Term:
        self.steps.append(step)
        return Term(self, len(self.steps) - 1)


class Term:
    """The result of a step, under the arithmetic that a method such as Runge-Kutta's needs."""

    def __init__(self, recorder: Recorder, place: int) -> None:
        self.recorder, self.place = recorder, place

    def __add__(self, other: Term | float) -> Term:
        return self.recorder.operation("+", self, other)

    def __mul__(self, other: Term | float) -> Term:
        return self.recorder.operation("*", self, other)

    def __rmul__(self, other: float) -> Term:
        return self.recorder.operation("*", other, self)
