"""The scalar part of a result."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Self, cast

import numpy as np

from lmdsl.certificate.claims import Safe
from lmdsl.common.html import facts
from lmdsl.common.records import Frozen, Reported, jsonable
from lmdsl.common.types import Progress, Statuses
from lmdsl.control.accuracy import IntegrationError
from lmdsl.control.invariance import LocalCheck
from lmdsl.control.simulation import Simulation
from lmdsl.data.report import DataReport
from lmdsl.model.grid.boxes import Area
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.results.status import Status


@dataclass(frozen=True)
class CostFrom(Reported):
    """The conditional cost of a starting region.

    Attributes
    ----------
    upper, lower
        The policy's cost is at most ``upper``; no policy costs less than ``lower``.
    mass
        Share m(B) of the weight that starts there.
    """

    upper: float
    lower: float
    mass: float

    def __str__(self) -> str:
        return f"cost between {self.lower:.9g} and {self.upper:.9g} from {self.mass:.4g} of m"


@dataclass(frozen=True)
class Seconds:
    """Wall-clock seconds of the three stages."""

    compile: float | None = None
    solve: float | None = None
    verify: float | None = None


@dataclass(frozen=True)
class Coverage(Reported):
    """How much of the box the controller serves; cells are equal shares of its volume.

    Attributes
    ----------
    stabilizable, free
        Number of cells of C, and of cells outside A and Z.
    share
        The one of the other; None where no cell is free.
    """

    stabilizable: int
    free: int
    share: float | None

    @classmethod
    def of(cls, cell_status: Statuses) -> Self:
        """Count the cells."""
        free = int((~np.isin(cell_status, (CellStatus.ATTRACTOR, CellStatus.AVOID))).sum())
        stabilizable = int((cell_status == CellStatus.STABILIZED).sum())
        return cls(stabilizable, free, stabilizable / free if free else None)

    def __str__(self) -> str:
        text = f"{self.stabilizable} of {self.free} free cells stabilizable"
        if self.share is None:
            return text
        percent = 100 * self.share if self.share == 1 else min(100 * self.share, 99.99)
        return f"{text} ({percent:.4g} %)"


@dataclass(frozen=True)
class Proved(Reported):
    """How far a problem was repaired (:func:`lmdsl.solve` with ``proved``).

    Attributes
    ----------
    target
        The share of the volume of the first C that was to be proved to arrive.
    arrives
        The share that is; None where its proof was not kept.
    dropped
        Number of pairs (cell, control) that were dropped.
    cells
        Number of cells of the first C.
    lower_bound
        The lower bound of the declared model, with no pair dropped.
    sha256
        Of the list of dropped pairs; empty where there is none.
    without_loss
        An upper bound of the share of the first C that any controller of these cells and controls
        can keep without losing a run; None where it was not looked for.
    """

    target: float
    arrives: float | None
    dropped: int
    cells: int
    lower_bound: float | None
    sha256: str = ""
    without_loss: float | None = None

    @property
    def reached(self) -> bool:
        """Whether the target is reached."""
        return self.arrives is not None and self.arrives >= self.target


@dataclass(frozen=True, kw_only=True, eq=False)
class Summary(Frozen):
    """The scalar part of a result: the keys of ``lmdsl solve --json``, in order.

    Attributes
    ----------
    status
        ``verified``, ``unverified``, ``not_stabilizable``, ``solver_failed``, ``bad_input``.
    backend, solver_status
        Who solved it, and the solver's own word.
    gamma
        Geometric weight of the cost.
    cost, lower_bound, gap, tolerance
        m'V_up, m'W, their relative difference, and the largest gap that counts as verified.
    contraction
        Proved bound on the spectral radius of max(gamma, 1) P_u.
    gamma_bar
        None or (low, high): proved bracket of the largest feasible gamma.
    cells, controls, pairs
        N, M and the number of surviving pairs.
    attractor_cells, stabilizable_cells
        Number of cells of A and C.
    polish_steps
        Improvement steps made on the backend's policy.
    seconds
        Wall-clock time per stage.
    message
        One sentence for people.
    local_controller
        Whether the problem's local controller keeps the attractor cells; None without one.
    simulation
        Runs of the true map that ``lmdsl solve`` made; None where none was asked for.
    data
        What was recorded, what is assumed and how sure it is; None unless solved from data.
    integration_error
        How far the compiled steps are from the differential equation; None for a map, for a loaded
        result, and where there was no time.
    proved
        How far the problem was repaired; None where that was not asked for.
    """

    status: Status
    backend: str | None = None
    solver_status: str | None = None
    gamma: float | None = None
    cost: float | None = None
    lower_bound: float | None = None
    gap: float | None = None
    tolerance: float | None = None
    contraction: float | None = None
    gamma_bar: tuple[float, float] | None = None
    cells: int | None = None
    controls: int | None = None
    pairs: int | None = None
    attractor_cells: int | None = None
    stabilizable_cells: int | None = None
    polish_steps: int | None = None
    seconds: Seconds = field(default_factory=Seconds)
    message: str = ""
    local_controller: LocalCheck | None = None
    simulation: Simulation | None = None
    data: DataReport | None = None
    integration_error: IntegrationError | None = None
    proved: Proved | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data: infinity is ``"inf"``, unknown is None, never NaN."""
        later = ("simulation", "data", "integration_error", "proved")
        names = [f.name for f in fields(Summary) if f.name not in later]
        return {
            **{name: jsonable(getattr(self, name)) for name in names},
            "beyond_gamma": jsonable(self.beyond_gamma),
            "coverage": jsonable(self.coverage),
            "simulation": jsonable(self.simulation),
            "data": jsonable(self.data),
            "integration_error": jsonable(self.integration_error),
            "sure_cells": self.sure_cells,
            "claims": self.claims,
            "proved": jsonable(self.proved),
        }

    @property
    def coverage(self) -> Coverage | None:
        """How much of what is neither attractor nor avoided is stabilizable; None if unknown."""
        return None

    @property
    def sure_cells(self) -> int | None:
        """Number of cells from all of which some controller surely enters A; None: not known."""
        levels = getattr(self, "sure_levels", None)
        return None if levels is None else int((levels > 0).sum())

    @property
    def claims(self) -> dict[str, Safe]:
        """Which claims of the certificate hold, by name; None is one that is not made."""
        proof = getattr(self, "certificate", None)
        return {} if proof is None else dict(proof.claims)

    @property
    def beyond_gamma(self) -> Area | None:
        """The cells proved infeasible at this gamma, by region; None where none is."""
        return None

    def _repr_html_(self) -> str:
        def known(value: float | None, digits: str = ".9g") -> str:
            return "not established" if value is None else format(value, digits)

        problem = getattr(self, "problem", None)
        rows: list[tuple[str, Any]] = (
            [("problem", problem.name)] if problem and problem.name else []
        )
        rows += [("status", self.status), ("", self.message), ("backend", self.backend)]
        if self.cost is not None or self.lower_bound is not None:
            bounds = f"{known(self.cost)} (lower bound {known(self.lower_bound)})"
            rows += [("cost", bounds), ("gap", known(self.gap, ".2g"))]
            rows.append(("contraction", known(self.contraction)))
        rows += [("gamma", repr(self.gamma)), ("coverage", self.coverage or f"{self.cells} cells")]
        if self.gamma_bar:
            rows.append(("gamma_bar", "{:.9g} to {:.9g}".format(*self.gamma_bar)))
        beside = (self.local_controller, self.integration_error, self.simulation)
        names = ("local controller", "integration", "true map")
        rows += [(name, x.sentence()) for name, x in zip(names, beside, strict=True) if x]
        spent = [f"{name} {x:.3f}" for name, x in vars(self.seconds).items() if x is not None]
        return facts([*rows, ("seconds", ", ".join(spent) or "-")], "Result")

    @property
    def exit_status(self) -> int:
        """Exit status of the command line: of the status, or 1 where a proof misses its target."""
        found = Status(self.status).exit_status
        missed = self.proved is not None and not self.proved.reached
        return 1 if missed and not found else found


