"""Compiled loops: Numba's ``njit`` with a cache of its own, which may be missing.

A kernel is compiled when it is first called with arguments of some types. The result is kept in a
file, so that this happens once on a machine: in ``NUMBA_CACHE_DIR`` where that is set, else beside
this module, or where that cannot be written in the user's folder for caches. Where there is none,
kernels are compiled anew in every process; this is said once. Unlike Numba's own cache, this one
notices a change in a kernel that another calls, in a constant and in the fields of a named tuple,
needs no index, and holds a checksum: what cannot be read, or is not what was written, is compiled
again.
"""

import gc
import hashlib
import logging
import os
import pickle
import sys
import uuid
import warnings
from collections.abc import Iterator
from functools import cache
from itertools import product
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import BadInput, shown
from lmdsl.machine.forking import cached_property, hold

Scalar = TypeVar("Scalar", bound=np.generic)

# Says what is compiled (info, with ``busy``) and, once, that it cannot be kept (warning).
log = logging.getLogger(__name__)

# Options of every kernel. What no kernel needs is not compiled: none divides by zero.
OPTIONS = {
    "nogil": True, "no_cfunc_wrapper": True, "no_rewrites": True, "error_model": "numpy",
}  # fmt: skip

# Option of Numba for what counts references to arrays: only who makes an array needs it.
COUNTS = "_nrt"


def _started() -> tuple[Any, str]:
    """Import Numba; return it, and what it cannot use of the environment, empty if nothing."""
    prefix = "NUMBA_"
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            import numba
            import numba.core.compiler_lock
            import numba.core.event
            import numba.core.options
            import numba.core.serialize
            import numba.misc.appdirs
        except (ValueError, RuntimeError) as error:  # such as no threads
            settings = [f"{k}={v}" for k, v in os.environ.items() if k.startswith(prefix)]
            if not settings:
                raise
            return None, f"{', '.join(settings)} ({error})"
    bad = []
    for warning in said:
        text = str(warning.message)
        if text.startswith(f"Environment variable '{prefix}"):
            name = text.split("'")[1]
            bad.append(f"{name}={os.environ.get(name)}")
        else:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    return numba, ", ".join(bad)


numba, _unusable = _started()
if numba:
    hold(numba.core.compiler_lock.global_compiler_lock)
# The most threads that may be used: ``NUMBA_NUM_THREADS``.
threads = numba.config.NUMBA_NUM_THREADS if numba else 1


def kernel(function: Any = None, allocates: bool = False) -> Any:
    """Compile a function when it is called, as ``njit`` does, but no more than is needed.

    It makes arrays of its own only where it ``allocates``.
    """
    if function is None:
        return lambda function: kernel(function, allocates)
    if _unusable:
        return _refused
    known = hasattr(numba.core.options.DefaultOptions, COUNTS)  # an option that may go
    options = {COUNTS: allocates} if known else {}
    compiled = numba.njit(**{**OPTIONS, **options})(function)
    if hasattr(compiled, "_cache"):  # NUMBA_DISABLE_JIT leaves a plain function
        compiled._cache = Cache(compiled)
    return compiled


def _refused(*_: Any) -> Any:
    """Stand in for every kernel where Numba cannot be used: modules can be imported still."""
    raise BadInput(
        f"Numba cannot use what the environment sets: {shown(_unusable, 200)}; unset it, or set "
        "what Numba's documentation allows"
    )


