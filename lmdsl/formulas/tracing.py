"""Recording arithmetic as formulas: code written for arrays, followed step by step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lmdsl.formulas.language import Formula
from lmdsl.formulas.parser import Subformula


class Recorder:
    """Notes what is done with its terms."""

    def __init__(self) -> None:
        self.subformulas: list[Subformula] = []

    def name(self, name: str) -> Term:
        """Return the term of a name."""
        return self._note(Subformula("name", name=name))

    def constant(self, value: float) -> Term:
        """Return the term of a number."""
        return self._note(Subformula("constant", value=value))

    def replay(self, formulas: Sequence[Formula], values: Mapping[str, Term]) -> tuple[Term, ...]:
        """Return the terms of formulas of some terms; other names stay names."""
        results = []
        for formula in formulas:
            terms: list[Term] = []
            for part in formula.subformulas:
                if part.name in values:
                    terms.append(values[part.name])
                else:
                    operands = tuple(terms[k].place for k in part.operands)
                    terms.append(self._note(part._replace(operands=operands)))
            results.append(terms[-1])
        return tuple(results)

    def formula(self, term: Term) -> Formula:
        """Return a term as a formula."""
        parts = tuple(self.subformulas[: term.place + 1])
        return Formula("", frozenset(part.name for part in parts if part.name), parts)

    def operation(self, operation: str, *operands: Term | float) -> Term:
        """Return the term of an operation."""
        places = tuple(
            (x if isinstance(x, Term) else self.constant(float(x))).place for x in operands
        )
        return self._note(Subformula(operation, places))

    def _note(self, part: Subformula) -> Term:
        self.subformulas.append(part)
        return Term(self, len(self.subformulas) - 1)


class Term:
    """A subformula, under the arithmetic that a method such as Runge-Kutta's needs."""

    def __init__(self, recorder: Recorder, place: int) -> None:
        self.recorder, self.place = recorder, place

    def __add__(self, other: Term | float) -> Term:
        return self.recorder.operation("+", self, other)

    def __mul__(self, other: Term | float) -> Term:
        return self.recorder.operation("*", self, other)

    def __rmul__(self, other: float) -> Term:
        return self.recorder.operation("*", other, self)
