"""The keys of certificate.json, in order: what a directory says of its result.

Beside them stand ``save`` and ``files``, which hold the files of a save together (reading.py).
"""

from dataclasses import MISSING, fields
from typing import Annotated, Any, Literal, Self, TypeVar, get_type_hints

from pydantic import BeforeValidator, ConfigDict, Field, create_model

from lmdsl.certificate.claims import Safe
from lmdsl.common.files import joined
from lmdsl.common.strict_model import Declared, plain
from lmdsl.control.invariance import LocalCheck
from lmdsl.data.report import DataReport
from lmdsl.errors import BadInput
from lmdsl.problem.problem import Problem
from lmdsl.results.directory.reading import COMMIT
from lmdsl.results.status import Cause, Status
from lmdsl.results.summary import Proved, Seconds
from lmdsl.systems import System


def scope(problem: Problem) -> str:
    """Return of what the claims speak, and what they assume."""
    system = problem.system
    return f"{system.scope}; assumed: {system.assumes}" if system.assumes else system.scope


T = TypeVar("T")
Word = Annotated[T, Field(strict=False)]  # a member of an enum, by its value
List = Annotated[tuple[T, ...], BeforeValidator(plain)]
# A number, ``"inf"`` or ``"-inf"``.
Bound = Annotated[
    float,
    Field(allow_inf_nan=True),
    BeforeValidator(lambda value: float(value) if value in ("inf", "-inf") else value),
]


class _Keys(Declared):
    model_config = ConfigDict(allow_inf_nan=False)


def _record(kind: type[Any]) -> BeforeValidator:
    """Read a dataclass of ours from an object with just its keys; later ones have a default."""
    hints: dict[str, Any] = get_type_hints(kind)
    keys: Any = {
        field.name: (hints[field.name], ... if field.default is MISSING else field.default)
        for field in fields(kind)
    }
    model = create_model(kind.__name__, __base__=_Keys, **keys)

    def read(value: Any) -> Any:
        if isinstance(value, dict):
            value = {key: plain(part) for key, part in value.items()}
        return value if value is None else kind(**dict(model.model_validate(value)))

    return BeforeValidator(read)


class ProofKeys(_Keys):
    """What is said of a proof of the true map; the boxes that prove it are in proof.npz."""

    arrives: float
    lost: float
    stays: float
    undecided: float
    steps: int | None
    cost: Annotated[tuple[Bound, Bound] | None, BeforeValidator(plain)]
    boxes: Annotated[int, Field(ge=0, lt=2**31)]
    seconds: float
    holds: bool | None
    target: float
    sha256: str = ""
    followed: Annotated[int, Field(ge=0, lt=2**31)] | None = None
    optimum: Annotated[tuple[Bound, Bound] | None, BeforeValidator(plain)] = None
    nonnegative: bool | None = None
    parts: Annotated[int, Field(ge=0, lt=2**31)] | None = None
    probability: float | None = None
    stopped: bool = False


class CertificateFile(_Keys):
    """What certificate.json says; keys that came later have a default, others are ignored."""

    model_config = ConfigDict(extra="ignore")

    format: Literal["lmdsl-result/1"]
    status: Word[Status]
    backend: str | None
    solver_status: str | None
    gamma: float | None
    cost: float | None
    lower_bound: float | None
    reward: float | None = None
    gap: float | None
    tolerance: Annotated[float, Field(ge=0)]
    contraction: float | None
    gamma_bar: Annotated[tuple[Bound, Bound] | None, BeforeValidator(plain)]
    cells: int
    controls: int
    pairs: int
    attractor_cells: int
    stabilizable_cells: int
    polish_steps: int | None
    seconds: Annotated[Seconds, _record(Seconds)]
    message: str
    local_controller: Annotated[LocalCheck | None, _record(LocalCheck)] = None
    data: Annotated[DataReport | None, _record(DataReport)] = None
    beyond_gamma: dict[str, Any] | None = None
    cause: Word[Cause | None]
    claims: dict[str, Safe]
    measure_residual: Bound | None
    reasons: List[str]
    iterations: int | None
    gap_before_polish: float | None
    model_sha256: str
    digest: Literal[1, 2] = 1
    versions: dict[str, str] = Field(default_factory=dict)
    scope: str = System.scope
    proof: ProofKeys | None = None
    proved: Annotated[Proved | None, _record(Proved)] = None

    @classmethod
    def read(cls, data: dict[str, Any]) -> Self:
        """Check that every key has its type."""
        try:
            found: Self = cls.model_validate(data)
        except BadInput as error:
            raise BadInput(error.message, joined(COMMIT, error.where)) from None
        return found
