"""The console script `hector`: flags in, exit code out.

Flags come from the line, else from the file that `--config` names, else from their defaults.
Results go to stdout, everything said while waiting to stderr. Exit codes: 0 done; 1 something is
broken: `hector doctor` found it, a worker process was killed, or a fault of this program with its
traceback; 2 bad input, with what came, where, and what was expected: one line, or a box where a
flag does not parse; 130 interrupted; 141 nobody reads standard output any more; 143 terminated.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Union, get_args

import tyro

from hector_jax.console import exit_code
from hector_jax.flags import Command, Completion, Configured, check, command_name, from_file
from hector_jax.runtime import setup_jax

_ABOUT = (
    "Gradient tuning of a walking biped's model predictive controller. "
    "The whole way, from data to verdict: hector tune --traj straight. "
    "Exit codes: 0 done, 1 something is broken, 2 bad input, 130 interrupted."
)


def main() -> int:
    """Entry of the console script."""
    return exit_code("hector", lambda: _run(sys.argv[1:]))


def _run(words: Sequence[str]) -> None:
    args = _parsed(words)
    if isinstance(args, Completion):
        _parsed(["--tyro-print-completion", args.shell])
    check(args)
    setup_jax()
    from hector_jax import commands  # after the flags: `hector --help` answers at once

    commands.run(args)


def _parsed(words: Sequence[str]) -> Any:
    """The command that the words ask for; leaves by SystemExit after help or a wrong flag.

    Raises:
        InputError: the file of `--config` is wrong.
    """
    file = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    file.add_argument("--config", nargs="?", type=Path)
    path = file.parse_known_args(words)[0].config
    kinds = []
    for kind in get_args(Command):
        name, told = command_name(kind), {}
        if path is not None and words[0] == name and issubclass(kind, Configured):
            told["default"] = from_file(kind, path)
        kinds.append(Annotated[kind, tyro.conf.subcommand(name, **told)])
    commands: Any = Union[tuple(kinds)]  # noqa: UP007
    return tyro.cli(
        commands,
        prog="hector",
        description=_ABOUT,
        args=words,
        config=(tyro.conf.PositionalRequiredArgs,),
    )


if __name__ == "__main__":
    sys.exit(main())
