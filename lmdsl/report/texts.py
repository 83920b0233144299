"""Texts of anybody's made inert, tables, and what the words of a page mean."""

import html
from collections.abc import Iterable, Sequence
from typing import Any

from lmdsl.errors import printable

WORDS = {
    "finite model": "the box of states cut into cells; from each cell, under each control, the "
    "map sends sample points on, and the shares of them that land in each cell are the model",
    "true map": "the map, or differential equation, as it was declared",
    "attractor A": "the cells that runs are to reach",
    "avoid Z": "the cells that no run may enter",
    "stabilizable": "of a cell: some law brings the finite model from there to A for certain, "
    "and never out of the box or into Z",
    "C": "the set of all stabilizable cells",
    "law": "the feedback controller: one control value for each cell",
    "m": "the weight by which starts are drawn and costs are averaged",
    "cost-to-go V": "what a run from a cell costs at most, in the mean, under this law",
    "lower bound W": "what a run from a cell costs at least, under any law",
    "gap": "by how much of the cost the law may be worse than the best one",
    "Lyapunov measure": "how often runs that start by m visit each cell before they reach A; "
    "that it exists means that almost all of them arrive",
    "contraction": "a number below 1: the mass that has not arrived shrinks as fast as its powers",
}


def text(value: Any) -> str:
    """Return a text of anybody's as HTML that is nothing but this text."""
    return html.escape(printable(str(value)))


def lines(value: str) -> str:
    """Return a text of several lines likewise."""
    return "\n".join(map(text, value.split("\n")))


def table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """Return a table of cells that are HTML already."""
    top = "".join(f'<th scope="col">{text(x)}</th>' for x in head)
    body = "".join(
        "<tr>" + "".join(f'<td data-head="{text(h)}">{x}</td>' for h, x in
                         zip(head, row, strict=True)) + "</tr>"
        for row in rows
    )  # fmt: skip
    return (
        f'<div class="scroll"><table class="{kind}"><thead><tr>{top}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def words() -> str:
    """Return what the words mean, as the entries of a list."""
    return "".join(f"<dt>{text(k)}</dt><dd>{text(v)}</dd>" for k, v in WORDS.items())
