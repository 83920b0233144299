"""What a check returns: findings, and what compiling takes and gives as far as a survey shows."""

from dataclasses import dataclass
from typing import Any

from lmdsl.common.records import Reported
from lmdsl.machine import memory


@dataclass(frozen=True)
class Finding(Reported):
    """Something that looks wrong.

    Attributes
    ----------
    code
        One of the codes in the documentation of ``lmdsl check``, such as ``short_step``.
    where
        The path of the field at fault.
    text
        What was seen, one sentence.
    remedy
        What to write instead.
    figures
        The numbers behind it, by name.
    """

    code: str
    where: str
    text: str
    remedy: str
    figures: dict[str, Any]

    def __str__(self) -> str:
        return f"{self.code}, {self.where}: {self.text}\n  remedy: {self.remedy}"


@dataclass(frozen=True)
class Expectation(Reported):
    """What compiling a problem takes and gives, as far as a survey shows.

    Attributes
    ----------
    cells, controls, samples
        Number of cells, of control vectors, and of samples of a pair of both.
    admissible
        Share of the pairs from which no sample leaves; None where there are too many cells to say
        which of them are free.
    coverage
        Share of the cells outside attractor and avoid that can be stabilized; None if unknown, or
        if there is no such cell.
    coverage_cells
        The cells of each axis for which it was computed: the problem's own where that is cheap;
        else it is an estimate.
    memory, available
        Bytes that compiling and solving take, and that are left.
    seconds
        Seconds that compiling takes, roughly; None where it was not tried, as above.
    coverage_coarser
        Of an estimate, the share on the next coarser grid; None if unknown.
    attractor_widened
        Whether the attractor was widened to whole cells of that grid, which are larger.
    coverage_at_most
        Where the coverage is not known, the share of the cells tried that have a control from which
        no sample leaves: of the others nothing can be stabilized. None if unknown.
    """

    cells: int
    controls: int
    samples: int
    admissible: float | None
    coverage: float | None
    coverage_cells: dict[str, int] | None
    memory: int
    available: int
    seconds: float | None
    coverage_coarser: float | None = None
    attractor_widened: bool = False
    coverage_at_most: float | None = None

    def lines(self, own: dict[str, int]) -> list[str]:
        """Return sentences; ``own`` are the problem's own cells of each axis."""
        lines = [
            f"{self.cells:,} cells, {self.controls:,} controls, {self.samples:,} samples of each "
            f"pair{self._tried()}"
        ]
        if self.coverage is None and self.coverage_cells == own:
            lines.append("coverage: no cell lies outside attractor and avoid")
        elif self.coverage is None:
            lines.append(f"coverage: not known without the whole compilation{self._most()}")
        elif self.coverage_cells == own:
            lines.append(f"coverage: {100 * self.coverage:.3g} % can be stabilized")
        else:
            lines.append(f"coverage: about {100 * self.coverage:.3g} % can be stabilized, an "
                         f"estimate on {shape(self.coverage_cells)}{self._beside()}")  # fmt: skip
        time = "how long compiling so many cells takes is not known before"
        if self.seconds is not None:
            time = f"compiling takes about {_seconds(self.seconds)}"
        room = f"about {memory.human(self.memory)} of {memory.human(self.available)}"
        lines.append(f"memory: {room}; {time}")
        return lines

    def _tried(self) -> str:
        share = self.admissible
        return "" if share is None else f"; {100 * share:.3g} % of the pairs tried are admissible"

    def _most(self) -> str:
        if self.coverage_at_most is None:
            return ""
        share = 100 * self.coverage_at_most
        return f"; about {share:.3g} % at most: in the other cells tried a sample leaves always"

    def _beside(self) -> str:
        parts = []
        if self.attractor_widened:
            parts.append("with the attractor widened to whole cells there")
        if self.coverage_coarser is not None:
            parts.append(f"{100 * self.coverage_coarser:.3g} % on fewer still")
        return f" ({'; '.join(parts)})" if parts else ""


def shape(cells: dict[str, int] | None) -> str:
    """Return the cells of each axis as text, such as "40 x 30 cells"."""
    return " x ".join(str(count) for count in (cells or {}).values()) + " cells"


def _seconds(seconds: float) -> str:
    if seconds < 2:
        return "a second"
    if seconds < 120:
        return f"{seconds:.0f} seconds"
    return f"{seconds / 60:.0f} minutes" if seconds < 7200 else f"{seconds / 3600:.3g} hours"


@dataclass(frozen=True, repr=False)
class CheckReport(Reported):
    """What looks wrong with a problem before the long run.

    Attributes
    ----------
    findings
        What looks wrong, in the order of the keys of a problem file; empty where nothing does.
    expected
        What compiling takes and gives, as far as a survey shows.
    axes
        The cells of each axis.
    notes
        What is not wrong and may not be what was meant.
    """

    findings: tuple[Finding, ...]
    expected: Expectation
    axes: dict[str, int]
    notes: tuple[Finding, ...] = ()

    def __bool__(self) -> bool:
        """Return whether something was found."""
        return bool(self.findings)

    def text(self) -> str:
        """Return the report for people."""
        found = [str(finding) for finding in self.findings] or ["nothing looks wrong"]
        found += [f"note: {note}" for note in self.notes]
        return "\n\n".join(["\n".join(self.expected.lines(self.axes)), *found])

    __str__ = __repr__ = text
