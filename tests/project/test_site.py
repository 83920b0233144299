"""The site: what its configuration makes of the pages, and the words that are explained."""

from __future__ import annotations

import argparse
import inspect
import re
import runpy

from pages import ROOT, missing

import lmdsl as lm
from lmdsl import cli
from lmdsl.advice.studies import record
from lmdsl.cli import solving
from lmdsl.control import simulation
from lmdsl.data.report import DataReport
from lmdsl.explanation.one_cell import NAMES
from lmdsl.model.stabilizable_set import LOST
from lmdsl.results import comparison

CONF = runpy.run_path(str(ROOT / "docs/conf.py"))
INDEX = (ROOT / "docs/index.md").read_text()
WORDS = (ROOT / "docs/words.md").read_text()


def test_every_page_has_one_place_in_the_navigation():
    listed = [page for pages in CONF["parts"](INDEX).values() for page in pages]
    pages = [path.stem for kind in ("md", "rst") for path in (ROOT / "docs").glob(f"*.{kind}")]
    assert sorted([*listed, "index"]) == sorted(pages)


def test_a_new_page_gets_its_place():
    text = "# x\n\n## Start\n\n| page | what |\n|---|---|\n| [New](new.md) | ? |\n\n## Other\n"
    assert CONF["parts"](text) == {"Start": ["new"], "Other": []}
    source = [f"{text}see [changes](../CHANGELOG.md)\n"]
    CONF["with_navigation"](None, "index", source)
    assert ":caption: Start\n\nnew\n" in source[0]
    assert "(path:../CHANGELOG.md)" in source[0]


def test_every_public_name_is_in_the_reference():
    text = CONF["reference"]()
    for name in lm.__all__:
        item = getattr(lm, name)
        if inspect.ismodule(item):
            own = [x for x in getattr(item, "__all__", []) if callable(getattr(item, x))]
            assert all(f":: lmdsl.{name}.{x}\n" in text for x in own), name
        elif callable(item):
            assert f":: lmdsl.{name}\n" in text, name


# Words ------------------------------------------------------------------------------------------


def labels(function) -> list[str]:
    """The names of the lines that a function prints."""
    return re.findall(r'\(\s*"([a-z_]+(?: [a-z_]+)*)",', inspect.getsource(function))


def test_every_line_of_a_report_is_explained():
    lines = [*labels(solving.summary), *labels(DataReport.rows)]
    assert {"problem", "pairs", "improved", "gamma_bar", "assumes", "true cost"} <= {*lines}
    assert not missing(lines, WORDS)


def test_every_cause_is_explained():
    plain = WORDS.replace("*", "")
    for status in LOST:
        assert NAMES[status] in plain, NAMES[status]
    for word in re.findall(r'CellStatus\.\w+: "([a-z ]+)"', inspect.getsource(solving._others)):
        assert word in plain, word


def test_every_column_and_line_of_other_reports_is_explained():
    runs = re.findall(r'f?"  ([a-z]+(?: [a-z]+)*) {2,}\{', inspect.getsource(simulation))
    assert {"lost", "cycling", "steps"} <= {*runs}
    columns = [*comparison.HEAD, *(name for name, _, _ in record.COLUMNS)]
    known = WORDS.replace("*", "")
    assert not [word for word in (*runs, *columns) if word not in known]


def test_every_option_says_what_it_does():
    parser = cli.parser()
    (commands,) = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    for name, command in commands.choices.items():
        for action in command._actions:
            assert action.help, f"{name}: {action.option_strings or action.dest}"
            letters = re.search(r"\b(of|in|to|from) [AZC]\b", action.help)
            assert not letters, f"{name}: {action.help}"


def test_letters_of_the_mathematics_are_not_printed():
    """A, Z and C are for formulas; the reports of the command line say what they stand for."""
    for text in (inspect.getsource(solving.summary), inspect.getsource(solving._enclosed)):
        assert not re.search(r'"[^"]*\b[AZC]\b[^"]*"', text)
