"""What `lmdsl completion` prints, sourced by bash and asked."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from lmdsl.cli import main

BASH = shutil.which("bash")
ASKED = """
source ./script
ask() {
  COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)) COMPREPLY=()
  _shtab_lmdsl
  echo "${COMPREPLY[*]}"
}
"""


def answers(folder, *lines: str) -> list[str]:
    asked = ASKED + "\n".join(f"ask lmdsl {line}" for line in lines)
    done = subprocess.run(
        [BASH, "--norc", "-c", asked], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


@pytest.mark.skipif(BASH is None, reason="needs bash")
def test_bash_completes_commands_options_files_and_names(tmp_path, capsys):
    pytest.importorskip("shtab", reason="needs shtab")
    assert main(["completion", "bash"]) == 0
    (tmp_path / "script").write_text(capsys.readouterr().out)
    (tmp_path / "problem.json").touch()
    asked = ["so", "solve --restr", "solve pro", "solve x.json --backend cl", "init van",
             "export out --format d", "completion z"]  # fmt: skip
    wanted = ["solve", "--restrict-to-gamma", "problem.json", "clarabel", "van_der_pol", "drn",
              "zsh"]  # fmt: skip
    assert answers(tmp_path, *asked) == wanted


def test_other_shells(capsys):
    pytest.importorskip("shtab", reason="needs shtab")
    assert main(["completion", "zsh"]) == 0
    assert capsys.readouterr().out.startswith("#compdef lmdsl")
    assert main(["completion", "cmd"]) == 2
    assert "'cmd' is not a shell that is known: bash" in capsys.readouterr().err


def test_without_the_package_it_is_said_how_to_get_it(monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert 'pip install "lmdsl[completion]"' in capsys.readouterr().err
