"""The walls of the house: who may import whom, what is public, what importing costs."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import house
import pytest

import lmdsl as lm

PACKAGE = Path(lm.__file__).parent

# Data flows one way: a package imports only from packages before it, inside functions too.
PACKAGES = [
    "errors", "machine", "common", "ranks", "formulas", "systems", "problem", "model",
    "certificate", "optimize", "slabs", "backends", "data", "proof", "control", "results",
    "distributed", "explanation", "advice", "plotting", "report", "interop", "testing", "cli",
    "__main__",
]  # fmt: skip

# Imports against the order, inside functions: methods that only forward to a later package.
FORWARDING = {
    ("model.lp", "results.exports.mps"), ("results.summary", "report.writing"),
    ("results.summary", "interop.arrays"),
}  # fmt: skip

PUBLIC = [
    "Area", "BadInput", "CellStatus", "Certificate", "CheckReport", "Comparison", "Controller",
    "Explanation", "Finding", "GammaBar", "LmdslError", "PhaseOne", "Problem", "Region", "Result",
    "Simulation", "StabilizationLP", "Study", "Suggestion", "TimeLimitReached", "Verification",
    "__version__", "backends", "check", "compare", "compile", "distributed", "explain", "exports",
    "from_data", "from_matrices", "gamma_max", "interop", "load", "plotting", "read_data", "solve",
    "study", "suggest", "systems", "testing", "verify",
]  # fmt: skip


def test_the_packages_are_those_of_the_plan():
    assert {house.package_of(name) for name in house.modules(PACKAGE) if name} == set(PACKAGES)


def test_imports_run_one_way():
    for (package, other), found in house.edges(PACKAGE).items():
        for name, imported, inside in found:
            if (name, imported) in FORWARDING:
                assert inside, f"{name} imports {imported}: inside a function, please"
                continue
            assert PACKAGES.index(other) < PACKAGES.index(package), f"{name} imports {imported}"


def test_every_forwarding_import_is_used():
    known = house.modules(PACKAGE)
    for name, imported in FORWARDING:
        assert (imported, True) in set(house.imports(known[name], known))


def test_no_modules_import_each_other_in_a_circle():
    known = house.modules(PACKAGE)
    graph = {
        name: {other for other, inside in house.imports(path, known) if other and not inside}
        for name, path in known.items()
    }
    for name in graph:  # a package's own names may come from its modules
        graph[name].discard(name)
    assert house.chain(graph) is not None


def test_the_judge_knows_nothing_of_the_judged():
    """Importing all of the certificate loads no package behind it, indirectly neither."""
    modules = [f"lmdsl.certificate.{path.stem}" for path in (PACKAGE / "certificate").glob("*.py")]
    code = (
        f"import sys, {', '.join(r for r in modules if '__init__' not in r)}; print([*sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for package in PACKAGES[PACKAGES.index("certificate") + 1 :]:
        assert f"'lmdsl.{package}" not in done.stdout, package


def test_no_module_takes_the_name_of_a_function():
    """Importing a module of that name would replace the function in its package."""
    for name, path in house.modules(PACKAGE).items():
        if path.name != "__init__.py":
            continue
        package = importlib.import_module(f"lmdsl.{name}".removesuffix("."))
        modules = {entry.stem for entry in path.parent.iterdir() if entry.suffix in (".py", "")}
        for module in modules - {"__init__", "__main__"}:
            assert not callable(vars(package).get(module)), f"{name}.{module}"
    assert not {"check", "suggest", "study", "from_data", "from_matrices"} & {
        path.stem for path in PACKAGE.iterdir()
    }


def test_a_class_name_stands_for_one_class():
    """Of the whole package, private names and names of types included."""
    places: dict[str, list[str]] = {}
    for module, path in house.modules(PACKAGE).items():
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(module)
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript):
                for target in node.targets:
                    if isinstance(target, ast.Name) and not target.id.isupper():
                        places.setdefault(target.id, []).append(module)
    assert not {name: found for name, found in places.items() if len(found) > 1}


# What changes filters of warnings, which are the process's: nothing that threads of ours run.
FILTERING = {
    "machine.kernels", "data.tables", "plotting.shown", "plotting.pages.writing", "backends.cvxpy",
    "testing.probe",
}  # fmt: skip


def test_threads_do_not_change_each_others_filters_of_warnings():
    """Two that do, each under a lock of its own, lose each other's: what compiles and solves."""
    changes = re.compile(r"catch_warnings|simplefilter|filterwarnings")
    found = {
        name for name, path in house.modules(PACKAGE).items() if changes.search(path.read_text())
    }
    assert found == FILTERING


def test_the_plan_lists_every_package_with_its_sentence():
    plan = (PACKAGE.parent / "docs/design.md").read_text()
    table = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", plan, re.MULTILINE))
    assert [name for name in table if name in PACKAGES] == PACKAGES[:-1]
    for package in PACKAGES[:-1]:
        text = inspect.getdoc(importlib.import_module(f"lmdsl.{package}")) or ""
        assert " ".join(text.split("\n\n")[0].split()) == table[package], package


def test_levels_are_small():
    levels = house.report(PACKAGE.parent)["modules a level"]
    named = {"systems"}  # one file per named system
    assert not {level: count for level, count in levels.items() if count > 11 and level not in
                ({"."} | named)}  # fmt: skip


