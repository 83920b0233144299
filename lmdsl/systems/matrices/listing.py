"""What every layout of matrices is read into: pairs, and the transitions of each."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.errors import BadInput, printable

MOST = 2**31 - 2
"""States, actions and pairs at most."""


@dataclass(frozen=True, eq=False)
class Listing:
    """Pairs of a state and an action, and the transitions of each, as they were given."""

    states: int
    actions: int
    state: Indices  # of each pair, shape (K,)
    action: Indices
    pair: Indices  # of each transition, shape (E,)
    target: Indices
    share: NDArray[Any]  # doubles, or Fractions as objects
    value: Floats | None = None  # cost or reward of each transition
    of_pair: Floats | None = None  # cost or reward of each pair
    ends: Bools | None = None  # transitions that end the run
    decimal: bool = False  # the fractions were written as decimals, which may be rounded
    labels: Mapping[str, Sequence[int]] = field(default_factory=dict)  # states by label

    def ordered(self) -> Self:
        """Return the same by state, then action; transitions by target, those of share 0 dropped.

        Raises
        ------
        BadInput
            A pair stands twice, an index is out of range, or a share is negative or no number.
        """
        self._in_range()
        order = np.lexsort((self.action, self.state))
        state, action = self.state[order], self.action[order]
        twice = np.flatnonzero((np.diff(state) == 0) & (np.diff(action) == 0))
        if len(twice):
            raise BadInput(f"{self.name(order[twice[0]])} stands twice; keep one", "P")
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        kept = np.flatnonzero(self.share != 0)
        pair = place[self.pair[kept]]
        last = np.zeros(len(kept), dtype=np.bool_) if self.ends is None else self.ends[kept]
        target = np.where(last, self.states, self.target[kept])  # one more state, for all that end
        within = np.lexsort((target, pair))
        kept = kept[within]
        return replace(
            self,
            state=state,
            action=action,
            pair=pair[within],
            target=target[within],
            share=self.share[kept],
            value=None if self.value is None else self.value[kept],
            of_pair=None if self.of_pair is None else self.of_pair[order],
            ends=None if self.ends is None else last[within],
        )

    def name(self, k: int) -> str:
        """Return how messages name a pair."""
        state = int(self.state[k])
        labels = [label for label, states in self.labels.items() if state in states]
        told = f" ({printable(', '.join(labels[:4]))[:80]})" if labels else ""
        return f"state {state}{told}, action {int(self.action[k])}"

    def _in_range(self) -> None:
        for what, index, count in (
            ("state", self.state, self.states),
            ("action", self.action, self.actions),
            ("state", self.target, self.states),
        ):
            outside = (index < 0) | (index >= count)
            if outside.any():
                wrong = int(index[np.flatnonzero(outside)[0]])
                raise BadInput(f"there is no {what} {wrong}; they are 0..{count - 1}", "P")
        if self.share.dtype == np.float64:
            self._refuse_where(~np.isfinite(self.share), "is no number")
        self._refuse_where(self.share < 0, "is negative")

    def _refuse_where(self, wrong: Bools, what: str) -> None:
        if np.any(wrong):
            e = int(np.flatnonzero(wrong)[0])
            where = f"{self.name(self.pair[e])}, to state {int(self.target[e])}"
            raise BadInput(f"{where}: the probability {self.share[e]!s} {what}", "P")


def fill(count: int, of: Callable[[Any], Any], values: Any) -> NDArray[Any]:
    """Return an array of objects."""
    array = np.empty(count, dtype=object)
    array[:] = [of(value) for value in values]
    return array
