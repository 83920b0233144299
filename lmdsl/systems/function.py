"""A system written as a Python function, and what it must do to be one.

The function is the user's: it gets copies that it cannot write to, its images are copied into plain
arrays of doubles, and before and after a compilation it is asked the same question several ways.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from lmdsl.common.strict_model import plain
from lmdsl.errors import BadInput
from lmdsl.systems.base import OF_TIME, Names, StateMap, System
from lmdsl.systems.black_box.function_map import FunctionMap
from lmdsl.systems.black_box.returned import Returned
from lmdsl.systems.black_box.scalar_map import ScalarMap
from lmdsl.systems.black_box.steepness import Steepness

WHERE = "system.next"

Processes = Annotated[int, Field(strict=True, ge=1, le=1024), BeforeValidator(plain)]
Constant = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True), BeforeValidator(plain)]
ConstantRow = Annotated[tuple[Constant, ...], BeforeValidator(plain)]
Constants = Annotated[tuple[ConstantRow, ...], Field(min_length=1), BeforeValidator(plain)]


class FunctionSystem(System):
    """A system written as a Python function; it works everywhere except in JSON files.

    Attributes
    ----------
    next
        ``next(**values)`` receives every state, control, noise variable and parameter by name, and
        returns the images: a mapping from state names, or a sequence in the order of the axes. It
        must answer the same every time.
    vectorized
        True: it receives arrays that broadcast against each other, works on each sample by itself
        (NumPy semantics), also when called from several threads, and does not write to its
        arguments, which are read-only. False: it receives Python floats, one sample a call, and is
        never called by two threads at a time.
    processes
        With ``vectorized=False``, how many processes make the calls while a problem is compiled and
        while runs are simulated; None, the default, for the calling one. The function must be
        picklable then, unless processes are forked (``multiprocessing.set_start_method``).
    lipschitz
        One row per state, in the order of the axes, of a number per state and, behind these, per
        noise variable: how much the image changes at most, by a unit of each, anywhere in the box
        (images not wrapped) and under every control. With it ``successors`` may be ``enclosed``.
        Samples that contradict it are refused; that no others do is assumed, and said.

    Examples
    --------
    >>> import lmdsl as lm
    >>> lm.systems.FunctionSystem(next=lambda x, u: {"x": 0.5 * x + u}).kind
    'function'
    """

    elsewhere: ClassVar[Mapping[str, str]] = dict.fromkeys(
        (*OF_TIME, "derivative"),
        "a FunctionSystem is a map: next returns the states one step on; integrate in it, or write "
        "formulas with kind ode",
    )
    kind: Literal["function"] = "function"
    next: Callable[..., Any] = Field(exclude=True)
    # How it is called changes nothing of what is compiled: no saved result says it.
    vectorized: bool = Field(default=True, strict=True, exclude=True)
    processes: Processes | None = Field(default=None, exclude=True)
    lipschitz: Constants | None = None

    @model_validator(mode="after")
    def _few_at_a_time(self) -> Self:
        if self.vectorized and self.processes is not None:
            raise BadInput(
                "processes are for functions that are called sample by sample; add "
                "vectorized=False, or leave processes out",
                "processes",
            )
        return self

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        """Say that no JSON is a function."""
        return {"not": {}}

    def promised(self, states: Sequence[str], noise: Sequence[str]) -> Steepness | None:
        """See :meth:`System.promised`."""
        return None if self.lipschitz is None else Steepness(self.lipschitz, states, noise)

    def compile(self, names: Names) -> StateMap:
        """See :meth:`System.compile`."""
        _require_called(self.next, (*names.valued, *self.parameters))
        results = Returned(names.states, WHERE)
        if self.vectorized:
            return FunctionMap(self.next, results, self.parameters)
        return ScalarMap(self.next, results, self.parameters, processes=self.processes)


def _require_called(function: Callable[..., Any], names: Sequence[str]) -> None:
    """Refuse a function that cannot be called with all values by name."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return  # that of many built-in functions is not known
    try:
        signature.bind(**dict.fromkeys(names))
    except TypeError as error:
        raise BadInput(
            f"the function is called with {', '.join(names)} by name, and its arguments "
            f"{signature} do not fit: {error}",
            WHERE,
        ) from None
