"""Write docs/commands.md from the flags of `hector`, the Makefile and the scripts.

python docs/commands.py
"""

import ast
import inspect
import re
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any

from hector_jax.cli.flags import COMMANDS

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "commands.md"
_HEAD = """\
# Commands

This page is the reference of all commands and flags, for whoever looks one up. It is written from
the code by `python docs/commands.py`; do not edit it. `hector COMMAND --help-all` shows the same
with choices. A flag without a value is a switch; `--no-NAME` turns it off where it is
on. A value that begins with a dash is written `--out=-dash.npz`. `hector --tyro-print-completion
bash` (or zsh, fish) prints the script that completes `hector` in a shell.
"""


def _comments(kind: type) -> dict[str, str]:
    """Return the comments of a class's own fields: behind a field, or in the lines above it."""
    found: dict[str, str] = {}
    above: list[str] = []
    for line in inspect.getsource(kind).splitlines():
        if comment := re.match(r"    # (.*)", line):
            above.append(comment[1])
        elif field := re.match(r"    (\w+): (?:[^#]*)(?:# (.*))?$", line):
            found[field[1]] = field[2] or " ".join(above)
            above = []
        else:
            above = []
    return found


def _default(field: Field[Any]) -> str:
    value = field.default
    if value is MISSING:
        return "required"
    if value is None:
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    text = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return f"`{text}`" if text else ""


def _section(name: str, kind: type[Any]) -> str:
    comments: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        comments |= _comments(base)
    text, _, example = (inspect.getdoc(kind) or "").replace("\n", " ").partition("Example: ")
    rows = [f"## hector {name}", "", " ".join(text.split()), "", f"    {example}"]
    own = inspect.get_annotations(kind)
    # those of all commands last
    flags = sorted(fields(kind), key=lambda field: field.name not in own)
    if flags:
        rows += ["", "| flag | what it does | default |", "|---|---|---|"]
    for field in flags:
        required = field.default is MISSING
        flag = field.name.upper() if required else f"--{field.name.replace('_', '-')}"
        text = re.sub(r"\bdocs/([\w/-]+\.md)", r"[page](\1)", comments[field.name])
        rows.append(f"| `{flag}` | {text} | {_default(field)} |")
    return "\n".join(rows)


def _scripts() -> str:
    rows = ["| script | question |", "|---|---|"]
    for path in sorted((ROOT / "experiments").glob("*.py")):
        text = path.read_text()
        if "__main__" in text:
            first = (ast.get_docstring(ast.parse(text)) or "").splitlines()[0]
            rows.append(f"| `experiments/{path.name}` | {first} |")
    return "\n".join(rows)


def _targets() -> str:
    lines = re.findall(r"^([a-z-]+):.*?## (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    rows = [f"| `make {name}` | {text.replace('|', ' or ')} |" for name, text in lines]
    return "\n".join(["| target | what it does |", "|---|---|", *rows])


def page() -> str:
    """Return the page."""
    parts = [_HEAD.rstrip(), *(_section(name, kind) for name, kind in COMMANDS.items())]
    scripts = (
        "Each has `--help` and writes its report into a folder of its own, by default below `runs`."
    )
    parts += [f"## Scripts\n\n{scripts}\n\n{_scripts()}", f"## make\n\n{_targets()}"]
    parts.append(
        "`python -m benchmarks` measures this machine and writes JSON into `runs/bench`.\n"
        "`python -m benchmarks.golden` compares the results of two commits, and\n"
        "`python -m benchmarks.mutation` plants faults and counts those that tests catch."
    )
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
