"""CasADi Functions as systems."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from lmdsl.errors import BadInput, shown
from lmdsl.systems.base import System
from lmdsl.systems.translated import systems, terms
from lmdsl.systems.translated.systems import Images
from lmdsl.systems.translated.terms import ONE, ZERO, Choice, Piece, Untranslatable

# Operations on one number, by their names in CasADi.
UNARY: dict[str, Callable[[Piece], Piece]] = {
    "NEG": terms.negative,
    "SQ": lambda a: terms.power(a, terms.number(2)),
    "TWICE": lambda a: terms.multiply(terms.number(2), a),
    "INV": lambda a: terms.divide(terms.number(1), a),
    "FABS": lambda a: terms.call("abs", a),
    "ASINH": terms.asinh,
    "ACOSH": terms.acosh,
    "ATANH": terms.atanh,
    "LOG1P": terms.log1p,
    "EXPM1": terms.expm1,
    "ASSIGN": lambda a: a,
    **{
        name.upper(): partial(terms.call, name)
        for name in ("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "sinh",
                     "cosh", "tanh", "floor", "ceil", "sign")
    },
}  # fmt: skip

BINARY: dict[str, Callable[[Piece, Piece], Piece]] = {
    "ADD": terms.add,
    "SUB": terms.subtract,
    "MUL": terms.multiply,
    "DIV": terms.divide,
    "POW": terms.power,
    "CONSTPOW": terms.power,
    "FMIN": lambda a, b: terms.call("min", a, b),
    "FMAX": lambda a, b: terms.call("max", a, b),
    "ATAN2": lambda a, b: terms.call("atan2", a, b),
    "FMOD": terms.truncated,
    "HYPOT": lambda a, b: terms.call(
        "sqrt", terms.add(terms.power(a, terms.number(2)), terms.power(b, terms.number(2)))
    ),
    "COPYSIGN": lambda a, b: terms.comparison(b, "<", terms.number(0)).choose(
        terms.negative(terms.call("abs", a)), terms.call("abs", a)
    ),
}

COMPARED = {"LT": "<", "LE": "<=", "EQ": "==", "NE": "!="}


def from_casadi(
    function: Any,
    arguments: Mapping[str, Any] | Sequence[Any] | None = None,
    *,
    states: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    parameters: Mapping[str, float] | None = None,
    step: float | None = None,
    substeps: Any = None,
) -> System:
    """Return the system of a CasADi ``Function``.

    Parameters
    ----------
    function
        Of states, controls, noise and parameters, in any inputs; it returns the next states, or
        with ``step`` their time derivatives.
    arguments
        The names of the elements of every input: by the name of the input, or in order. One name
        for a scalar input, a list for a vector. A scalar input that is left out has its own name.
    states
        The names of the states, in the order of the outputs; by default those of the first input.
    outputs
        The outputs that are images, by name; by default all of them.
    parameters, step, substeps
        As of :func:`from_sympy`.

    Returns
    -------
    MapSystem or OdeSystem or FunctionSystem
        As of :func:`from_sympy`.

    Raises
    ------
    BadInput
        The names do not fit the function, or CasADi is not installed.
    """
    casadi = systems.needed("casadi")
    if not isinstance(function, casadi.Function):
        raise BadInput(f"{shown(function)} is no casadi.Function", "system")
    if function.get_free():
        free = ", ".join(map(str, function.get_free()))
        raise BadInput(f"the function has free variables: {free}; make them inputs", "system")
    names = _arguments(function, arguments)
    chosen = _outputs(function, outputs)
    wanted = _states(function, names, chosen, states)
    images = Images(
        wanted,
        [name for each in names for name in each],
        partial(_texts, casadi, function, names, chosen),
        partial(CasadiFunction, function, names, chosen, tuple(wanted)),
    )
    return systems.system_of(images, dict(parameters or {}), step, substeps)


def text(function: Any) -> str:
    """Return the formula of a CasADi function of scalars, named as they are, to one scalar.

    Raises
    ------
    Untranslatable
        The language has no word for a part of it; the message names it.
    BadInput
        It is another kind of function.
    """
    casadi = systems.needed("casadi")
    if not isinstance(function, casadi.Function) or function.nnz_out() != 1:
        raise BadInput(f"{shown(function)} is no casadi.Function with one number as its output")
    (formula,) = _texts(casadi, function, _arguments(function, None), [0])
    return formula


def _arguments(function: Any, arguments: Any) -> list[tuple[str, ...]]:
    """Return the names of the elements of every input."""
    inputs = [function.name_in(k) for k in range(function.n_in())]
    if arguments is None:
        given: Mapping[str, Any] = {}
    elif isinstance(arguments, Mapping):
        given = arguments
    elif isinstance(arguments, str) or len(arguments) != len(inputs):
        raise BadInput(
            f"the function has the inputs {', '.join(inputs)}; give names for each of them",
            "arguments",
        )
    else:
        given = dict(zip(inputs, arguments, strict=True))
    for name in given:
        if name not in inputs:
            raise BadInput(
                f"{shown(name)} is no input; the inputs are {', '.join(inputs)}", "arguments"
            )
    return [
        _of_input(given.get(name, name if function.numel_in(k) == 1 else ()), name, function, k)
        for k, name in enumerate(inputs)
    ]


def _of_input(value: Any, name: str, function: Any, k: int) -> tuple[str, ...]:
    size = function.numel_in(k)
    if function.nnz_in(k) != size:
        raise BadInput(f"the input {name} is sparse; make it dense", "arguments")
    names = (value,) if isinstance(value, str) else tuple(value)
    if len(names) != size or not all(isinstance(each, str) for each in names):
        example = ", ".join(f'"{name}{i}"' for i in range(size))
        raise BadInput(
            f"the input {name} has {size} elements, and {len(names)} names; write for example "
            f'{{"{name}": [{example}]}}',
            "arguments",
        )
    return names


def _outputs(function: Any, outputs: Any) -> list[int]:
    known = [function.name_out(k) for k in range(function.n_out())]
    chosen = known if outputs is None else [*outputs]
    for name in chosen:
        if name not in known:
            raise BadInput(
                f"{shown(name)} is no output; the outputs are {', '.join(known)}", "outputs"
            )
    return [known.index(name) for name in chosen]


def _states(
    function: Any, names: list[tuple[str, ...]], outputs: list[int], states: Any
) -> list[str]:
    first = names[0] if names else ()
    chosen = [*first] if states is None else [*states]
    size = sum(function.numel_out(k) for k in outputs)
    if len(chosen) != size:
        listed = ", ".join(function.name_out(k) for k in outputs)
        raise BadInput(
            f"the outputs {listed} have {size} elements, and there are {len(chosen)} states "
            f"({', '.join(chosen)}); name the states in the order of the outputs, and the outputs "
            "to use",
            "states",
        )
    return chosen


def _texts(
    casadi: Any, function: Any, names: list[tuple[str, ...]], outputs: list[int]
) -> list[str]:
    """Return the formulas of all elements of some outputs."""
    try:
        scalar = function.expand()
    except RuntimeError as error:
        raise Untranslatable(_inner(function) or str(error).strip()[-200:]) from None
    operations = {
        value: name.removeprefix("OP_") for name, value in vars(casadi).items() if name[:3] == "OP_"
    }
    work: dict[int, Piece | Choice] = {}
    found: dict[tuple[int, int], Piece] = {}
    for k in range(scalar.n_instructions()):
        operation = operations.get(scalar.instruction_id(k), "an unknown operation")
        taken, given = scalar.instruction_input(k), scalar.instruction_output(k)
        if operation == "INPUT":
            work[given[0]] = Piece(names[taken[0]][taken[1]])
        elif operation == "OUTPUT":
            found[given[0], given[1]] = _value(work[taken[0]])
        elif operation == "CONST":
            work[given[0]] = terms.number(scalar.instruction_constant(k))
        elif operation == "CALL":
            raise Untranslatable(_inner(function) or "a function that it calls")
        else:
            work[given[0]] = _applied(operation, [work[i] for i in taken])
    texts = []
    for k in outputs:
        places = {place: i for i, place in enumerate(scalar.sparsity_out(k).find())}
        for i in range(scalar.numel_out(k)):
            texts.append(found[k, places[i]].text if i in places else "0")
    return texts


def _applied(operation: str, operands: list[Piece | Choice]) -> Piece | Choice:
    """Return the result of an operation on scalars."""
    if operation in COMPARED:
        a, b = map(_value, operands)
        return terms.comparison(a, COMPARED[operation], b)
    if operation in ("AND", "OR"):
        return (terms.both if operation == "AND" else terms.either)(*map(_condition, operands))
    if operation == "NOT":
        return _condition(operands[0]).negated()
    if operation == "IF_ELSE_ZERO":
        return _condition(operands[0]).choose(_value(operands[1]), ZERO)
    if operation in UNARY:
        return UNARY[operation](_value(operands[0]))
    if operation in BINARY:
        return BINARY[operation](*map(_value, operands[:2]))
    raise Untranslatable(operation.lower())


def _value(item: Piece | Choice) -> Piece:
    return item if isinstance(item, Piece) else item.choose(ONE, ZERO)


def _condition(item: Piece | Choice) -> Choice:
    return item if isinstance(item, Choice) else terms.comparison(item, "!=", ZERO)


def _inner(function: Any) -> str:
    """Return what a function calls that cannot be expanded into operations on scalars, by name."""
    if not function.is_a("MXFunction"):
        return ""
    for k in range(function.n_instructions()):
        try:
            inner = function.instruction_MX(k).which_function()
        except Exception:  # no call
            continue
        name = f"the {inner.class_name()} {inner.name()}"
        if not inner.is_a("MXFunction") or _inner(inner):
            return _inner(inner) or name
    return ""


class CasadiFunction:
    """A CasADi Function as a function of arrays by name."""

    def __init__(
        self, function: Any, names: list[tuple[str, ...]], outputs: list[int],
        states: tuple[str, ...],
    ) -> None:  # fmt: skip
        self.function, self.names = function, names
        self.outputs, self.states = outputs, states

    def __call__(self, **values: Any) -> dict[str, Any]:
        """Return the images of all samples, in the shape to which the arguments broadcast."""
        import casadi

        arrays = dict(zip(values, np.broadcast_arrays(*values.values()), strict=True))
        shape = next(iter(arrays.values())).shape if arrays else ()
        samples = int(np.prod(shape))
        columns = []
        for k, names in enumerate(self.names):
            rows = [np.asarray(arrays[name], dtype=np.float64).ravel() for name in names]
            table = np.array(rows).reshape(len(names), samples).T  # a sample after the other
            form = (self.function.size1_in(k), self.function.size2_in(k) * samples)
            columns.append(casadi.DM(table.reshape(form[::-1]).T if len(names) else np.zeros(form)))
        found = self.function.map(samples).call(columns)
        images = np.concatenate([self._rows(found[k].full(), k, samples) for k in self.outputs])
        return {
            state: image.reshape(shape) for state, image in zip(self.states, images, strict=True)
        }

    def _rows(self, table: Any, k: int, samples: int) -> Any:
        """Return an output by element and sample, from one matrix after the other."""
        return table.T.reshape(samples, self.function.numel_out(k)).T
