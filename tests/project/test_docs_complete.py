"""The documentation is complete: every option, key, name and signature is described."""

from __future__ import annotations

import argparse
import doctest
import importlib
import inspect
import json
import pkgutil
import re

import pytest
from pages import ROOT, blocks, missing

import lmdsl as lm
from lmdsl import backends, cli, plotting
from lmdsl.formulas.operations import FORMULA_CONSTANTS, FORMULA_FUNCTIONS
from lmdsl.problem import json_schema
from lmdsl.results import comparison
from lmdsl.results.directory import archive, reading
from lmdsl.results.status import Status
from lmdsl.systems import NAMED
from lmdsl.testing.checks import CHECKS


def doc(name: str) -> str:
    return (ROOT / "docs" / name).read_text()


def section(text: str, heading: str) -> str:
    """From a heading to the next of the same or a higher level."""
    level = len(heading) - len(heading.lstrip("#"))
    assert f"\n{heading}\n" in text, f"there is no heading {heading}"
    rest = text.split(f"\n{heading}\n", 1)[1]
    return re.split(rf"^#{{1,{level}}} ", rest, maxsplit=1, flags=re.MULTILINE)[0]


def subcommands():
    parser = cli.parser()
    (choices,) = [a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    return choices


@pytest.mark.parametrize("command", subcommands())
def test_every_option_is_described(command):
    text = section(doc("command-line.md"), f"## `lmdsl {command}`")
    for action in subcommands()[command]._actions:
        names = [name for name in action.option_strings if name not in ("-h", "--help")]
        assert not missing(names, text)


def test_no_option_is_invented():
    text = doc("command-line.md")
    for command, parser in subcommands().items():
        known = {name for action in parser._actions for name in action.option_strings}
        rows = re.findall(r"^\| (`--.*?) \|", section(text, f"## `lmdsl {command}`"), re.MULTILINE)
        for option in re.findall(r"--[a-z-]+", " ".join(rows)):
            assert option in known, f"{command} has no {option}"


def test_every_key_of_the_problem_file_is_described():
    schema = json_schema()
    keys = {key for model in schema["$defs"].values() for key in model.get("properties", {})}
    assert not missing({*keys, *schema["properties"]}, doc("problem-file.md"))
    top = section(doc("problem-file.md"), "## Keys")
    for key, value in schema["properties"].items():
        (row,) = [line for line in top.splitlines() if re.match(rf"\| \[?`{re.escape(key)}`", line)]
        cells = [cell.strip() for cell in row.split("|")[2:4]]
        assert cells[0] == ("yes" if key in schema["required"] else "no"), key
        if "default" in value and key != "format":
            assert json.loads(cells[1].strip("`")) == value["default"], key


def test_the_whole_formula_language_is_described():
    text = section(doc("problem-file.md"), "## Formulas")
    assert not missing({*FORMULA_FUNCTIONS, *FORMULA_CONSTANTS}, text)
    grammar = next(b.text for b in blocks(doc("problem-file.md")) if "condition :" in b.text)
    assert grammar.split() == [
        word
        for line in importlib.import_module("lmdsl.formulas.language").__doc__.splitlines()
        if line.startswith("    ")
        for word in line.split()
    ]


def test_outputs_are_described():
    text = doc("command-line.md")
    result = lm.solve(lm.load(ROOT / "examples/logistic_map.json"))
    assert not missing([*result.to_dict(), *Status], section(text, "## `lmdsl solve`"))
    directory = section(text, "## The result directory")
    stored = archive.about(result)
    assert not missing(set(stored) - set(result.to_dict()), directory)
    arrays = {*archive.TYPES, *archive._model_arrays(result.lp)}
    assert not missing({*stored["claims"], *arrays}, directory)
    assert not missing([*reading.NAMES, "figures.png"], directory)
    runs = result.simulate(starts=5)
    assert not missing({*runs.to_dict(), *runs.steps}, section(text, "## `lmdsl simulate`"))
    compared = lm.compare(result.lp, ["policy-iteration"] * 2).to_dict()
    assert not missing({*compared, *compared["agreement"]}, section(text, "## `lmdsl compare`"))
    limit = lm.gamma_max(result.lp).to_dict()
    assert not missing(limit, section(text, "## `lmdsl gamma-max`"))
    found = set(lm.Verification.__dataclass_fields__) - {"certificate"}
    assert not missing({*found, "claims"}, section(text, "## `lmdsl verify`"))


def test_statuses_are_explained():
    tutorial = section(doc("tutorial.md"), "## What a status means")
    for code, status in enumerate(Status):
        assert f"| `{status}` | {code} |" in tutorial


def test_every_system_is_described():
    text = section(doc("systems.md"), "## Systems known by name")
    for kind, system in NAMED.items():
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{kind}` |")]
        assert system.source in row
        assert not missing(system.formulas.values(), row)
        for name, value in system.defaults.items():
            (shown,) = re.findall(rf"`{name}` \(([^)]*)\)", row)
            top, _, bottom = shown.partition("/")
            assert float(top) / float(bottom or 1) == value, f"{kind}.{name}"
        for name in ("step", "substeps"):
            if name in system.model_fields:
                assert f"`{name}` {system.model_fields[name].default}" in row


def test_every_backend_is_described():
    text = doc("backends.md")
    for name in backends.BUILT_IN:
        record = importlib.import_module(backends.BUILT_IN[name]).BACKEND
        assert not missing([name, *record.capabilities.algorithms], text)
    assert not missing(backends.Stop.__members__, text)
    for record in (backends.Capabilities, backends.Options, backends.Solution):
        assert not missing(record.__dataclass_fields__, text)


def test_every_test_file_of_the_plan_exists():
    for name in re.findall(r"`(\w+\.py)`", section(doc("design.md"), "## Tests")):
        assert [*(ROOT / "tests").rglob(name)], name


def members(item: type) -> set[str]:
    """The public methods, properties and fields of a class of ours."""
    own = {name for base in item.__mro__ if base.__module__.startswith("lmdsl") for name in
           {**vars(base), **getattr(base, "__annotations__", {})}}  # fmt: skip
    return {name for name in own if not name.startswith("_") and name != "model_config"}


def test_every_public_name_is_described():
    text = doc("python.md")
    assert not missing(lm.__all__, text)
    for module in (lm.backends, lm.testing):
        assert not missing(module.__all__, text)
    assert not missing(lm.distributed.__all__, doc("distributed.md"))
    assert not missing([name for name in vars(lm.systems) if name[0].isupper()], text)
    for record in (lm.StabilizationLP, lm.Certificate, lm.Controller, lm.Simulation,
                   lm.Comparison, lm.Verification, lm.GammaBar, lm.Result, lm.testing.Check,
                   lm.testing.Report):  # fmt: skip
        described = text + doc("command-line.md")
        assert not missing(members(record), described), record.__name__
    own = {name for name in vars(lm.Problem) if not name.startswith("_")}
    own -= {"model_config", "model_fields", "model_computed_fields"}
    assert not missing({name for name in own if callable(getattr(lm.Problem, name, None))}, text)


@pytest.mark.parametrize(
    "name",
    ["solve", "compare", "compile", "explain", "gamma_max", "load", "study", "suggest", "verify"],
)
def test_signatures_are_as_described(name):
    check_signature(f"lm.{name}", getattr(lm, name))


@pytest.mark.parametrize(
    "name", ["portrait", "cost", "causes", "control", "measure", "trajectories", "figure", "study"]
)
def test_signatures_of_plots_are_as_described(name):
    check_signature(name, getattr(plotting, name))


def test_the_signature_of_the_contract_suite_is_as_described():
    check_signature("check_backend", lm.testing.check_backend)


def test_every_check_of_the_contract_is_described():
    assert not missing(CHECKS, section(doc("backends.md"), "### Checking it"))


def check_signature(name: str, function) -> None:
    signature = inspect.signature(function)
    bare = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
    wanted = str(signature.replace(parameters=bare, return_annotation=signature.empty))
    wanted = wanted.replace("'", '"').replace(repr(comparison.BACKENDS).replace("'", '"'),
                                              "(...)")  # fmt: skip
    assert f"`{name}{wanted}`" in doc("python.md"), f"python.md should say {name}{wanted}"


def modules():
    for found in pkgutil.walk_packages(lm.__path__, "lmdsl."):
        if not found.name.endswith("__main__"):
            yield found.name


@pytest.mark.parametrize("name", ["lmdsl", *modules()])
def test_examples_in_docstrings(name):
    failed, _ = doctest.testmod(importlib.import_module(name))
    assert not failed
