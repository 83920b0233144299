"""The house in numbers: modules a level, imports between packages, lengths, files to touch.

``python tests/helpers/house.py [FOLDER]`` prints them; ``test_design.py`` uses the same functions.
Imports under TYPE_CHECKING do not count; those inside functions do, and are told apart.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

WORDS = {"a claim": "lower_bound", "a problem key": "on_exit", "an output format": "drn"}


def modules(package: Path) -> dict[str, Path]:
    """Return the modules of a package by dotted name, the package's own name left out."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package).with_suffix("").parts
        found[".".join(part for part in parts if part != "__init__")] = path
    return found


def imports(path: Path, known: dict[str, Path]) -> Iterator[tuple[str, bool]]:
    """Yield the modules of the package that a module imports, and whether inside a function."""

    def walk(node: ast.AST, inside: bool) -> Iterator[tuple[str, bool]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                yield from (found for part in child.orelse for found in walk(part, inside))
                continue
            if isinstance(child, ast.ImportFrom) and f"{child.module}.".startswith("lmdsl."):
                base = str(child.module).removeprefix("lmdsl").removeprefix(".")
                for name in child.names:
                    inner = f"{base}.{name.name}".removeprefix(".")
                    yield (inner if inner in known else base), inside
            yield from walk(child, inside or isinstance(child, ast.FunctionDef | ast.Lambda))

    yield from walk(ast.parse(path.read_text()), False)


def package_of(name: str) -> str:
    """Return the package at the top level that a module is in."""
    return name.split(".")[0]


def edges(package: Path) -> dict[tuple[str, str], list[tuple[str, str, bool]]]:
    """Return the imports between top-level packages: who, whom, and whether inside a function."""
    known, found = modules(package), {}
    for name, path in known.items():
        for other, inside in imports(path, known) if name else ():
            if other and package_of(other) != package_of(name):
                found.setdefault((package_of(name), package_of(other)), []).append(
                    (name, other, inside)
                )
    return found


def chain(graph: dict[str, set[str]]) -> list[str] | None:
    """Return the longest chain of imports; None where they go round in a circle."""
    longest: dict[str, list[str]] = {}

    def below(name: str, above: tuple[str, ...]) -> list[str]:
        if name in above:
            raise RecursionError
        if name not in longest:
            ways = [below(other, (*above, name)) for other in graph.get(name, ())]
            longest[name] = [name, *max(ways, key=len, default=[])]
        return longest[name]

    try:
        return max((below(name, ()) for name in list(graph)), key=len, default=[])
    except RecursionError:
        return None


def touched(root: Path, what: str, word: str) -> int:
    """Return how many files of lmdsl one more of something touches.

    By the table of docs/design.md, which ``test_extending.py`` holds; a checkout without the table
    is judged by the files that hold the name of one that is there.
    """
    plan = root / "docs/design.md"
    rows = re.findall(rf"^\| {what} \| (.*?) \|", plan.read_text(), re.MULTILINE)
    if rows:
        return len(set(re.findall(r"`([\w/.]+\.py)`", rows[0])))
    known = modules(root / "lmdsl").values()
    return sum(bool(re.search(rf"\b{word}\b", path.read_text())) for path in known)


def report(root: Path) -> dict[str, object]:
    """Return the numbers of a checkout."""
    package = root / "lmdsl"
    known = modules(package)
    tops = {package_of(name) for name in known if name}
    between = edges(package)
    apart = {
        a: {b for c, b in between if c == a and not all(i for *_, i in between[a, b])} for a in tops
    }
    inner = {
        n: {o for o, i in imports(p, known) if o and not i and o != n} for n, p in known.items()
    }
    levels = {
        p.relative_to(package).as_posix(): sum(
            (q.suffix == ".py" and q.stem != "__init__") or (q / "__init__.py").exists()
            for q in p.iterdir()
        )
        for p in package.rglob("")
        if (p / "__init__.py").exists()
    }
    lengths = {n or "__init__": len(p.read_text().splitlines()) for n, p in known.items()}
    functions = {
        f"{n}.{node.name}": node.end_lineno - node.lineno + 1
        for n, p in known.items()
        for node in ast.walk(ast.parse(p.read_text()))
        if isinstance(node, ast.FunctionDef)
    }
    return {
        "modules a level": levels,
        "longest chain of modules": chain(inner) and len(chain(inner)),
        "longest chain of packages": chain(apart),
        "longest file": max(lengths.items(), key=lambda x: x[1]),
        "longest function": max(functions.items(), key=lambda x: x[1]),
        "lines of code": sum(lengths.values()),
        **{f"files to touch for {what}": touched(root, what, word) for what, word in WORDS.items()},
    }


if __name__ == "__main__":
    for what, value in report(Path(sys.argv[1]) if sys.argv[1:] else Path(".")).items():
        print(f"{what}: {value}")
