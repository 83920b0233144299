"""The results as JSON, with everything measured, and as Markdown, with what one wants to know."""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def write(out: Path, results: dict[str, Any]) -> None:
    """Write ``results.json`` and ``results.md``, each whole or not at all."""
    out.mkdir(parents=True, exist_ok=True)
    _write_whole(out / "results.json", json.dumps(results, indent=1, allow_nan=True) + "\n")
    _write_whole(out / "results.md", "\n".join(markdown(results)) + "\n")


def _write_whole(path: Path, text: str) -> None:
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".")
    try:
        with os.fdopen(handle, "w") as file:
            file.write(text)
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise


def markdown(results: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of the report."""
    yield "# Benchmarks"
    yield ""
    yield from _about(results["about"], results["rules"])
    if results["targets"]:
        yield from _targets(results["targets"])
    for group in results["groups"]:
        yield from _group(group)
    if results["pipelines"]:
        yield from _pipelines(results["pipelines"])
    for micro in results["micro"]:
        yield from _micro(micro)


def _about(about: dict[str, Any], rules: dict[str, Any]) -> Iterator[str]:
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    yield f"    {about['command']}"
    yield ""
    yield f"- {about['date']}, commit {about['commit']}"
    memory = f", {about['memory'] / 1e9:.0f} GB" if about["memory"] else ""
    yield f"- {about['processor']}, {about['cores']} cores{memory}, {about['system']}"
    if about["load"]:
        yield f"- load at the start: {about['load'][0]:.2f}"
    variables = "".join(f", {name}={value}" for name, value in about["variables"].items())
    yield f"- Python {about['python']}, {versions}{variables}"
    yield (
        f"- medians of {rules['repeats']} solves after one that is not timed; fewer where they "
        f"would take more than {rules['budget']:g} s; limit {rules['limit']:g} s"
    )
    yield ""


def table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    """Yield a Markdown table; the first column is text, the others are numbers."""
    yield "| " + " | ".join(head) + " |"
    yield "|" + "|".join(["---"] + ["---:"] * (len(head) - 1)) + "|"
    for row in rows:
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"
    yield ""


def _targets(targets: list[dict[str, Any]]) -> Iterator[str]:
    yield "## Targets"
    yield ""
    words = {True: "yes", False: "**no**", None: "-"}
    rows = [[one["target"], one["goal"], one["measured"], words[one["met"]]] for one in targets]
    yield from table(["target", "goal", "measured", "met"], rows)


def _group(group: dict[str, Any]) -> Iterator[str]:
    yield f"## {group['model']}, gamma {group['gamma']:g}"
    yield ""
    if "failed" in group:
        yield f"Not measured: {group['failed']}"
        yield ""
        return
    yield (
        f"{group['stabilizable']:,} cells, {group['pairs']:,} pairs, {group['transitions']:,} "
        f"transitions; lmdsl's certificate: {group['status']}, gap {group['gap']:.1e}."
    )
    yield ""
    ranked = [row for row in group["rows"] if row["median"] is not None]
    others = [row for row in group["rows"] if row["median"] is None]
    rows = [_row(row) for row in sorted(ranked, key=lambda row: row["median"]) + others]
    head = ["contestant", "median", "least", "runs", "of lmdsl", "CPU", "peak", "error of V", ""]
    yield from table(head, rows)


def _row(row: dict[str, Any]) -> list[str]:
    remark = "; ".join(filter(None, [row["status"].partition(":")[2].strip(), row["note"]]))
    timed = row["median"] is not None
    return [
        row["contestant"],
        seconds(row["median"]) if timed else row["status"].partition(":")[0],
        seconds(min(row["wall"])) if timed else "",
        str(len(row["wall"])) if timed else "",
        "" if row["ratio"] is None else f"{row['ratio']:.3g}",
        seconds(statistics.median(row["cpu"])) if timed else "",
        memory(row["peak"]),
        "" if row["error"] is None else f"{row['error']:.0e}",
        remark,
    ]


def _pipelines(pipelines: list[dict[str, Any]]) -> Iterator[str]:
    yield "## Compile, solve and verify"
    yield ""
    rows = []
    for one in pipelines:
        if "failed" in one:
            rows.append([one["model"], one["failed"], *[""] * 8])
            continue
        median = {stage: statistics.median(times) for stage, times in one["seconds"].items()}
        stages = [seconds(median[stage]) for stage in ("compile", "solve", "verify", "total")]
        rows.append(
            [
                f"{one['model']}, gamma {one['gamma']:g}",
                f"{one['pairs']:,}",
                *stages,
                str(len(one["seconds"]["total"])),
                f"{1e9 * median['total'] / max(one['pairs'], 1):.0f}",
                memory(one["peak"]),
                memory(one["estimates"][-1] if one["estimates"] else None),
            ]
        )
    head = ["model", "pairs", "compile", "solve", "verify", "total", "runs", "ns per pair"]
    yield from table([*head, "peak", "estimate"], rows)


def _micro(micro: dict[str, Any]) -> Iterator[str]:
    yield f"## Stages of {micro['model']}"
    yield ""
    if "failed" in micro:
        yield f"Not measured: {micro['failed']}"
        yield ""
        return
    yield (
        f"gamma {micro['gamma']:g}, {micro['pairs']:,} pairs, {micro['entries']:,} transitions, "
        f"compact rows {memory(micro['rows_bytes'])}; medians of {micro['repeats']}."
    )
    yield ""
    rows = []
    for row in micro["rows"]:
        if "missing" in row:
            rows.append([row["what"], "", "", f"not measured: {row['missing']}"])
            continue
        limit = f"{row['ratio']:.3g} x {row['limit']}" if "ratio" in row else ""
        rows.append([row["what"], seconds(row["seconds"]), _per(row), limit])
    yield from table(["what", "median", "per unit", "of the limit"], rows)


def _per(row: dict[str, Any]) -> str:
    if row["unit"] == "byte":
        return f"{1 / row['ns']:.3g} GB/s"
    return f"{row['ns']:.3g} ns per {row['unit']}"


def seconds(value: float | None) -> str:
    """Return a time in a readable unit."""
    if value is None:
        return ""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value / 1e-6:.3g} µs"


def memory(count: float | None) -> str:
    """Return bytes in a readable unit."""
    if count is None:
        return ""
    return f"{count / 1e9:.3g} GB" if count >= 1e9 else f"{count / 1e6:.3g} MB"
