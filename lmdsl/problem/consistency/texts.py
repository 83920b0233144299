"""Where formulas stand in a problem, what each may name, and every fault of them at once.

What is looked at is a problem, or plain data of which other parts were refused.
"""

import itertools
from collections.abc import Collection, Iterator, Mapping
from typing import Any, Final, NamedTuple

from lmdsl.common import spelling
from lmdsl.common.strict_model import Declared
from lmdsl.errors import BadInput, shown
from lmdsl.formulas.language import (
    NO_DEFINITIONS,
    Definitions,
    Formula,
    check_name,
    define,
    parse,
    parse_condition,
)
from lmdsl.formulas.names import MAX_DEFINITIONS
from lmdsl.formulas.tokens import FormulaError, UndeclaredName, elsewhere
from lmdsl.systems import NAMED, FunctionSystem, MapSystem, OdeSystem, System

MOST: Final = 1_000  # formulas of a file that are looked at; a sound one has no more of them

MOST_NAMES: Final = 20  # of a formula that may be declared where what is declared is not sure

STATES: Final = ("state",)
PAIRS: Final = ("state", "control")
ALL: Final = ("state", "control", "noise")

# What places of a problem may name beside parameters; a condition stands at some.
_KEYS: Final = {"stage_cost": ALL, "cost_rate": ALL, "terminal_cost": STATES, "admissible": PAIRS}
_SETS: Final = ("attractor", "avoid", "measure")


class Text(NamedTuple):
    """A formula or condition, where it stands, and the kinds of names that it may use."""

    where: str
    text: str
    kinds: Collection[str] = ALL
    condition: bool = False


class Declarations(NamedTuple):
    """The names that a problem declares: by kind, its parameters, and what ``let`` defines."""

    kinds: Mapping[str, Collection[str]]
    parameters: Collection[str]
    definitions: Definitions = NO_DEFINITIONS


def parsed(one: Text, known: Declarations) -> Formula:
    """Return a formula or condition, parsed.

    Raises
    ------
    BadInput
        It is no formula of its names.
    """
    names, found = {*known.parameters}, known.definitions
    names.update(*(known.kinds[kind] for kind in one.kinds))
    try:
        return (parse_condition if one.condition else parse)(one.text, names, found)
    except UndeclaredName as error:
        usable = {*names, *(name for name in found if found[name].names <= names)}
        said = elsewhere(error, known.kinds, one.kinds, usable)
        raise UndeclaredName(said, error.position, error.name, one.where) from None
    except FormulaError as error:
        raise FormulaError(error.message, error.position, one.where) from None


def faults(problem: Any, keys: Collection[str] = ()) -> list[BadInput]:
    """Return what is wrong with the formulas of a problem.

    Of plain data that do not say for sure which names are declared, because a key is none of
    ``keys`` or of a wrong type, only what is wrong whatever the names are.
    """
    known, sure = _known(problem, keys)
    let, undefined = _table(_part(problem, "let")), list[tuple[str, FormulaError]]()
    names = [name for kind in known.kinds.values() for name in kind]
    definitions = define(let, [*names, *known.parameters], undefined)
    known = known._replace(definitions=definitions)
    found: list[FormulaError] = []
    for name, error in undefined:
        if sure or not isinstance(error, UndeclaredName):
            found.append(FormulaError(error.message, error.position, f"let.{name}"))
    for one in itertools.islice(_texts(problem), MOST):
        fault = _fault(one, known, sure)
        if fault is not None:
            found.append(fault)
    return [*(_unmatched(problem, known) if sure else ()), *found]


def _fault(one: Text, known: Declarations, sure: bool) -> FormulaError | None:
    """Return what is wrong with a formula; names may be others than those known, unless sure."""
    for _ in range(MOST_NAMES):
        try:
            parsed(one, known)
        except UndeclaredName as error:
            behind = one.text[error.position + len(error.name) :].lstrip(" \t")
            if sure or behind.startswith("("):  # no function is ever declared
                return error
            known = known._replace(parameters={*known.parameters, error.name})
        except FormulaError as error:
            return error
        else:
            break
    return None


def _part(data: Any, key: str) -> Any:
    """Return what a model or plain data hold under a key, None where that is nothing."""
    if isinstance(data, Mapping):
        return data.get(key)
    return getattr(data, key, None) if isinstance(data, Declared) else None


