"""The problem of a directory: of its file, with what the file leaves out."""

from typing import Any

from lmdsl.common import arrays, inputs
from lmdsl.common.files import MAX_FILE_BYTES, parsed
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.problem.problem import Problem, parse_problem
from lmdsl.results.directory.reading import Reading
from lmdsl.systems import NAMED, DataSystem, FunctionSystem, MatrixSystem, System
from lmdsl.systems.black_box.cost import FUNCTION
from lmdsl.systems.matrices.rows import MOST_LIMBS, GivenRows
from lmdsl.systems.named import NamedOde, NotStored

GIVEN: dict[Any, type[MatrixSystem]] = {"matrices": MatrixSystem, "data": DataSystem}


def own_problem(files: Reading) -> Problem:
    """Return the problem of a save."""
    content = files.open("problem.json", MAX_FILE_BYTES).read()
    return _problem(parsed(files.folder / "problem.json", content), files)


def _problem(data: Any, files: Reading) -> Problem:
    """Return the problem of a directory, with what its file leaves out."""
    if not isinstance(data, dict):
        return parse_problem(data)
    held, system = {**data}, data.get("system")
    # A function cannot be stored: everything but calling it still works.
    if data.get("stage_cost") == FUNCTION:
        held["stage_cost"] = _not_stored
    if isinstance(system, dict):
        held["system"] = _system(system, str(system.get("kind")), files)
    return parse_problem(held)


def _system(system: dict[str, Any], kind: str, files: Reading) -> Any:
    if kind == "function":
        known = {key: system[key] for key in ("parameters", "lipschitz") if key in system}
        return FunctionSystem(next=_not_stored, **known)
    if kind in GIVEN:
        return _matrices(GIVEN[kind], system, files)
    if "judged" not in system and (kind == "ode" or issubclass(NAMED.get(kind, System), NamedOde)):
        # Saved before paths were judged: the files mean what they meant.
        return {**system, "judged": "endpoint"}
    return system


def _matrices(model: type[MatrixSystem], system: dict[str, Any], files: Reading) -> MatrixSystem:
    """Read the rows of a finite model."""
    where = "problem.json.system.sizes"
    held = system.get("sizes")
    names = ("cells", "controls", "pairs", "entries", "codes", "limbs")
    if not isinstance(held, dict) or set(held) != set(names):
        raise BadInput(f"the sizes are those of {', '.join(names)}", where)
    sizes = {name: inputs.whole(held[name], where, 0, 2**31) for name in names}
    if sizes["limbs"] > MOST_LIMBS:
        raise BadInput(f"{sizes['limbs']} digits; at most {MOST_LIMBS}", where)
    expected = GivenRows.expected(sizes)
    memory.require(12 * arrays.largest(expected), "the rows of a finite model")
    rows = GivenRows.read(sizes, files.arrays("model.npz", expected))
    more = {key: value for key, value in system.items() if key not in ("kind", "sizes")}
    found: MatrixSystem = model.model_validate({**more, "rows": rows})
    return found


def _not_stored(**values: Any) -> Any:
    raise NotStored("this result came from a Python function, which a directory does not hold")