def test_solver_libraries_are_imported_in_their_own_file_only():
    for name, path in house.modules(PACKAGE).items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                libraries = [alias.name for alias in node.names]
            else:
                libraries = [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            for library in libraries:
                package = library.split(".")[0]
                own = package == "casadi" and name == "systems.translated.casadi_systems"
                if package in ("highspy", "clarabel", "cvxpy", "casadi"):
                    assert own or name.startswith("backends."), f"{name} imports {library}"


def test_public_names_are_pinned():
    assert sorted(lm.__all__) == sorted(PUBLIC)
    for name in PUBLIC:
        assert getattr(lm, name) is not None
    with pytest.raises(AttributeError):
        lm.nonsense  # noqa: B018


def test_importing_is_light():
    code = "import sys, lmdsl; print(sorted(m for m in sys.modules if '.' not in m))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for heavy in ("numpy", "scipy", "numba", "pydantic", "highspy", "clarabel", "cvxpy",
                  "matplotlib"):  # fmt: skip
        assert f"'{heavy}'" not in done.stdout


def test_solving_loads_no_other_solver():
    code = (
        "import sys, lmdsl as lm; lm.solve(lm.Problem.model_validate("
        "lm.systems.NAMED['double_integrator'].problem).replaced(gamma=1.0));"
        "print(sorted(m for m in sys.modules if '.' not in m))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for heavy in ("highspy", "clarabel", "cvxpy", "matplotlib"):
        assert f"'{heavy}'" not in done.stdout


def documented():
    for name in PUBLIC:
        item = getattr(lm, name)
        if inspect.isclass(item) or inspect.isfunction(item):
            yield name, item
            if inspect.isclass(item):
                for method, function in vars(item).items():
                    if inspect.isfunction(function) and not method.startswith("_"):
                        yield f"{name}.{method}", function


@pytest.mark.parametrize(("name", "item"), list(documented()))
def test_public_parameters_are_documented(name, item):
    text = inspect.getdoc(item) or ""
    assert text, f"{name} has no docstring"
    if not inspect.isfunction(item) or "." in name:
        return
    for parameter in inspect.signature(item).parameters:
        assert parameter in text, f"{name} does not document {parameter}"


def imported_by(path):
    """The names of the packages that a file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
        yield from (name.split(".")[0] for name in names)


def test_the_checker_of_certificates_stands_alone():
    script = PACKAGE.parent / "tools/check_certificate.py"
    assert len(script.read_text().splitlines()) < 230
    files = [script, *(PACKAGE.parent / "tools/claim_7").glob("*.py")]
    assert len(files) == 8
    for path in files:
        assert {*imported_by(path)} <= {"claim_7", *sys.stdlib_module_names}, path.name
        assert len(path.read_text().splitlines()) <= 300, path.name


def test_the_reference_shares_no_code():
    known = {"numpy", "scipy", "reference", *sys.stdlib_module_names}
    files = [*Path(PACKAGE.parent / "tests/helpers/reference").glob("*.py")]
    assert len(files) > 10
    for path in files:
        assert {*imported_by(path)} <= known, path.name
        assert len(path.read_text().splitlines()) <= 320, path.name


def test_all_is_what_people_use():
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    (listed,) = extras["all"]
    found = re.fullmatch(r"lmdsl\[(.*)\]", listed)[1].split(",")
    ours = {"all", "bench", "docs", "lint", "notebooks", "peers", "readers", "test"}
    assert sorted(found) == sorted({*extras} - ours)


def test_no_file_is_too_long():
    long = {
        name: n
        for name, path in house.modules(PACKAGE).items()
        if (n := len(path.read_text().splitlines())) > 320
    }
    assert not long


def test_no_function_is_too_long():
    """Its docstring does not count."""
    long = {}
    for name, path in house.modules(PACKAGE).items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                first = node.body[ast.get_docstring(node) is not None :]
                if first and (n := node.end_lineno - first[0].lineno + 1) > 44:
                    long[f"{name}.{node.name}"] = n
    assert not long


def test_no_kernel_takes_too_many_arguments():
    """Arrays that belong together come as a named tuple."""
    for name, path in house.modules(PACKAGE).items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and any(
                ast.unparse(each).startswith("kernel") for each in node.decorator_list
            ):
                assert len(node.args.args) <= 10, f"{name}.{node.name}"


def test_no_test_file_is_too_long():
    lengths = {
        path.name: len(path.read_text().splitlines())
        for path in (PACKAGE.parent / "tests").rglob("test_*.py")
    }
    assert {name for name, lines in lengths.items() if lines > 400} == set()


def test_each_test_file_has_a_name_of_its_own():
    """Test files are modules without a package: two of one name cannot be collected together."""
    names = Counter(path.name for path in (PACKAGE.parent / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []


def test_what_the_code_refers_to_is_there():
    """Files that comments and docstrings name, and cross-references, survive no move unnoticed."""
    names = {path.name for path in PACKAGE.rglob("*.py")}
    for name, path in house.modules(PACKAGE).items():
        text = path.read_text()
        for file in re.findall(r"\b[a-z_]+\.py\b", text):
            assert file in names, f"{name} speaks of {file}"
        for target in re.findall(r":(?:mod|func|class|meth):`lmdsl\.([\w.]+)`", text):
            item = lm
            for part in target.split("."):
                if not hasattr(item, part):
                    item = importlib.import_module(f"{item.__name__}.{part}")
                else:
                    item = getattr(item, part)