def _table(data: Any) -> dict[str, str]:
    """Return the texts of an object of formulas, as many as there may be."""
    pairs = data.items() if isinstance(data, Mapping) else ()
    named = ((k, v) for k, v in pairs if isinstance(k, str) and isinstance(v, str))
    return dict(itertools.islice(named, MAX_DEFINITIONS))


def _formulas(problem: Any) -> tuple[str, Any]:
    """Return the key of the system under which its formulas stand, and these; none: ""."""
    system = _part(problem, "system")
    if not isinstance(system, FunctionSystem):
        for key in ("next", "derivative"):
            if isinstance(_part(system, key), Mapping):
                return key, _part(system, key)
    return "", {}


def _texts(problem: Any) -> Iterator[Text]:
    key, formulas = _formulas(problem)
    for state, text in formulas.items():
        if isinstance(text, str):
            yield Text(f"system.{key}.{state}", text)
    for key, kinds in _KEYS.items():
        if isinstance(text := _part(problem, key), str):
            yield Text(key, text, kinds, key == "admissible")
    if isinstance(text := _part(_part(problem, "measure"), "density"), str):
        yield Text("measure.density", text, STATES)
    for key in _SETS:
        where, several = f"{key}.where", _part(_part(problem, key), "where")
        if isinstance(several, str):
            yield Text(where, several, STATES, True)
        elif isinstance(several, list | tuple):
            for i, text in enumerate(several):
                if isinstance(text, str):
                    yield Text(f"{where}[{i}]", text, STATES, True)


def _known(problem: Any, keys: Collection[str]) -> tuple[Declarations, bool]:
    """Return the names that are declared, and whether it is sure that there are no others."""
    if isinstance(problem, Declared):
        sure, constants = True, _part(problem, "system").constants()
    else:
        sure, constants = _constants(problem, keys)
    kinds = {}
    places = {"state": "state_box", "control": "control_grid", "noise": "noise"}
    for kind, key in places.items():
        part = _part(problem, key)
        sure &= isinstance(part, Mapping) or (kind == "noise" and part is None)
        kinds[kind] = tuple(part) if isinstance(part, Mapping) else ()
    let = {} if (part := _part(problem, "let")) is None else part
    sure &= isinstance(let, Mapping) and len(_table(let)) == len(let)
    names = itertools.chain(*kinds.values(), constants, _table(let))
    sure &= all(map(_sound, names))
    return Declarations({k: _words(v) for k, v in kinds.items()}, _words(constants)), sure


def _constants(data: Mapping[str, Any], keys: Collection[str]) -> tuple[bool, Collection[str]]:
    """Return the parameters of plain data, and whether all of their keys are known."""
    sure = set(data) <= {*keys, "$schema"}
    system = data.get("system")
    if isinstance(system, System):
        return sure, system.constants()
    if not isinstance(system, Mapping):
        return False, ()
    kind, parameters = system.get("kind"), system.get("parameters", {})
    own = set(parameters) if isinstance(parameters, Mapping) else set()
    sure &= isinstance(parameters, Mapping)
    if isinstance(kind, str) and kind in NAMED:
        return sure, own | set(NAMED[kind].defaults)
    model: Any = {"map": MapSystem, "ode": OdeSystem}.get(kind if isinstance(kind, str) else "")
    return sure and model is not None and set(system) <= set(model.model_fields), own


def _words(names: Collection[object]) -> tuple[str, ...]:
    return tuple(name for name in names if isinstance(name, str))


def _sound(name: object) -> bool:
    try:
        check_name(name if isinstance(name, str) else "")
    except BadInput:
        return False
    return True


def _unmatched(problem: Any, known: Declarations) -> Iterator[BadInput]:
    """Yield formulas that belong to no axis, and axes that have no formula."""
    key, formulas = _formulas(problem)
    states, where = known.kinds["state"], f"system.{key}"
    for state in itertools.islice(formulas, MOST if key else 0):
        if state not in states:
            near = spelling.hint(state, states) or "; remove it or declare the axis"
            yield BadInput(f"{shown(state)} is not an axis of state_box{near}", where)
    for state in states if key else ():
        if state not in formulas:
            yield BadInput(f"no formula for state {state!r}; add one", where)
