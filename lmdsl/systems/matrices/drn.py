"""Storm's explicit format (DRN): a Markov chain or decision process as a text file.

Numbers are read as they are written, ``1/3`` and ``0.1`` exactly. Actions are numbered by their
names where these are whole numbers wherever there is a choice, as lmdsl writes them; else by their
place in the state.
"""

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np

from lmdsl.common.files import open_regular, reason
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory
from lmdsl.systems.matrices.layouts import doubles
from lmdsl.systems.matrices.listing import Listing, fill

NUMBER = re.compile(r"[+-]?\d{1,400}(\.\d{0,400})?([eE][+-]?\d{1,3})?(/\d{1,400})?")
BYTES = 40
"""Bytes of memory for each of the file."""


@dataclass
class Explicit:
    """What a file says, as it is read."""

    rewards: list[str] = field(default_factory=list)
    labels: dict[str, list[int]] = field(default_factory=dict)
    states: int = 0
    state: list[int] = field(default_factory=list)
    name: list[str] = field(default_factory=list)
    cost: list[Fraction] = field(default_factory=list)
    pair: list[int] = field(default_factory=list)
    target: list[int] = field(default_factory=list)
    share: list[Fraction] = field(default_factory=list)
    decimal: bool = False
    told: dict[str, tuple[int, str]] = field(default_factory=dict)  # lines of the header


def read_drn(path: str | os.PathLike[str], reward: str | None) -> tuple[Listing, Explicit]:
    """Read a DRN file; the cost is that of a reward model, which may be left out if it is alone.

    Raises
    ------
    BadInput
        The file cannot be read, is of another kind, or has no such reward model.
    """
    try:
        with open_regular(Path(path)) as file:
            memory.require(BYTES * os.fstat(file.fileno()).st_size, "a DRN file")
            lines = (line.decode("utf-8", "replace") for line in file)
            found = _read(enumerate(lines, 1), reward)
    except OSError as error:
        raise BadInput(f"cannot read {shown(str(path), 200)}: {reason(error)}", "P") from None
    if not found.state:
        raise BadInput("the file holds no state with an action", "P")
    action = _actions(found)
    return Listing(
        states=found.states,
        actions=max(action) + 1,
        state=np.array(found.state, dtype=np.int64),
        action=np.array(action, dtype=np.int64),
        pair=np.array(found.pair, dtype=np.int64),
        target=np.array(found.target, dtype=np.int64),
        share=fill(len(found.share), lambda x: x, found.share),
        of_pair=doubles(fill(len(found.cost), lambda x: x, found.cost), "cost"),
        decimal=found.decimal,
        labels=found.labels,
    ), found


Numbered = Iterator[tuple[int, str]]


def _read(lines: Numbered, reward: str | None) -> Explicit:
    found, kind = Explicit(), ""
    for number, line in lines:
        words = line.split()
        if not words or words[0].startswith("//"):
            continue
        if words[0] == "@type:":
            kind = words[-1].upper()
            if kind not in ("MDP", "DTMC"):
                raise _fault(number, f"the type is {shown(kind)}; only MDP and DTMC are read")
        elif words[0] == "@parameters":
            if next(lines, (0, ""))[1].strip():
                raise _fault(number, "parameters have no values; instantiate the model first")
        elif words[0] == "@reward_models":
            found.rewards = next(lines, (0, ""))[1].split()
        elif words[0] in ("@nr_states", "@nr_choices", "@value_type:"):
            if words[0][-1] != ":":
                found.told[words[0]] = next(lines, (number, ""))
        elif words[0] == "@model":
            break
        else:
            raise _fault(number, f"{shown(words[0])} is not expected here")
    if not kind:
        raise BadInput("the file does not begin as DRN: it names no @type", "P")
    _read_states(lines, found, _place(found.rewards, reward))
    _require_told(found)
    return found


def _require_told(found: Explicit) -> None:
    """Refuse a file whose header counts something else than there is."""
    for header, count, of in (
        ("@nr_states", found.states, "states"),
        ("@nr_choices", len(found.state), "choices"),
    ):
        number, told = found.told.get(header, (0, str(count)))
        if told.strip() != str(count):
            says = f"{header} says {shown(told.strip())}, but the file has {count} {of}"
            raise _fault(number, says)


