"""The documentation is true: its code runs, its outputs are as printed, its lists are complete.

What is checked of README.md, CONTRIBUTING.md, CHANGELOG.md and docs/*.md:

- ``python`` blocks run, in the order of the page and in one namespace per page, in a fresh folder
  that holds a copy of examples/. A ``text`` block right after one is its output.
- ``json`` blocks with the key "format" load as problems.
- ``console`` blocks: each line ``$ lmdsl ...`` with output below it is run, and the output
  compared; ``$ echo $?`` states the exit status (0 where it is not stated). Without output the
  command line is only parsed.
- ``<!-- no-run: reason -->`` on the line before a block leaves it out; ``<!-- needs: package -->``
  does where the package is missing.
- In outputs ``...`` stands for anything, and runs of blanks count as one.
- Relative links lead to a file, and to a heading of it.

Further: every command-line option, key of the problem file, JSON key, array, function of
formulas, system, backend, module and public name is described where a reader would look for it.
"""

from __future__ import annotations

import contextlib
import doctest
import importlib.util
import io
import re
import shlex
import shutil

import matplotlib as mpl
import pytest
from pages import ROOT, blocks, missing, prose

import lmdsl as lm
from lmdsl import cli

mpl.use("Agg")
PAGES = [
    path
    for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md")
    for path in sorted(ROOT.glob(name))
]
LOOSE = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
page = pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
SLOW = {"tutorial.md", "command-line.md"}  # pages whose blocks are not run in other versions


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


# Blocks ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.name, marks=[pytest.mark.long] if path.name in SLOW else [])
        for path in PAGES
    ],
)
def test_blocks_run(path, tmp_path, monkeypatch):
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    printed = None  # by the Python block just before
    for block in blocks(path.read_text()):
        where = f"{path.name}, line {block.line}"
        last, printed = printed, None
        needed = re.match(r"<!-- needs: (\w+) -->", block.before)
        absent = needed is not None and importlib.util.find_spec(needed[1]) is None
        if block.before.startswith("<!-- no-run:") or absent:
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
        cli.parser().parse_args(words[1:])
        return
    found, got = run(words[1:])
    assert found == status, f"{where}: `{command}` gave {found}"
    assert same(got.rstrip(), output.rstrip()), f"{where}: `{command}` printed\n{got}"


# Links ----------------------------------------------------------------------------------------


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


# The tests of this file, tested ---------------------------------------------------------------


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
