"""Pages in headless Chromium: what is there when all is drawn, and what answers."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from lmdsl.errors import MissingDependency
from lmdsl.report import writing

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser",
                                                "google-chrome"))), None)  # fmt: skip
OPTIONS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
           "--hide-scrollbars", "--no-first-run", "--virtual-time-budget=20000")  # fmt: skip


def _plotly() -> bool:
    try:
        writing._library()
    except MissingDependency:
        return False
    return True


browser = pytest.mark.skipif(CHROMIUM is None or not _plotly(), reason="no Chromium, or no plotly")


def chromium(page: Path, *options: str, fragment: str = "") -> str:
    """What Chromium prints about a page."""
    profile = page.with_suffix(".profile")
    command = [str(CHROMIUM), *OPTIONS, f"--user-data-dir={profile}", *options,
               page.resolve().as_uri() + fragment]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout + "".join(re.findall(r"^.*:CONSOLE.*$", done.stderr, re.MULTILINE))


def dom(page: Path, fragment: str = "") -> str:
    """The document after its scripts ran."""
    return chromium(page, "--dump-dom", fragment=fragment)


def asked(page: Path, script: str) -> object:
    """What a script finds that acts on the page once it is drawn, its policy lifted for it.

    It may ``await``, knows ``wait(milliseconds)`` and returns what JSON can hold.
    """
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.read_text())
    own = f"""<script>(async () => {{
      const wait = (t) => new Promise((done) => setTimeout(done, t));
      for (let n = 0; n < 100 && document.documentElement.dataset.ready !== "yes"; n++) {{
        await wait(50);
      }}
      await wait(300);
      let said;
      try {{ said = await (async () => {{ {script} }})(); }} catch (e) {{ said = String(e.stack); }}
      const place = document.createElement("pre");
      place.id = "said";
      place.textContent = JSON.stringify(said);
      document.body.append(place);
    }})();</script>"""
    driven = page.with_name("driven.html")
    driven.write_text(text.replace("</body>", own + "</body>"))
    (found,) = re.findall(r'<pre id="said">(.*?)</pre>', dom(driven), re.DOTALL)
    return json.loads(found.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&"))
