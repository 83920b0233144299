"""The registry of backends: our own, any number by entry point ``lmdsl.backends``.

An entry point names a :class:`Backend`. Nothing is imported before it is asked for.
"""

import sys
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import fields
from importlib import import_module
from importlib.metadata import (
    EntryPoint,
    PackageNotFoundError,
    distributions,
    entry_points,
    version,
)
from importlib.util import find_spec

from lmdsl.backends.base import Backend, Capabilities
from lmdsl.common import spelling
from lmdsl.errors import BadInput, MissingDependency, plain_text, shown
from lmdsl.machine import quiet
from lmdsl.machine.forking import whole

BUILT_IN = {
    "policy-iteration": "lmdsl.backends.policy_iteration",
    "highs": "lmdsl.backends.highs",
    "clarabel": "lmdsl.backends.clarabel",
    "cvxpy": "lmdsl.backends.cvxpy",
    "ipopt": "lmdsl.backends.ipopt",
}
DEFAULT = "policy-iteration"
GROUP = "lmdsl.backends"
FLAGS = [field.name for field in fields(Capabilities) if isinstance(field.default, bool)]


def names() -> tuple[str, ...]:
    """Return the names of all backends, ours first."""
    return (*BUILT_IN, *(name for name in _third_party() if name not in BUILT_IN))


def installed() -> tuple[str, ...]:
    """Return the names of our backends whose packages are installed; nothing is imported."""
    return tuple(name for name in BUILT_IN if all(map(_found, _record(name).requires)))


def get(name: str) -> Backend:
    """Return a backend by name.

    Raises
    ------
    BadInput
        There is no such backend, or what a package offers by this name is broken.
    MissingDependency
        A package it needs is not installed.
    """
    if name in BUILT_IN:
        backend = _record(name)
    elif name in (offered := _third_party()):
        backend = _loaded(name, offered[name])
    else:
        raise BadInput(
            f"{shown(name)} is not a backend{spelling.hint(name, names()) or ';'} the "
            f"backends are {', '.join(map(_said, names()))}",
            "backend",
        )
    for package in backend.requires:
        if not _found(package):
            needed = package if len(package) <= 100 else shown(package)
            raise MissingDependency(f"{name} needs the package {needed}; install it", "backend")
    return backend


def ours(backend: Backend) -> bool:
    """Return whether a backend's function is one of ours."""
    modules = (sys.modules.get(name) for name in BUILT_IN.values())
    return any(module is not None and backend.solve is module.BACKEND.solve for module in modules)


def plain(backend: Backend) -> Backend:
    """Return a backend whose record is what it should be, in types of our own.

    Raises
    ------
    BadInput
        It is not.
    """
    try:
        record = backend.capabilities
        flags = {name: bool(getattr(record, name)) for name in FLAGS}
        capabilities = Capabilities(
            algorithms=tuple(map(_word, record.algorithms)),
            extras={_word(key): _word(value) for key, value in dict(record.extras).items()},
            **flags,
        )
        requires = tuple(map(_word, backend.requires))
        found = Backend(_word(backend.name), backend.solve, capabilities, requires)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise BadInput(f"its record is broken: {_raised(error)}", "backend") from None
    if not callable(found.solve):
        raise BadInput("its record is broken: solve is no function", "backend")
    return found


def missing(backend: Backend) -> dict[str, str]:
    """Return the algorithms of a backend whose distribution is not installed, with its name.

    Nothing is imported; an installation that has the algorithm built in can still run it.
    """
    if not isinstance(backend, Backend):
        raise BadInput(f"{shown(backend)} is no Backend", "backend")
    found = {}
    for algorithm, distribution in backend.capabilities.extras.items():
        try:
            version(distribution)
        except (PackageNotFoundError, ValueError):
            found[algorithm] = distribution
    return found


def resolve(spec: str | Backend) -> tuple[Backend, str | None]:
    """Return the backend and algorithm that ``"name"`` or ``"name:algorithm"`` asks for.

    Raises
    ------
    BadInput
        There is no such backend or algorithm, or its record is broken.
    """
    if isinstance(spec, Backend):
        return plain(spec), None
    if not isinstance(spec, str):
        raise BadInput(f"{shown(spec)} is neither the name of a backend nor a Backend", "backend")
    name, _, algorithm = spec.partition(":")
    backend = get(name)
    known = backend.capabilities.algorithms
    if algorithm and known and algorithm not in known:
        raise BadInput(
            f"{shown(algorithm)} is not an algorithm of {name}"
            f"{spelling.hint(algorithm, known) or ';'} it has {', '.join(known)}",
            "backend",
        )
    return backend, algorithm or None


def _record(name: str) -> Backend:
    with whole:
        found: Backend = import_module(BUILT_IN[name]).BACKEND
    return found


def _third_party() -> dict[str, list[EntryPoint]]:
    """Return what installed packages offer, by name; the same name twice is two entries."""
    found: dict[str, list[EntryPoint]] = {}
    for entry in _offered():
        others = found.setdefault(str(entry.name), [])
        if all(entry.value != other.value for other in others):  # else one package, seen twice
            others.append(entry)
    return found


def _offered() -> Iterable[EntryPoint]:
    """Return our entry points; what a package declares that cannot be read hides no other."""
    try:
        return entry_points(group=GROUP)
    except Exception:
        found: dict[str, Iterable[EntryPoint]] = {}  # of two versions on the path, the first
        for package in distributions():
            with suppress(Exception):
                found.setdefault(package.name, package.entry_points.select(group=GROUP))
        return [entry for entries in found.values() for entry in entries]


def _loaded(name: str, entries: list[EntryPoint]) -> Backend:
    """Return the backend that an entry point names; whatever it raises is said as bad input."""
    by = " and ".join(_package(entry) for entry in entries)
    if not name.isprintable() or any(c in name for c in " :,"):
        raise BadInput(f"{by} offers the name {shown(name)}, which is no name", "backend")
    if len(entries) > 1:
        raise BadInput(f"{shown(name)} is offered by {by}; uninstall all but one", "backend")
    try:
        with quiet.foreign():
            found = entries[0].load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise BadInput(
            f"{by} offers {shown(name)}, which does not load: {_raised(error)}", "backend"
        ) from None
    if not isinstance(found, Backend):
        raise BadInput(f"{by} offers {shown(name)}, which is no lmdsl.backends.Backend", "backend")
    try:
        with quiet.foreign():
            return plain(found)
    except BadInput as error:
        raise BadInput(f"{by} offers {shown(name)}; {error.message}", "backend") from None


def _package(entry: EntryPoint) -> str:
    """Return the name of the distribution that declares an entry point."""
    try:
        return plain_text(entry.dist.name)  # type: ignore[union-attr]
    except Exception:  # its metadata has none
        return "an unnamed package"


def _raised(error: BaseException) -> str:
    return plain_text(f"{type(error).__name__}: {plain_text(error)}")


def _said(name: str) -> str:
    return name if name.isprintable() else shown(name)


def _word(value: object) -> str:
    if not isinstance(value, str) or not value.isprintable():
        raise TypeError(f"{shown(value)} is no name")
    return str(value)


def _found(package: str) -> bool:
    try:
        with quiet.foreign():  # the folder of a dotted name is imported
            return find_spec(package) is not None
    except KeyboardInterrupt:
        raise
    except BaseException:  # a package inside one that is missing, or that fails or exits
        return False
