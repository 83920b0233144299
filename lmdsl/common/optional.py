"""Packages that are not needed by everyone: imported when something of theirs is asked for."""

from importlib import import_module
from typing import Any

from lmdsl.errors import MissingDependency


def installed(extra: str) -> str:
    """Return the commands that install what an extra names."""
    return f'pip install "lmdsl[{extra}]" (in a clone: pip install -e ".[{extra}]")'


def needed(package: str, what: str, extra: str) -> Any:
    """Import an optional package.

    Raises
    ------
    MissingDependency
        It is not installed; the message says what needs it, and which extra brings it.
    """
    try:
        return import_module(package)
    except ImportError:
        raise MissingDependency(f"{what} needs the package {package}: {installed(extra)}") from None
