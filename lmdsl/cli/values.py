"""Values on the command line: lists of numbers, and numbers by name."""

from collections.abc import Sequence

from lmdsl.errors import BadInput, shown


def number(text: str, where: str) -> float:
    """Return a number that was written."""
    try:
        return float(text)
    except ValueError:
        raise BadInput(f"{shown(text)} is not a number", where) from None


def states(text: str) -> list[float]:
    """Return the numbers of a state, written ``0.1,0.2`` in the order of the axes."""
    return [number(part, "--from") for part in text.split(",")]


def parameters(given: Sequence[str]) -> dict[str, float] | None:
    """Return values by name, each written ``NAME=VALUE``; None where none is given."""
    found = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals:
            raise BadInput(f"{shown(text)} is not NAME=VALUE, such as mu=1.1", "--parameter")
        found[name.strip()] = number(value, "--parameter")
    return found or None


def numbers(text: str, where: str, whole: bool = False) -> list[float] | list[int]:
    """Return numbers that were written with commas between them."""
    if not whole:
        return [number(part, where) for part in text.split(",")]
    return [_count(part, where) for part in text.split(",")]


def counts(text: str, where: str) -> list[int | list[int]]:
    """Return counts, each one number or one of each axis: ``32,12x24``."""
    found: list[int | list[int]] = []
    for part in text.split(","):
        each = [_count(n, where) for n in part.lower().split("x")]
        found.append(each if len(each) > 1 else each[0])
    return found


def _count(text: str, where: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise BadInput(f"{shown(text)} is not a whole number", where) from None
