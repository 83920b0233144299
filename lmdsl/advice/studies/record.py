"""What a study returns: a row for every variant, as text, as data, as a table of pandas."""

from __future__ import annotations

from dataclasses import dataclass, fields
from importlib import import_module
from typing import TYPE_CHECKING, Any

from lmdsl.common import html
from lmdsl.common.records import Reported
from lmdsl.errors import BadInput, printable

if TYPE_CHECKING:
    from lmdsl.advice.studies.orders import Order


@dataclass(frozen=True)
class StudyRow(Reported):
    """What became of one variant.

    Attributes
    ----------
    cells, samples, step, gamma, backend
        The variant: cells of each axis; sample points of each axis of a grid, else of a cell;
        sampling time, None of a map.
    status
        As of a result; ``bad_input`` where there is no such problem.
    cost, lower_bound, gap
        As of a result.
    coverage
        Share of the cells outside attractor and avoid that are stabilizable.
    attractor
        Share of the cells that are the attractor: of the declared one, whole cells.
    pairs
        Number of surviving pairs.
    arrives, interval
        Share of the runs of the true map, from C, that arrive, and its 95 % interval; None where
        none were made.
    steps, time
        Median steps of those that arrive, and median time; None of a map, and where none does.
    iterations
        Of the backend.
    compile_seconds, solve_seconds, verify_seconds
        Wall-clock time; the first None where the compiled model was at hand.
    message
        One sentence.
    """

    cells: dict[str, int]
    samples: int | None
    step: float | None
    gamma: float
    backend: str
    status: str
    cost: float | None = None
    lower_bound: float | None = None
    gap: float | None = None
    coverage: float | None = None
    attractor: float | None = None
    pairs: int | None = None
    arrives: float | None = None
    interval: tuple[float, float] | None = None
    steps: int | None = None
    time: float | None = None
    iterations: int | None = None
    compile_seconds: float | None = None
    solve_seconds: float | None = None
    verify_seconds: float | None = None
    message: str = ""

    @property
    def brought(self) -> float | None:
        """Coverage times the share that arrives: of the free cells, what is brought to A."""
        known = self.coverage is not None and self.arrives is not None
        return self.coverage * self.arrives if known else None  # type: ignore[operator]


# Columns of the table: heading, value, how it is written.
COLUMNS = (
    ("cells", lambda row: "x".join(map(str, row.cells.values())), ""),
    ("samples", lambda row: row.samples, ""),
    ("step", lambda row: row.step, ".6g"),
    ("gamma", lambda row: row.gamma, ".6g"),
    ("backend", lambda row: row.backend, ""),
    ("status", lambda row: row.status, ""),
    ("cost", lambda row: row.cost, ".6g"),
    ("gap", lambda row: row.gap, ".1e"),
    ("coverage", lambda row: row.coverage, ".1%"),
    ("attractor", lambda row: row.attractor, ".3%"),
    ("arrives", lambda row: row.arrives, ".1%"),
    ("steps", lambda row: row.steps, ""),
    ("compile", lambda row: row.compile_seconds, ".2f"),
    ("solve", lambda row: row.solve_seconds, ".2f"),
)


@dataclass(frozen=True)
class Study(Reported):
    """Variants of a problem, side by side.

    Attributes
    ----------
    name
        The problem's.
    rows
        One for each variant, in the order in which they were solved.
    orders
        How cost and coverage settle, where three or more variants show it.
    """

    name: str
    rows: tuple[StudyRow, ...]
    orders: tuple[Order, ...] = ()

    def __len__(self) -> int:
        """Return the number of variants."""
        return len(self.rows)

    def table(self) -> str:
        """Return the study as text: a table, messages of what is not verified, and orders."""
        head, rows = self._cells()
        lines = [head, *rows]
        widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
        text = ["  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) for line in lines]
        text.insert(1, "  ".join("-" * w for w in widths))
        return "\n".join(line.rstrip() for line in [*text, *self._notes()])

    __str__ = table

    def _repr_html_(self) -> str:
        return html.grid(*self._cells(), "Study", "\n".join(self._notes()))

    def _cells(self) -> tuple[list[str], list[list[str]]]:
        """Return the heads of the columns, and the rows as text."""
        rows = [[_cell(read(row), how) for _, read, how in COLUMNS] for row in self.rows]
        return [name for name, _, _ in COLUMNS], rows

    def _notes(self) -> list[str]:
        """Return what is said below the table."""
        notes = [
            printable(f"{' '.join(line[:5])}: {row.message}")
            for line, row in zip(self._cells()[1], self.rows, strict=True)
            if row.status != "verified" and row.message
        ]
        told = [order for order in self.orders if order.order is not None or order.why]
        return notes + [str(order) for order in told]

    def records(self) -> list[dict[str, Any]]:
        """Return a flat dictionary for each row: the cells of each axis under ``cells.NAME``."""
        found = []
        for row in self.rows:
            flat: dict[str, Any] = {f"cells.{name}": n for name, n in row.cells.items()}
            for key in (f.name for f in fields(row)):
                if key == "interval":
                    low, high = row.interval or (None, None)
                    flat |= {"arrives_low": low, "arrives_high": high}
                elif key != "cells":
                    flat[key] = getattr(row, key)
            found.append(flat)
        return found

    def to_dataframe(self) -> Any:
        """Return the rows as a table of pandas, which is needed for it."""
        try:
            pandas: Any = import_module("pandas")
        except ImportError:
            raise BadInput("a table needs pandas: pip install pandas; or use records()") from None
        return pandas.DataFrame(self.records())


def _cell(value: Any, how: str) -> str:
    return "-" if value is None else printable(format(value, how))
