"""The console script `hector`: flags in, exit code out.

Results go to stdout, everything said while waiting to stderr. Exit codes: 0 done; 1 something is
broken: `hector doctor` found it, a worker process was killed, a disk is full, or a fault of this
program with its traceback; 2 bad input: one line says what came, where, and what was expected; 130
interrupted; 141 nobody reads standard output any more; 143 terminated.
"""

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from hector_jax.cli.flags import (
    Command,
    Completion,
    Doctor,
    Export,
    check,
    command,
    command_name,
    from_line,
    resolve_latest,
)
from hector_jax.core.console import Broken, exit_code, say, say_if_slow
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import cache_folder, check_jax, home_cache, setup_jax

_ABOUT = (
    "Gradient tuning of a walking biped's model predictive controller. "
    "The whole way, from data to evaluation: hector tune --traj straight. "
    "Exit codes: 0 done, 1 something is broken, 2 bad input, 130 interrupted."
)


def main() -> int:
    """Entry of the console script."""
    return exit_code("hector", lambda: _run(sys.argv[1:]))


def _run(words: Sequence[str]) -> None:
    args = _parsed(words)
    args = resolve_latest(args)
    check(args)
    if isinstance(args, Completion):
        _tyro(["--tyro-print-completion", args.shell])
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # of its own cache
    try:
        if (cache := cache_folder()) != (usual := home_cache()):
            say(f"{usual} cannot be written: compiled programs are kept in {cache}")
        with say_if_slow("loading JAX and MuJoCo"):
            check_jax(on_cpu=isinstance(args, Export))  # see hector_jax.runs.export
            setup_jax()
            from hector_jax.cli import commands  # after the flags: `hector --help` answers at once
    except InputError as error:
        if not isinstance(args, Doctor):
            raise
        if args.json:
            print(json.dumps({"faults": [str(error)]}))
        raise Broken(str(error)) from None
    commands.run(args)


def _parsed(words: Sequence[str]) -> Any:
    """The command that the words ask for; leaves by SystemExit after help.

    Raises:
        InputError: a word is wrong, or the file of `--config`.
    """
    others = [word for word in words if word not in ("-h", "--help")]
    if len(others) == len(words):
        return from_line(words)
    if others:
        command(others[0])  # there is such a command
    return _tyro([*others[:1], "--help"], from_line(others) if "--config" in others else None)


def _tyro(words: Sequence[str], default: Any = None) -> Any:
    """Print help or a completion script; `default` holds other defaults of its command."""
    kinds = []
    for kind in get_args(Command):
        known = {"default": default} if isinstance(default, kind) else {}
        kinds.append(Annotated[kind, tyro.conf.subcommand(command_name(kind), **known)])
    commands: Any = Union[tuple(kinds)]  # noqa: UP007
    registry = ConstructorRegistry()
    registry.primitive_rule(_optional)
    with registry:
        return tyro.cli(
            commands,
            prog="hector",
            description=_ABOUT,
            args=words,
            config=(tyro.conf.PositionalRequiredArgs,),
        )


def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """How help shows a flag that may be left out: PATH, not Python's `{None}|PATH`."""
    if info.type_origin not in (Union, UnionType) or NoneType not in get_args(info.type):
        return None
    kind = next(kind for kind in get_args(info.type) if kind is not NoneType)
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH" if kind is Path else kind.__name__.upper(),
        instance_from_str=lambda words: kind(words[0]),
        is_instance=lambda value: value is None or isinstance(value, kind),
        str_from_instance=lambda value: ["none" if value is None else str(value)],
    )


if __name__ == "__main__":
    sys.exit(main())
