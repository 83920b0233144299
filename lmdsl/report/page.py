"""One page of plain data: HTML that needs nothing but itself, and lets nothing else in.

Scripts are named by their SHA-256 in the page's policy, so that a browser runs these and no other,
whatever a name in a file looks like, and opens no connection.
"""

import base64
import hashlib
import json
from importlib.resources import files
from typing import Any

from lmdsl.report import sections
from lmdsl.report.texts import text

# What the script reads; the rest is written out as HTML.
READ = ("cells", "map", "samples", "rows", "starts", "loop", "survival")
SCRIPTS = ("follow.js", "slices.js", "pictures.js", "curves.js", "page.js")


def page(data: dict[str, Any], library: str) -> str:
    """Return the page; ``library`` is the source of plotly.js."""
    own = "\n".join(_asset(name) for name in SCRIPTS)
    scripts = [library.replace("</script", "<\\/script"), own]
    policy = (
        f"default-src 'none'; script-src {' '.join(map(_named, scripts))}; "
        "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    read = {name: data[name] for name in READ}
    held = json.dumps(read, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    title = text(data["problem"]["name"] or "A stabilization problem")
    body = "".join(_section(*part) for part in _parts(data))
    links = "".join(f'<a href="#{key}">{name}</a>' for key, name, _ in _parts(data))
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><meta name="referrer" '
        f'content="no-referrer"><title>{title}</title><style>{_asset("page.css")}</style></head>'
        "<body><noscript><p class='note'>The pictures need JavaScript; everything else does not."
        f"</p></noscript><main>{sections.heading(data)}<nav>{links}</nav>{body}</main>"
        "<footer>Written by lmdsl.</footer>"
        f'<script type="application/json" id="data">{held}</script>'
        + "".join(f"<script>{script}</script>" for script in scripts)
        + "</body></html>\n"
    )


def _parts(data: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the sections: key, title and HTML."""
    found = [
        ("problem", "The problem", sections.problem(data)),
        ("certified", "What is certified, and what is not", sections.claims(data)),
        ("pictures", "Pictures", sections.pictures(data)),
        ("loop", "The closed loop: spectrum and decay", sections.closed_loop(data)),
        ("runs", "Simulated runs", sections.simulation(data)),
        ("lost", "What cannot be stabilized", sections.lost(data)),
    ]
    if data["proof"] is not None:
        found.append(("proof", "Proved of the true map", sections.proof(data)))
    if data["comparison"] is not None:
        found.append(("backends", "Backends compared", sections.comparison(data)))
    return [*found, ("repeat", "How to repeat it", sections.repeat(data))]


def _section(key: str, title: str, inner: str) -> str:
    return f'<section id="{key}"><h2>{title}</h2>{inner}</section>'


def _named(script: str) -> str:
    digest = hashlib.sha256(script.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def _asset(name: str) -> str:
    return (files("lmdsl.report") / name).read_text(encoding="utf-8")
