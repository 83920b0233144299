"""What pydantic finds wrong, as one line: every fault with its path, the value and the fix."""

import inspect
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel, Tag, ValidationError

from lmdsl.common import spelling
from lmdsl.common.files import joined
from lmdsl.errors import BadInput, shown

# Number of faults above which further ones are counted only, and of characters of a message.
MOST_FAULTS, MOST_CHARACTERS = 20, 6_000

# What to do about each kind of fault that pydantic finds.
_FIXES = {
    "bool_type": "write true or false",
    "callable_type": "give a function",
    "dict_type": "write an object in braces",
    "enum": "write {expected}",
    "finite_number": "must be a finite number",
    "float_type": "write a number",
    "greater_than": "it must be greater than {gt}",
    "greater_than_equal": "it must be at least {ge}",
    "int_type": "write a whole number",
    "less_than": "it must be less than {lt}",
    "less_than_equal": "it must be at most {le}",
    "literal_error": "write {expected}",
    "model_type": "write an object in braces",
    "string_too_long": "at most {max_length} characters are allowed",
    "string_type": "write a string",
    "too_long": "at most {max_length} entries are allowed",
    "too_short": "give at least {min_length} of them",
    "tuple_type": "write a list in brackets",
}

FUNCTIONS = (
    "write formulas as text: only stage_cost and next of lm.systems.FunctionSystem may be "
    "functions, of a differential equation one that integrates a step"
)
_ADD = "required key is missing; add it"


class _Fault(NamedTuple):
    where: str
    message: str
    meant: str | None = None
    """Path of the key that an unknown key was probably meant to be."""
    known: str = ""
    """The keys that are known there, to be said once."""
    instead: str | None = None
    """Of a key that stands elsewhere in another kind: the path of what it stands in."""


def condensed(
    error: ValidationError, model: Any, more: Callable[[], Iterable[BadInput]] = tuple
) -> BadInput:
    """Return all faults of pydantic's report on a model as one error; misspelt keys come first.

    ``more`` finds others where the model itself was not asked: the type of a part was refused.
    """
    items = error.errors(include_url=False)
    faults = [_fault(item, model) for item in items if not _follows(item)]
    meant = {fault.meant for fault in faults if fault.meant}
    instead = {fault.instead for fault in faults}  # what is missing there is said by these
    faults = [
        fault for fault in faults
        if fault.message != _ADD
        or (fault.where not in meant and fault.where.rpartition(".")[0] not in instead)
    ]  # fmt: skip
    faults.sort(key=lambda fault: fault.meant is None)
    said: set[str] = set()
    found = []
    for fault in faults:
        if fault.instead is not None and fault.message in said:
            continue
        found.append(BadInput(fault.message + fault.known * (fault.known not in said), fault.where))
        said |= {fault.known, fault.message}
    if all(item["loc"] for item in items):
        found += more()
    return together(found)


def _follows(item: Mapping[str, Any]) -> bool:
    """Return whether a list is called too short because an entry was refused."""
    return item["type"] == "too_short" and bool(len(item["input"]) >= item["ctx"]["min_length"])


def together(faults: Sequence[BadInput]) -> BadInput:
    """Return faults, at least one, as one error: the first that each field has, 20 at most."""
    first, *others = {(fault.where, fault.message): fault for fault in faults}.values()
    if not others:
        return first
    message = first.message
    for k, fault in enumerate(others):
        if k + 1 >= MOST_FAULTS or len(message) + len(str(fault)) > MOST_CHARACTERS:
            return BadInput(f"{message}; and {len(others) - k} more", first.where)
        message += f"; {fault}"
    return BadInput(message, first.where)


def require_all(checks: Iterable[Callable[[], object]]) -> None:
    """Make checks, and refuse what they find as one error that names every fault."""
    faults = []
    for check in checks:
        try:
            check()
        except BadInput as error:
            faults.append(error)
    if faults:
        raise together(faults)


def _fault(item: Mapping[str, Any], model: type[BaseModel]) -> _Fault:
    location, kind = item["loc"], item["type"]
    where = _path(location)
    cause = item.get("ctx", {}).get("error")
    if isinstance(cause, BadInput):
        return _Fault(joined(where, cause.where), cause.message)
    if kind == "missing":
        return _Fault(where, _ADD)
    if kind == "extra_forbidden":
        return _unknown(where, location, model)
    if kind == "kind":
        return _kind(where, item)
    fix = _FIXES.get(kind)
    if location[-1:] == ("[key]",):
        fix = "names are strings"
    if inspect.isroutine(item["input"]):
        return _Fault(where, f"a Python function is not accepted here; {FUNCTIONS}")
    limits = {key: _plain(value) for key, value in item.get("ctx", {}).items()}
    fix = fix.format(**limits) if fix else item["msg"]
    if kind == "int_type" and isinstance(_plain(item["input"]), int):
        fix = f"write {_plain(item['input'])}, without a point"
    if kind == "model_type":
        fix += _form(_models(model, location))
    return _Fault(where, f"{written(item['input'])} is not accepted; {fix}")