class Paged:
    """What becomes a page; the package that writes it is imported when it is asked for."""

    def report(
        self,
        path: str | os.PathLike[str],
        *,
        proof: Any = None,
        comparison: Any = None,
        seed: int = 0,
        progress: Progress | bool | None = None,
    ) -> None:
        """Write one self-contained page about the result, HTML without network.

        Parameters
        ----------
        path
            The file, ending in .html; it appears whole or not at all.
        proof, comparison
            What :meth:`Result.prove` and :func:`lmdsl.compare` returned, to be told of, too.
        seed
            Of the runs that are simulated where the result has none.
        progress
            Called with (stage, fraction done, or -1); True shows it on stderr.

        Raises
        ------
        BadInput
            The ending is another, the file cannot be written, or plotly is not installed.
        """
        from lmdsl.report.writing import write

        write(cast(Any, self), path, proof=proof, comparison=comparison, seed=seed,
              progress=progress)  # fmt: skip


class Carried:
    """What takes a result to other packages; each is imported when it is asked for."""

    def to_xarray(self, units: Mapping[str, str] | None = None) -> Any:
        """Return an ``xarray.Dataset`` with axes as coordinates; needs the package xarray.

        Parameters
        ----------
        units
            Units by name of axes and controls, kept as attributes.

        Notes
        -----
        Its variables, over all cells: the controls at the centres by name, NaN where there is
        none; ``control_index``, ``value``, ``lower``, ``measure``, ``weight``, ``cell_status``.
        Where an axis or a control has such a name, ours has a line behind it. The numbers of the
        report, the digest of the model and the problem file are attributes. NetCDF and Zarr keep
        all of it.
        """
        from lmdsl.interop.arrays import to_xarray

        return to_xarray(self, units)

    def to_dataframe(self) -> Any:
        """Return a ``pandas.DataFrame`` with a row for each cell; needs the package pandas.

        The columns are ``cell``, the axes (centres), ``status``, ``control_index``, the controls
        at the centres, ``value``, ``lower`` and ``measure``.
        """
        from lmdsl.interop.arrays import to_dataframe

        return to_dataframe(self)
