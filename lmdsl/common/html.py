"""Objects in HTML, as notebooks show them: everything in it is text, nothing of it markup."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from lmdsl.errors import printable

LONGEST = 2_000  # characters of a cell
LEFT = "text-align:left;vertical-align:top"


def written(item: Any) -> str | None:
    """Return what an object says of itself in lines; None where it has no words of its own."""
    kind: Any = type(item)
    if kind.__str__ is object.__str__:
        return None
    lines = "\n".join(escape(printable(line)) for line in str(item).split("\n"))
    return f"<pre>{lines}</pre>"


def facts(rows: Iterable[tuple[str, Any]], title: str = "") -> str:
    """Return names and what is known of each, below one another."""
    body = "".join(f"<tr>{_cell('th', name)}{_cell('td', value)}</tr>" for name, value in rows)
    return f"<table>{_caption(title)}<tbody>{body}</tbody></table>"


def grid(
    head: Sequence[str], rows: Iterable[Sequence[Any]], title: str = "", note: str = ""
) -> str:
    """Return a table with a head, and a note below it."""
    top = "".join(_cell("th", name) for name in head)
    body = "".join(f"<tr>{''.join(_cell('td', value) for value in row)}</tr>" for row in rows)
    below = f"<p>{_text(note)}</p>" if note else ""
    table = f"<table>{_caption(title)}<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
    return f"<div>{table}{below}</div>"


def _cell(tag: str, value: Any) -> str:
    return f'<{tag} style="{LEFT}">{_text(value)}</{tag}>'


def _caption(title: str) -> str:
    if not title:
        return ""
    return f'<caption style="{LEFT};font-weight:bold">{_text(title)}</caption>'


def _text(value: Any) -> str:
    text = str(value)
    text = text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
    return "<br/>".join(escape(printable(line)) for line in text.split("\n"))
