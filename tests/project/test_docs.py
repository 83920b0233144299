"""The documentation is true: its code runs, its outputs are as printed, its lists are complete.

What is checked of README.md, CONTRIBUTING.md, CHANGELOG.md and docs/*.md:

- ``python`` blocks run, in the order of the page and in one namespace per page, in a fresh folder
  that holds a copy of examples/. A ``text`` block right after one is its output.
- ``json`` blocks with the key "format" load as problems.
- ``console`` blocks: each line ``$ lmdsl ...`` with output below it is run, and the output
  compared; ``$ echo $?`` states the exit status (0 where it is not stated). Without output the
  command line is only parsed.
- ``<!-- no-run: reason -->`` on the line before a block leaves it out.
- In outputs ``...`` stands for anything, and runs of blanks count as one.
- Relative links lead to a file, and to a heading of it.

Further: every command-line option, key of the problem file, JSON key, array, function of
formulas, system, backend, module and public name is described where a reader would look for it.
"""

from __future__ import annotations

import argparse
import contextlib
import doctest
import importlib
import inspect
import io
import json
import pkgutil
import re
import shlex
import shutil
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import pytest

import lmdsl as lm
from lmdsl import backends, cli, plotting
from lmdsl.formulas.operations import FORMULA_CONSTANTS, FORMULA_FUNCTIONS
from lmdsl.problem import problem
from lmdsl.results import comparison
from lmdsl.results.directory import archive
from lmdsl.results.status import Status
from lmdsl.systems import NAMED
from lmdsl.testing.checks import CHECKS

mpl.use("Agg")

ROOT = Path(__file__).parents[2]
PAGES = [
    path
    for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md")
    for path in sorted(ROOT.glob(name))
]
LOOSE = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE

page = pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)


class Block(NamedTuple):
    """A fenced block: its language, text, first line, and what stands on the line before it."""

    language: str
    text: str
    line: int
    before: str


def blocks(text: str) -> list[Block]:
    found, lines = [], text.splitlines()
    fence, start, before = "", 0, ""
    for number, line in enumerate(lines, 1):
        mark = re.match(r"```+", line)
        if not fence and mark:
            fence, start = mark.group(), number
        elif fence and line.strip() == fence:
            language = lines[start - 1].removeprefix(fence).strip()
            body = "\n".join(lines[start : number - 1])
            before = next((x for x in reversed(lines[: start - 1]) if x.strip()), "")
            found.append(Block(language, body, start + 1, before))
            fence = ""
    assert not fence, f"the block that starts on line {start} does not end"
    return found


def prose(text: str) -> str:
    """The page without its blocks, line by line in place."""
    kept, inside = [], False
    for line in text.splitlines():
        fence = line.startswith("```")
        kept.append("" if inside or fence else line)
        inside ^= fence
    return "\n".join(kept)


def same(got: str, wanted: str) -> bool:
    return doctest.OutputChecker().check_output(wanted + "\n", got + "\n", LOOSE)