def _form(models: Sequence[type[BaseModel]]) -> str:
    """Return the keys that a part must have, where there is one form of it."""
    if len(set(models)) != 1:
        return ""
    needed = [name for name, field in models[0].model_fields.items() if field.is_required()]
    keys = ", ".join(f'"{name}": ...' for name in needed)
    return f": {{{keys}}}" if keys else ""


def written(value: Any, limit: int = 120) -> str:
    """Return a value as JSON has it, short and on one line; what JSON has not, as Python has it."""
    if isinstance(value, dict | list | tuple) and len(value) > 8:
        kind = "an object of {} keys" if isinstance(value, dict) else "a list of {} entries"
        return kind.format(len(value))
    if isinstance(value, bool | dict | list | tuple) or value is None:
        try:
            text = json.dumps(value)
        except (TypeError, ValueError, RecursionError):
            return shown(value)
        return text if len(text) <= limit else text[:limit] + "..."
    return shown(value)


def _kind(where: str, item: Mapping[str, Any]) -> _Fault:
    given, listed = item["input"], item["msg"]
    if not isinstance(given, Mapping):
        fix = f"write an object with a kind: {listed}"
        return _Fault(where, f"{written(given)} is not accepted; {fix}")
    if "kind" not in given:
        return _Fault(where, f"kind is missing; the kinds are {listed}")
    kind = given["kind"]
    near = spelling.hint(kind, listed.split(", "), spelling.KINDS) or ";"
    return _Fault(
        joined(where, "kind"), f"{shown(kind)} is not a kind{near} the kinds are {listed}"
    )


def _plain(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _unknown(where: str, location: tuple[int | str, ...], model: type[BaseModel]) -> _Fault:
    for kind in _models(model, location[:-1]):
        if said := getattr(kind, "elsewhere", {}).get(location[-1]):
            return _Fault(where, said, instead=_path(location[:-1]))
    allowed = sorted({key for kind in _models(model, location[:-1]) for key in kind.model_fields})
    near = spelling.nearest(str(location[-1]), allowed, spelling.KEYS)
    if near is None and "kind" not in allowed:  # of several forms, another one
        other = {key for kind in _models(model, location[:-2]) for key in kind.model_fields}
        near = spelling.nearest(str(location[-1]), other - {location[-1]}, spelling.KEYS)
    if near is None:
        known = f" (known keys: {', '.join(allowed)})" if allowed else ""
        return _Fault(where, "unknown key; remove it or correct its spelling", None, known)
    return _Fault(where, f"unknown key; did you mean {near!r}?", _path((*location[:-1], near)))


def _models(model: type[BaseModel], location: tuple[int | str, ...]) -> list[type[BaseModel]]:
    """Return the models that may stand at a location of a report."""
    types: list[Any] = [model]
    for part in location:
        types = [inner for outer in types for inner in _inside(outer, part)]
    return [kind for outer in types for kind in _members(outer) if _is_model(kind)]


def _inside(kind: Any, part: int | str) -> Iterator[Any]:
    """Yield the types one step further; a tag in angle brackets chooses of a union."""
    if isinstance(part, str) and part.startswith("<"):
        for member in _members(kind):
            extras = get_args(member)[1:] if get_origin(member) is Annotated else ()
            if part in [extra.tag for extra in extras if isinstance(extra, Tag)]:
                yield member
        return
    for member in _members(kind):
        bare = _bare(member)
        if _is_model(bare) and part in bare.model_fields:
            yield bare.model_fields[part].annotation
        elif get_origin(bare) is dict:
            yield get_args(bare)[1]
        elif get_origin(bare) is tuple:
            yield get_args(bare)[0]


def _members(kind: Any) -> list[Any]:
    bare = _bare(kind)
    if get_origin(bare) in (Union, UnionType):
        return [inner for member in get_args(bare) for inner in (member, *_members(member)[1:])]
    return [kind]


def _bare(kind: Any) -> Any:
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _is_model(kind: Any) -> bool:
    kind = _bare(kind)
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _path(location: tuple[int | str, ...]) -> str:
    # Parts in angle brackets are tags of unions, "[key]" says that a key is at fault: no keys.
    keys = (k for k in location if not (isinstance(k, str) and (k[:1] == "<" or k == "[key]")))
    return joined(*(f"[{k}]" if isinstance(k, int) else _key(k) for k in keys))


def _key(key: str) -> str:
    return key if key.isascii() and key.isidentifier() and len(key) <= 64 else shown(key)
