"""Pages about results: how tests read them, and run their scripts without a browser."""

from __future__ import annotations

import html.parser
import json
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

import lmdsl as lm
from lmdsl.report.gathering import Beside, gathered
from lmdsl.report.page import page

SCRIPTS = Path(lm.__file__).parent / "report"
LIBRARY = "var Plotly = {}; // </script> stands in the library, too"
node = pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")


def told(result, **more):
    """The plain data of a page."""
    return gathered(result, Beside(result.lp, **more))


class Read(html.parser.HTMLParser):
    """The elements of a page with their attributes, its scripts and its text."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.tags, self.scripts, self.words, self.inside = [], [], [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self.inside = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag):
        self.inside = ""

    def handle_data(self, data):
        if self.inside == "script":
            self.scripts[-1] += data
        elif self.inside != "style":
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def written(result, **more):
    """A page with another library, read."""
    return Read(page(told(result, **more), LIBRARY))


def followed(data, code):
    """What JavaScript returns that knows the module ``f`` and a Follower ``F`` of the data."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "data.json"
        file.write_text(json.dumps(data))
        script = f"""
        const f = require({json.dumps(str(SCRIPTS / "follow.js"))});
        const data = JSON.parse(require("fs").readFileSync({json.dumps(str(file))}));
        (async () => {{
          const c = data.cells, held = c && {{ status: await f.unpacked(c.status),
            index: await f.unpacked(c.index), vectors: await f.unpacked(c.vectors) }};
          if (c && data.rows) {{
            held.rows = {{}};
            for (const [key, rows] of Object.entries(data.rows)) {{
              held.rows[key] = await f.unpacked(rows);
            }}
            held.rows.position = new Int32Array(held.status.length).fill(-1);
            let n = 0;
            held.status.forEach((s, i) => {{ if (s === 1) held.rows.position[i] = n++; }});
          }}
          const F = c && new f.Follower(data, held);
          console.log(JSON.stringify(await (async () => {{ {code} }})()));
        }})();"""
        done = subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)
