"""The registry of backends: four of our own, any number by entry point ``lmdsl.backends``.

An entry point names a :class:`Backend`. Nothing is imported before it is asked for.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from importlib.util import find_spec

from lmdsl.backends.base import Backend, Capabilities, Options, Solution, Stop
from lmdsl.errors import BadInput, MissingDependency, shown

BUILT_IN = {
    "policy-iteration": "lmdsl.backends.policy_iteration",
    "highs": "lmdsl.backends.highs",
    "clarabel": "lmdsl.backends.clarabel",
    "cvxpy": "lmdsl.backends.cvxpy",
}
DEFAULT = "policy-iteration"

__all__ = [
    "Backend",
    "Capabilities",
    "Options",
    "Solution",
    "Stop",
    "get",
    "missing",
    "names",
    "resolve",
]


def names() -> tuple[str, ...]:
    """Return the names of all backends, ours first."""
    return (*BUILT_IN, *(name for name in _third_party() if name not in BUILT_IN))


def get(name: str) -> Backend:
    """Return a backend by name.

    Raises
    ------
    BadInput
        There is no such backend.
    MissingDependency
        A package it needs is not installed.
    """
    if name in BUILT_IN:
        backend: Backend = import_module(BUILT_IN[name]).BACKEND
    elif name in _third_party():
        loaded = _third_party()[name].load()
        if not isinstance(loaded, Backend):
            raise BadInput(f"the entry point {name!r} is no lmdsl.backends.Backend", "backend")
        backend = loaded
    else:
        raise BadInput(
            f"{shown(name)} is not a backend; the backends are {', '.join(names())}", "backend"
        )
    for package in backend.requires:
        if find_spec(package) is None:
            raise MissingDependency(f"{name} needs the package {package}; install it", "backend")
    return backend


def missing(backend: Backend) -> dict[str, str]:
    """Return the algorithms of a backend whose distribution is not installed, with its name.

    Nothing is imported; an installation that has the algorithm built in can still run it.
    """
    found = {}
    for algorithm, distribution in backend.capabilities.extras.items():
        try:
            version(distribution)
        except PackageNotFoundError:
            found[algorithm] = distribution
    return found


def resolve(spec: str | Backend) -> tuple[Backend, str | None]:
    """Return the backend and algorithm that ``"name"`` or ``"name:algorithm"`` asks for.

    Raises
    ------
    BadInput
        There is no such backend or algorithm.
    """
    if isinstance(spec, Backend):
        return spec, None
    name, _, algorithm = spec.partition(":")
    backend = get(name)
    known = backend.capabilities.algorithms
    if algorithm and known and algorithm not in known:
        raise BadInput(
            f"{shown(algorithm)} is not an algorithm of {name}; it has {', '.join(known)}",
            "backend",
        )
    return backend, algorithm or None


def _third_party() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group="lmdsl.backends")}