def fixed(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a read-only view: arrays that can be written to and others need one compiled code."""
    view = array.view()
    view.flags.writeable = False
    return view


class Uncollected(numba.core.event.Listener if numba else object):  # type: ignore[misc]
    """Keeps Python from looking for garbage while a kernel is compiled: a tenth of the time.

    Numba tells of the start and the end, also of one that fails, and holds a lock in between.
    """

    def __init__(self) -> None:
        self.depth, self.enabled = 0, True

    def on_start(self, event: Any) -> None:
        """Note that a kernel is compiled, perhaps for another one."""
        if _is_kernel(event.data["dispatcher"]):
            if not self.depth:
                self.enabled = gc.isenabled()
                gc.disable()
            self.depth += 1

    def on_end(self, event: Any) -> None:
        """Note that it is compiled."""
        if _is_kernel(event.data["dispatcher"]):
            self.depth -= 1
            if not self.depth and self.enabled:
                gc.enable()


def _is_kernel(compiled: Any) -> bool:
    return isinstance(getattr(compiled, "_cache", None), Cache)


if numba:
    numba.core.event.register("numba:compile", Uncollected())


class Cache:
    """The files of one kernel, one for the types of its arguments; what Numba's dispatchers ask."""

    def __init__(self, compiled: Any) -> None:
        self.compiled = compiled
        self.name = f"{compiled.py_func.__module__}.{compiled.py_func.__qualname__}"

    @cached_property
    def stamp(self) -> bytes:
        """All that the code of the kernel depends on, but for types and machine."""
        content = repr((numba.__version__, sys.version, self.compiled.targetoptions)).encode()
        return hashlib.sha256(content + b"".join(_source(self.compiled.py_func, set()))).digest()

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return what was compiled for a signature; None where it has to be compiled."""
        target.refresh()
        name, key = self._entry(signature, target)
        for folder in folders():
            try:
                data = (folder / name).read_bytes()
                if data[:64] == key + hashlib.sha256(data[64:]).digest():
                    parts = pickle.loads(data[64:])
                    return numba.core.compiler.CompileResult._rebuild(target, *parts)
            except Exception:  # whatever is wrong with the file, it is made again
                continue
        _count.append(self.name)
        log.info("compiling %s", self.name, extra={"busy": True})
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep what was compiled, in the first folder that takes it."""
        log.info("compiled %s", self.name, extra={"busy": False})
        name, key = self._entry(signature, result.target_context)
        body = numba.core.serialize.dumps(result._reduce())
        why = "no folder for caches"
        for folder in folders():
            try:
                _write(folder / name, key + hashlib.sha256(body).digest() + body)
            except OSError as error:
                why = str(error)
            else:
                return
        _warn(why)

    def _entry(self, signature: Any, target: Any) -> tuple[str, bytes]:
        """Return the name of a file, and the key that it begins with."""
        fields = [*map(_fields, signature)]  # their order: the types say only what they hold
        machine = repr((str(signature), fields, target.codegen().magic_tuple())).encode()
        short = hashlib.sha256(machine).hexdigest()[:12]
        name = f"{self.name}.{sys.implementation.cache_tag}-{short}.kernel"
        return name, hashlib.sha256(machine + self.stamp).digest()


def _fields(kind: Any) -> Any:
    """Return the names of the fields of a type of named tuples, and of those within."""
    names = getattr(kind, "fields", None)
    return names and [(name, _fields(inner)) for name, inner in zip(names, kind, strict=True)]


@cache
def folders() -> tuple[Path, ...]:
    """Return the folders in which compiled kernels are looked for and kept, the first first."""
    here = Path(__file__).resolve().parent
    own = f"lmdsl-{hashlib.sha256(os.fsencode(here)).hexdigest()[:12]}"
    if numba.config.CACHE_DIR:
        return (Path(numba.config.CACHE_DIR, own),)
    users = Path(numba.misc.appdirs.user_cache_dir("lmdsl", appauthor=False))
    beside = here / "__pycache__"
    return (beside, users / own) if users.is_absolute() else (beside,)  # else it begins with ~


def _write(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{uuid.uuid4().hex[:12]}")
    try:
        with open(draft, "xb") as file:
            file.write(data)
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


_count: list[str] = []  # kernels that were compiled by this process


def compiled() -> int:
    """Return how many kernels this process compiled, instead of reading them."""
    return len(_count)


_said: list[str] = []


def _warn(why: str) -> None:
    if not _said:
        _said.append(why)
        log.warning(
            "lmdsl cannot keep its compiled kernels (%s), so every process compiles them anew; "
            "set NUMBA_CACHE_DIR to a folder that can be written",
            why,
        )


def _source(function: FunctionType, seen: set[FunctionType]) -> Iterator[bytes]:
    """Yield the bytecode of a function, the constants it names, and the same of those it calls.

    Also of those that it takes from modules: ``module.name``.
    """
    if function in seen:
        return
    seen.add(function)
    yield repr(function.__defaults__).encode()
    yield from _code(function.__code__)
    names, known = function.__code__.co_names, function.__globals__
    modules = [vars(known[name]) for name in names if isinstance(known.get(name), ModuleType)]
    for name, place in product(names, [known, *modules]):
        value: Any = place.get(name)
        if hasattr(value, "py_func"):
            yield from _source(value.py_func, seen)
        elif isinstance(value, int | float | str | tuple | np.generic | np.ndarray):
            yield f"{name} = {value!r}".encode()


def _code(code: CodeType) -> Iterator[bytes]:
    yield code.co_code
    yield repr((code.co_names, code.co_varnames, code.co_freevars)).encode()
    for value in code.co_consts:
        if isinstance(value, CodeType):
            yield from _code(value)
        else:
            yield repr(value).encode()


ONE = np.uint64(1)
