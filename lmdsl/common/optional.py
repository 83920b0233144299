"""Packages that are not needed by everyone: imported when something of theirs is asked for."""

from importlib import import_module
from typing import Any

from lmdsl.errors import MissingDependency


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
        raise MissingDependency(
            f"{what} needs the package {package}; pip install 'lmdsl[{extra}]'"
        ) from None
