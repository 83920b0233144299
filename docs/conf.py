"""The site: what Sphinx makes of these pages, `sphinx-build -W docs site`.

The pages are read as they stand here. Navigation is the tables of index.md, a part for each of its
headings; the reference is made of the docstrings of the public names.
"""

from __future__ import annotations

import inspect
import re
import types
from typing import Any

import lmdsl as lm

project, author = "lmdsl", "The lmdsl developers"
release = version = lm.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4  # as on GitHub
exclude_patterns = ["conf.py"]
suppress_warnings = ["misc.highlighting_failure"]  # `...` in JSON that is printed

html_theme, html_title, html_show_sphinx = "furo", "lmdsl", False
html_theme_options = {"top_of_page_buttons": [], "navigation_with_keys": True}
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_copyright, html_copy_source = False, False
html_math_renderer = "mathml"  # browsers show it without a script, and without the network

autodoc_typehints, autodoc_typehints_format = "description", "short"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
napoleon_use_ivar = True
napoleon_use_rtype = False

MODULES = ("plotting", "exports", "interop", "backends", "systems", "testing")


# Navigation ------------------------------------------------------------------------------------


def parts(index: str) -> dict[str, list[str]]:
    """Return the pages of the tables of index.md by the heading above them, in order."""
    found: dict[str, list[str]] = {}
    for block in re.split(r"^## ", index, flags=re.MULTILINE)[1:]:
        pages = re.findall(r"^\| \[.*?\]\(([\w-]+)\.\w+\)", block, re.MULTILINE)
        found[block.splitlines()[0].strip()] = pages
    return found


def with_navigation(app: Any, name: str, source: list[str]) -> None:
    """Add the trees of contents to index.md, which GitHub shows without them."""
    source[0] = re.sub(r"\]\((\.\./[\w/-]+\.md)\)", r"](path:\1)", source[0])  # to be downloaded
    if name == "index":
        for title, pages in parts(source[0]).items():
            listed = "\n".join(pages)
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {title}\n\n{listed}\n```\n"
    elif name == "reference":
        source[0] += reference()


# The reference ---------------------------------------------------------------------------------


def entry(name: str, item: Any) -> str:
    """Return what shows the docstring of a function, class or exception."""
    if inspect.isclass(item):
        return f".. autoclass:: {name}\n   :members:\n   :show-inheritance:\n\n"
    return f".. autofunction:: {name}\n\n" if callable(item) else ""


def titled(title: str, entries: list[str]) -> str:
    """Return a section of entries."""
    return f"{title}\n{'-' * len(title)}\n\n{''.join(entries)}" if any(entries) else ""


def reference() -> str:
    """Return the sections of the reference: of lmdsl, then of each of its modules."""
    items = {name: getattr(lm, name) for name in sorted(lm.__all__, key=str.lower)}
    own = {n: x for n, x in items.items() if not isinstance(x, types.ModuleType)}
    verbs = [entry(f"lmdsl.{n}", x) for n, x in own.items() if not inspect.isclass(x)]
    classes = [entry(f"lmdsl.{n}", x) for n, x in own.items() if inspect.isclass(x)]
    text = titled("Functions", verbs) + titled("Classes", classes)
    for name, module in items.items():
        if isinstance(module, types.ModuleType):
            public = getattr(module, "__all__", [])
            entries = [entry(f"lmdsl.{name}.{n}", getattr(module, n)) for n in public]
            text += titled(f"lmdsl.{name}", entries)
    return text


# Mathematics -----------------------------------------------------------------------------------


def formula(self: Any, node: Any) -> None:
    """Write a formula as MathML; there is nothing below it to be written."""
    from docutils.nodes import SkipNode, math_block
    from latex2mathml.converter import convert

    own_line = isinstance(node, math_block)
    text = convert(node.astext(), display="block" if own_line else "inline")
    self.body.append(f'<div class="math">{text}</div>' if own_line else text)
    raise SkipNode


def setup(app: Any) -> None:
    """Connect all this with Sphinx."""
    app.connect("source-read", with_navigation)
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))
