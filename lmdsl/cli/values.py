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
