"""The pages of the documentation, and what stands on them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]


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


def missing(names, text: str) -> list[str]:
    """The names that are not in code in a text."""
    spans = " ".join(re.findall(r"`[^`\n]+`", prose(text)))
    return [name for name in names if not re.search(rf"(?<![\w-]){re.escape(name)}(?!\w)", spans)]
