"""The tables of ``docs/zoo.md``, between marks ``<!-- zoo: NAME -->`` and ``<!-- end -->``."""

from __future__ import annotations

import re

from benchmarks.zoo import ROOT, Entry

PAGE = ROOT / "docs/zoo.md"
HEAD = "| cells | A | C | coverage | cost | gamma_bar | arrive | lost |\n" + "|---" * 8 + "|\n"


def row(grid: Entry) -> str:
    """Return one grid as a row of a table."""
    limit, runs = grid["gamma_bar"], grid["runs"] or {}
    shown = (
        " x ".join(map(str, grid["cells"])),
        grid["attractor_cells"],
        grid["stabilizable_cells"],
        f"{100 * grid['coverage']:.1f} %",
        f"{grid['cost']:.5g}",
        "none" if limit is None else f"{limit[0]:.4f}",
        _share(runs.get("reached")),
        _share(runs.get("lost")),
    )
    return "| " + " | ".join(map(str, shown)) + " |"


def _share(runs: int | None) -> str:
    return "-" if runs is None else f"{runs / 10:.1f} %"


def overview(entries: dict[str, Entry]) -> str:
    """Return the table of all systems, each at its finest grid."""
    rows = []
    for name, entry in entries.items():
        if known := solved(entry):
            rows.append(f"| [{name}](#{name}) | `{entry['file']}` {row(known[-1])}")
    return "| system | problem file " + HEAD.replace("|---" * 8, "|---" * 10) + "\n".join(rows)


def solved(entry: Entry) -> list[Entry]:
    """Return the grids that have been solved."""
    return [grid for grid in entry["grids"] if "cost" in grid]


def filled(text: str, entries: dict[str, Entry]) -> str:
    """Return the page with its tables as the golden values have them."""
    tables = {name: HEAD + "\n".join(map(row, solved(e))) for name, e in entries.items()}
    tables["all"] = overview(entries)

    def table(found: re.Match[str]) -> str:
        return f"{found[1]}\n\n{tables[found[2]]}\n\n<!-- end -->"

    return re.sub(r"(<!-- zoo: (\w+) -->).*?<!-- end -->", table, text, flags=re.DOTALL)
