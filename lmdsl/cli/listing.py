"""What there is, and where to start: ``schema``, ``systems``, ``init``, and others."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lmdsl.cli.output import Arguments, Command, print_json, shared
from lmdsl.cli.streams import say
from lmdsl.common import spelling
from lmdsl.common.optional import installed
from lmdsl.errors import BadInput, printable, shown


def add(command: Command) -> None:
    """Add the commands of this module."""
    command("schema", _schema, "Print the JSON Schema of the problem file.")
    shared(command("systems", _systems, "List the systems known by name."), "--json")
    init = command("init", _init, "Write a script for a system of your own, or the problem file of "
                   "one known by name.")  # fmt: skip
    init.add_argument("name", metavar="NAME", nargs="?", help="a system (see `lmdsl systems`)")
    init.add_argument("--json", dest="bare", action="store_true",
                      help="without NAME: the problem file instead of the script")  # fmt: skip
    init.add_argument("--out", metavar="FILE",
                      help="file to write (default NAME.json; own_system.py or .json)")  # fmt: skip
    shared(command("backends", _backends, "List the backends."), "--json")
    completion = command("completion", _completion, "Print what completes commands in a shell.")
    completion.add_argument("shell", metavar="SHELL", help="bash, zsh or tcsh")


def _schema(parsed: Arguments) -> int:
    from lmdsl.problem import json_schema

    print_json(json_schema(), indent=2)
    return 0


def _systems(parsed: Arguments) -> int:
    from lmdsl.systems import NAMED

    if parsed.json:
        entries = {
            name: {"summary": s.summary, "source": s.source, "parameters": dict(s.defaults)}
            for name, s in NAMED.items()
        }
        print_json(entries, indent=2)
        return 0
    width = max(map(len, NAMED))
    for name, system in NAMED.items():
        say(f"{name.ljust(width)}  {system.summary}")
        say(f"{' ' * width}    {system.source}")
    return 0


def _init(parsed: Arguments) -> int:
    from lmdsl.common.files import write_whole

    name, script = parsed.name or "own_system", parsed.name is None and not parsed.bare
    text = _script() if script else _problem_file(parsed.name)
    path = Path(parsed.out if parsed.out is not None else f"{name}{'.py' if script else '.json'}")
    if path.exists():
        raise BadInput(f"{shown(str(path), 200)} exists; remove it or choose another name", "out")
    write_whole(path, text.encode())
    file = printable(str(path))
    then = f"python {file}" if script else f"lmdsl solve {file} --out out"
    say(f"written to {file}; next: {then}")
    return 0


def _script() -> str:
    from lmdsl.cli.own_system import SCRIPT

    return SCRIPT


def _problem_file(name: str | None) -> str:
    """Return the problem file of a system known by name, or of one's own to start from."""
    from lmdsl.cli.own_system import declared
    from lmdsl.problem.problem import Problem
    from lmdsl.systems import NAMED

    if name is not None and name not in NAMED:
        near = spelling.hint(name, NAMED) or ";"
        known = ", ".join(NAMED)
        raise BadInput(f"{shown(name)} is not a system{near} known: {known}", "NAME")
    problem: Problem = Problem.model_validate(NAMED[name].problem if name else declared())
    return problem.to_json()


def _backends(parsed: Arguments) -> int:
    from lmdsl import backends

    listed: dict[str, dict[str, Any]] = {}
    for name in backends.names():
        try:
            backend = backends.get(name)
            listed[name] = {
                "available": True,
                "algorithms": list(backend.capabilities.algorithms),
                "not_installed": backends.missing(backend),
            }
        except BadInput as error:
            listed[name] = {"available": False, "reason": error.message}
    if parsed.json:
        print_json(listed, indent=2)
        return 0
    listed = {printable(name): entry for name, entry in listed.items()}
    width = max(map(len, listed))
    for name, entry in listed.items():
        if entry["available"]:
            missing = {k: f" (not installed: {v})" for k, v in entry["not_installed"].items()}
            text = ", ".join(k + missing.get(k, "") for k in entry["algorithms"]) or "any"
            mark = " (default)" if name == backends.DEFAULT else ""
            say(f"{name.ljust(width)}  algorithms: {text}{mark}")
        else:
            say(f"{name.ljust(width)}  not available: {entry['reason']}")
    return 0


def _completion(parsed: Arguments) -> int:
    try:
        import shtab
    except ImportError:
        message = f"shtab is not installed: {installed('completion')}"
        raise BadInput(message, "completion") from None
    if parsed.shell not in shtab.SUPPORTED_SHELLS:
        known = ", ".join(shtab.SUPPORTED_SHELLS)
        raise BadInput(f"{shown(parsed.shell)} is not a shell that is known: {known}", "SHELL")
    say(shtab.complete(_completed(shtab.FILE, shtab.SUPPORTED_SHELLS), parsed.shell))
    return 0


def _completed(file: Any, shells: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of the command line, with what may stand where a name or a file does."""
    from lmdsl import backends
    from lmdsl.cli import parser as of_commands
    from lmdsl.systems import NAMED

    parser = of_commands()
    choices = {"name": list(NAMED), "backend": backends.names(), "shell": shells}
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    for command in commands.choices.values():
        for action in command._actions:
            if action.metavar in ("FILE", "DIR"):
                action.complete = file
            elif action.dest in choices:
                action.choices = choices[action.dest]
    return parser