def _place(models: list[str], wanted: str | None) -> int:
    if wanted is not None:
        if wanted not in models:
            raise BadInput(
                f"{shown(wanted)} is no reward model of the file; it has {models or 'none'}", "cost"
            )
        return models.index(wanted)
    if len(models) > 1:
        raise BadInput(f"the file has the reward models {models}; name one", "cost")
    return 0


def _read_states(lines: Numbered, found: Explicit, place: int) -> None:
    # Where none is named there may be one all the same: Storm's without a name.
    own, rewards = Fraction(0), len(found.rewards) or 1
    for number, line in lines:
        words = line.split("//")[0].replace("[", " [ ").replace("]", " ] ").split()
        if not words:
            continue
        if words[0] == "state" and len(words) > 1:
            if words[1] != str(found.states):
                raise _fault(number, f"state {shown(words[1])} where {found.states} is expected")
            own, rest = _bracket(words[2:], place, rewards, number)
            for label in rest:
                found.labels.setdefault(label.strip('"'), []).append(found.states)
            found.states += 1
        elif words[0] == "action" and len(words) > 1 and found.states:
            paid, rest = _bracket(words[2:], place, rewards, number)
            if rest:
                raise _fault(number, f"{shown(rest[0])} is not expected here")
            found.state.append(found.states - 1)
            found.name.append(words[1])
            found.cost.append(own + paid)
        elif len(words) == 3 and words[1] == ":" and found.state:
            found.pair.append(len(found.state) - 1)
            found.target.append(_whole(words[0], number))
            found.share.append(_number(words[2], number))
            found.decimal |= "." in words[2] or "e" in words[2].lower()
        else:
            raise _fault(number, f"{shown(line.strip(), 80)} is not read")


def _bracket(words: list[str], place: int, count: int, number: int) -> tuple[Fraction, list[str]]:
    """Return the reward in brackets, 0 without, and the words behind."""
    if words[:1] != ["["]:
        return Fraction(0), words
    if "]" not in words:
        raise _fault(number, "a bracket is not closed")
    end = words.index("]")
    inside = "".join(f"{word} " for word in words[1:end]).replace(",", " ").split()
    if not inside:
        return Fraction(0), words[end + 1 :]
    if len(inside) != count:
        more = "; give each a name" * (len(inside) > count)
        raise _fault(number, f"{len(inside)} rewards for {count} reward models{more}")
    return _number(inside[place], number), words[end + 1 :]


def _actions(found: Explicit) -> list[int]:
    """Return the number of every action."""
    alone = np.bincount(found.state)[found.state] == 1
    names = zip(found.name, alone.tolist(), strict=True)
    numbered = all(only or (_is_number(name)) for name, only in names)
    action, last, place = [], -1, 0
    for state, name in zip(found.state, found.name, strict=True):
        place = place + 1 if state == last else 0
        last = state
        by_name = numbered and _is_number(name)
        action.append(int(name) if by_name else place)
    return action


def _is_number(name: str) -> bool:
    """Return whether an action is named by a number that can be its index."""
    return len(name) < 7 and name.isascii() and name.isdecimal()


def _whole(text: str, number: int) -> int:
    if len(text) > 10 or not (text.isascii() and text.isdecimal()):
        raise _fault(number, f"there is no state {shown(text)}")
    return int(text)


def _number(text: str, number: int) -> Fraction:
    if not NUMBER.fullmatch(text):
        raise _fault(number, f"{shown(text)} is no number")
    above, _, below = text.partition("/")
    if below and not int(below):
        raise _fault(number, f"{shown(text)} divides by 0")
    return Fraction(above) / (Fraction(below) if below else 1)


def _fault(number: int, text: str) -> BadInput:
    return BadInput(f"line {number}: {text}", "P")


def labelled(found: Explicit, labels: list[str]) -> list[int]:
    """Return the states with any of some labels."""
    for label in labels:
        if label not in found.labels:
            raise BadInput(
                f"no state has the label {shown(label)}; the file has {sorted(found.labels)}",
                "targets",
            )
    return sorted({state for label in labels for state in found.labels[label]})