def run(arguments: list[str]) -> tuple[int, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = cli.main(arguments)
    assert "internal error" not in err.getvalue(), err.getvalue()
    return status, out.getvalue()


def commands(text: str) -> list[tuple[str, str, int]]:
    """The commands of a console block, their printed outputs and stated exit statuses."""
    found: list[tuple[str, list[str], int]] = []
    asked = False
    for line in text.splitlines():
        if line == "$ echo $?":
            asked = True
        elif line.startswith("$ "):
            found.append((line.removeprefix("$ "), [], 0))
            asked = False
        elif asked:
            found[-1] = (*found[-1][:2], int(line))
        else:
            found[-1][1].append(line)
    return [(command, "\n".join(output), status) for command, output, status in found]


# Blocks -------------------------------------------------------------------------------------


@page
def test_blocks_run(path, tmp_path, monkeypatch):
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    printed = None  # by the Python block just before
    for block in blocks(path.read_text()):
        where = f"{path.name}, line {block.line}"
        last, printed = printed, None
        if block.before.startswith("<!-- no-run:"):
            continue
        if block.language == "python":
            code = compile("\n" * (block.line - 1) + block.text, str(path), "exec")
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(code, namespace)
            printed = out.getvalue()
        elif block.language == "text" and block.before == "```":
            if last is not None:
                assert same(last.rstrip(), block.text), f"{where}: printed\n{last}"
        elif block.language == "console":
            for command, output, status in commands(block.text):
                check_command(command, output, status, where)
        elif block.language == "json" and '"format"' in block.text:
            file = tmp_path / "shown.json"
            file.write_text(block.text)
            lm.load(file)


def check_command(command: str, output: str, status: int, where: str) -> None:
    words = shlex.split(command, comments=True)
    if words[0] != "lmdsl":
        return
    if not output and not status:
        cli._parser().parse_args(words[1:])
        return
    found, got = run(words[1:])
    assert found == status, f"{where}: `{command}` gave {found}"
    assert same(got.rstrip(), output.rstrip()), f"{where}: `{command}` printed\n{got}"


# Links --------------------------------------------------------------------------------------


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ +(.*)$", prose(text), re.MULTILINE):
        plain = re.sub(r"\[(.*?)\]\(.*?\)", r"\1", heading).strip().lower()
        anchor = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        copies = sum(bool(re.fullmatch(rf"{re.escape(anchor)}(-\d+)?", a)) for a in found)
        found.add(f"{anchor}-{copies}" if copies else anchor)
    return found


@page
def test_links_lead_somewhere(path):
    text = re.sub(r"`[^`\n]*`", "", prose(path.read_text()))
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (path.parent / name).resolve() if name else path
        assert file.exists(), f"{path.name}: {target} leads nowhere"
        if anchor:
            assert anchor in anchors(file.read_text()), f"{path.name}: no heading {target}"


def test_every_page_is_on_the_map():
    index = (ROOT / "docs/index.md").read_text()
    for path in (ROOT / "docs").glob("*.md"):
        assert path.name == "index.md" or f"({path.name})" in index, path.name


# Completeness -------------------------------------------------------------------------------


def doc(name: str) -> str:
    return (ROOT / "docs" / name).read_text()


def section(text: str, heading: str) -> str:
    """From a heading to the next of the same or a higher level."""
    level = len(heading) - len(heading.lstrip("#"))
    assert f"\n{heading}\n" in text, f"there is no heading {heading}"
    rest = text.split(f"\n{heading}\n", 1)[1]
    return re.split(rf"^#{{1,{level}}} ", rest, maxsplit=1, flags=re.MULTILINE)[0]


def missing(names, text: str) -> list[str]:
    """The names that are not in code in a text."""
    spans = " ".join(re.findall(r"`[^`\n]+`", prose(text)))
    return [name for name in names if not re.search(rf"(?<![\w-]){re.escape(name)}(?!\w)", spans)]


def subcommands():
    parser = cli._parser()
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
    schema = problem.json_schema()
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
    stored = archive._certificate(result)
    assert not missing(set(stored) - set(result.to_dict()), directory)
    assert not missing({*stored["claims"], *archive.TYPES, *archive.MODEL}, directory)
    assert not missing(archive.FILES, directory)
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
    for module in (lm.systems, lm.backends, lm.testing):
        assert not missing(module.__all__, text)
    for record in (lm.StabilizationLP, lm.Certificate, lm.Controller, lm.Simulation,
                   lm.Comparison, lm.Verification, lm.GammaBar, lm.Result, lm.testing.Check,
                   lm.testing.Report):  # fmt: skip
        described = text + doc("command-line.md")
        assert not missing(members(record), described), record.__name__
    own = {name for name in vars(lm.Problem) if not name.startswith("_")}
    own -= {"model_config", "model_fields", "model_computed_fields"}
    assert not missing({name for name in own if callable(getattr(lm.Problem, name, None))}, text)


@pytest.mark.parametrize(
    "name", ["solve", "compare", "compile", "explain", "gamma_max", "load", "verify"]
)
def test_signatures_are_as_described(name):
    check_signature(f"lm.{name}", getattr(lm, name))


@pytest.mark.parametrize(
    "name", ["portrait", "cost", "causes", "control", "measure", "trajectories", "figure"]
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


# The tests of this file, tested -------------------------------------------------------------


def test_a_wrong_page_is_noticed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert same("cost 3.58483 in 0.1 s", "cost 3.58... in ... s")
    assert not same("cost 3.58483", "cost 3.59...")
    assert commands("$ lmdsl backends\na\n$ echo $?\n3\n$ ls") == [
        ("lmdsl backends", "a", 3),
        ("ls", "", 0),
    ]
    with pytest.raises(AssertionError, match="gave 0"):
        check_command("lmdsl backends", "...", 1, "here")
    with pytest.raises(AssertionError, match="printed"):
        check_command("lmdsl backends", "nothing", 0, "here")
    with pytest.raises(SystemExit):
        check_command("lmdsl solve x --nonsense", "", 0, "here")
    assert missing(["--out", "cell", "gamma"], "`--outer` `cells` `gamma`") == ["--out", "cell"]
    assert anchors("# What `lmdsl` is\n```\n# no\n```\n## A, b") == {"what-lmdsl-is", "a-b"}
    (block,) = blocks("x\n\n<!-- no-run: why -->\n```python\n1/0\n```\n")
    assert block == ("python", "1/0", 5, "<!-- no-run: why -->")
