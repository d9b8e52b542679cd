"""Read the flags of a command from the command line or a file, check them, and write them again.

tyro reads the command line; a TOML file, or the `config.json` of a run, has the same flags by name.
All of this happens before the slow imports, so that a wrong word is reported at once.
"""

import io
import os
import re
import shlex
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import MISSING, fields, make_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from hector_jax.cli.flags import (
    COMMANDS,
    NAMED_WEIGHTS,
    OTHER_MASSES,
    PathKind,
    named_file,
    with_given,
)
from hector_jax.core.console import say
from hector_jax.core.inputs import InputError, check_file, did_you_mean, one_line, short_repr
from hector_jax.core.settings import SEED, convert, from_table, read_json, read_toml, to_table

OVERVIEW = {
    "What you type first": {
        "tune": "tune weights for a trajectory, evaluate them, write a report",
        "view": "show a run in the browser: hector view latest; live: --live",
        "export": "write weights, lines for C++, the controller as C: hector export latest",
        "robot": "make the file of your own robot from its MJCF or URDF",
        "walk": "walk once; errors in cm and degrees, and a film with --video",
        "evaluate": "compare weight sets on simulated robots and engines; or finished runs",
    },
    "Tune on the walks of a robot, or of a simulator elsewhere": {
        "log check": "what of the log of a walk no weights can fix",
        "log twin": "how far the plans of a robot's file are from those of a log",
        "log foretell": "what other weights would bring on the robot of a log",
        "propose": "the weights to walk with next",
        "log add": "take the logs of these walks",
    },
    "Single steps of a tuning": {
        "steps collect": "walk on the simulator and record the ground forces",
        "steps train": "train GRFM-Net, the model of the ground, on these walks",
        "steps grfm": "how well that net predicts walks that it never saw",
    },
    "This machine": {"doctor": "versions, devices, cache and video, with a test"},
}  # each command in a line, in the order of `hector --help`

_HEAD = """hector tunes the weights of a walking robot's model predictive controller.

    hector tune --traj straight     # tune, evaluate, report: minutes, no GPU
    hector view latest              # look at it in the browser
    hector COMMAND --help           # flags of a command, with an example
"""
_EXIT_CODES = "Exit codes: 0 done, 1 something is broken, 2 bad input, 130 interrupted."
_ALL = "--help-all"
_HELP = ("-h", "--help", _ALL)
_COMPLETION = "--tyro-print-completion"
_GROUPS = tuple(dict.fromkeys(name.split()[0] for name in COMMANDS if " " in name))
_LATEST = Path("latest")  # stands for `latest_run`
_NUMBERS: dict[Any, str] = {int: "a whole number", float: "a number"}

Flags = TypeVar("Flags")


# The line


def _command(words: Sequence[str]) -> str:
    """Return the one or two words of the command with which a line begins, or raise InputError."""
    word, two = words[0], " ".join(words[:2])
    if word in COMMANDS or two in COMMANDS:
        return word if word in COMMANDS else two
    moved = {
        "report": "log add",
        "verdict": "evaluate --out runs/verdict",
        "compare": "evaluate --runs",
    }
    moved |= {name.split()[-1]: name for name in COMMANDS if " " in name}
    hint = f"; it is `hector {moved[word]}` now" if word in moved else did_you_mean(two, COMMANDS)
    hint = hint or did_you_mean(word, COMMANDS) or f"; the commands are {', '.join(COMMANDS)}"
    raise InputError(f"unknown command {short_repr(two if word in _GROUPS else word)}{hint}")


def from_line(words: Sequence[str]) -> Any:
    """Read a command and its flags from the words after `hector`.

    Flags that are not on the line come from the file of `--config`, else from their defaults. Help
    is printed, also without a word, and exits by SystemExit.

    Raises:
        InputError: one line with the word that is unknown, repeated, missing, unexpected or of the
            wrong type.
    """
    helps = [word for word in words if word in _HELP]
    rest = [word for word in words if word not in _HELP]
    if rest[:1] == [_COMPLETION]:
        return _all_commands(words)
    if not rest or (len(rest) == 1 and rest[0] in _GROUPS):
        print(overview("".join(rest)))
        raise SystemExit(0)
    name = _command(rest)
    return read_flags(COMMANDS[name], [*rest[name.count(" ") + 1 :], *helps], f"hector {name}")


def read_flags(kind: type[Flags], words: Sequence[str], program: str) -> Flags:
    """Read the flags of a program from the words after its name; see `from_line`."""
    helps = [word for word in words if word in _HELP]
    default: Any = tyro.MISSING_NONPROP
    words = [word for word in words if word not in _HELP]
    names = [word[2:].partition("=")[0].replace("_", "-") for word in words if word[:2] == "--"]
    given = [name.removeprefix("no-") for name in names]
    if twice := [name for name in given if given.count(name) > 1]:
        raise InputError(f"--{twice[0]} is given twice")
    if "config" in given:
        flags_of_line: Any = _quietly(kind, words, program, default)
        default = from_file(kind, flags_of_line.config)
        given += getattr(default, "given", ())
    if helps:
        return _print_help(kind, _ALL in helps, program, default)
    return with_given(_quietly(kind, words, program, default), (x.replace("-", "_") for x in given))


def _print_help(kind: Any, whole: bool, prog: str, default: Any) -> Any:
    """Print the help of a command, of its usual flags or of all; exits by SystemExit."""
    if whole or not kind.usual:
        return _tyro(kind, ["--help"], prog=prog, default=default)
    text, shown = io.StringIO(), True
    with redirect_stdout(text), suppress(SystemExit):
        _tyro(kind, ["--help"], prog=prog, default=default)
    for line in text.getvalue().splitlines():
        if flag := re.match(r"  --(\w[\w-]*)", line):  # what follows belongs to it
            shown = flag[1].replace("-", "_") in kind.usual
        if shown and line.strip():
            print(line.rstrip())
    print(f"{len(fields(kind)) - len(kind.usual)} more flags: {prog} {_ALL}")
    raise SystemExit(0)


def overview(group: str = "") -> str:
    """Return the text of `hector --help`, or of the commands of a group, such as `log`."""
    lines = [] if group else [_HEAD]
    for heading, commands in OVERVIEW.items():
        rows = [f"  {name:<14s}{text}" for name, text in commands.items() if name.startswith(group)]
        lines += [f"{heading}:", *rows, ""] if rows else []
    return "\n".join([*lines, _EXIT_CODES])


def _all_commands(words: Sequence[str]) -> Any:
    """Run tyro's own flags on all commands; exits by SystemExit."""

    def union(prefix: str) -> Any:
        kinds = [
            Annotated[kind, tyro.conf.subcommand(name.removeprefix(prefix))]
            for name, kind in COMMANDS.items()
            if name.startswith(prefix) and " " not in name.removeprefix(prefix)
        ]
        for group in () if prefix else _GROUPS:
            of_group = make_dataclass(group, [("command", union(f"{group} "))])
            kinds.append(Annotated[of_group, tyro.conf.subcommand(group)])
        return Union[tuple(kinds)]  # noqa: UP007

    return _tyro(union(""), words, prog="hector")


def _quietly(kind: type, words: Sequence[str], prog: str, default: Any) -> Any:
    """Parse; raise an InputError of one line where tyro would print a box."""
    text = io.StringIO()
    try:
        with redirect_stdout(text), redirect_stderr(text):
            flags, rest = _tyro(kind, words, prog=prog, default=default, return_unknown_args=True)
    except SystemExit:
        title, *body = re.split(r"\n\s*-{5,}\s*\n", text.getvalue())
        raise InputError(one_line(body[0] if body else title)) from None
    if not rest:
        return flags
    name = prog.removeprefix("hector ")
    help_line = f"; see {prog} {_ALL if kind.usual else '--help'}"
    if not rest[0].startswith("--"):
        raise InputError(f"{name} does not expect {short_repr(rest[0])}{help_line}")
    flag = rest[0].partition("=")[0]
    names = [label[2:] for field in fields(kind) if (label := _label(field))[:2] == "--"]
    hint = did_you_mean(flag[2:], names).replace(" '", " '--")
    raise InputError(f"{name} has no flag {short_repr(flag)}{hint or help_line}")


def _tyro(kind: Any, words: Sequence[str], **options: Any) -> Any:
    registry = ConstructorRegistry()
    registry.primitive_rule(_scalar)
    positional = (tyro.conf.PositionalRequiredArgs,)
    return tyro.cli(kind, args=words, config=positional, registry=registry, **options)


def _scalar(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Parse a number or an optional flag; help shows PATH, not Python's `{None}|PATH`."""
    optional = info.type_origin in (Union, UnionType) and NoneType in get_args(info.type)
    kind = next(x for x in get_args(info.type) if x is not NoneType) if optional else info.type
    if not optional and kind not in _NUMBERS:
        return None

    def read(words: Sequence[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            raise ValueError(f"expected {_NUMBERS[kind]}, got {words[0]!r}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH" if kind is Path else kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, kind),
        str_from_instance=lambda value: ["none" if value is None else str(value)],
    )


# The file


def from_file(kind: type[Flags], path: Path) -> Flags:
    """Read flags of a command from a file; the others keep their defaults.

    Args:
        kind: the command, a dataclass of `flags`.
        path: TOML whose keys are flags (`first-seed` or `first_seed`), or the `config.json` of a
            run, whose `flags` are read. Paths inside are relative to the working directory, as on
            the command line.

    Raises:
        InputError: one line naming file and key, if a key is unknown (with the nearest valid name),
            of a wrong type or out of range; or naming the file, if it cannot be read.
    """
    if path.suffix == ".json":
        content = read_json(path, "flags as JSON")
        flags = content.get("flags") if isinstance(content, dict) else None
        if not isinstance(flags, dict):
            raise InputError(f"{path}: no `flags` in it; expected the config.json of a run")
    else:
        flags = read_toml(path, "flags as TOML")
    values: dict[str, Any] = {}
    for key, value in flags.items():
        name = key.replace("-", "_")
        if name in values:
            raise InputError(f"{path}: {key} is given twice")
        if name == "config":
            raise InputError(f"{path}: config stands on the line only")
        values[name] = value
    for field in fields(kind):  # pyright: ignore[reportArgumentType]
        if isinstance(word := values.get(field.name), str) and get_args(field.type)[1:] == (...,):
            values[field.name] = [word]  # for a list of one
    # a run records all its flags, also those that nobody gave
    return with_given(from_table(str(path), kind, values), () if path.suffix == ".json" else values)


_OF_THE_CALL = ("cluster", "config")  # of no result; the flags of a file are written out


def as_table(flags: Any) -> dict[str, Any]:
    """Return the flags as JSON values, including those from a file; `from_file` reads them."""
    names = [field.name for field in fields(flags) if field.name not in _OF_THE_CALL]
    return {name: to_table(getattr(flags, name)) for name in names}


def as_command(program: str, flags: Any) -> str:
    """Return the command line of a program with these flags, without those at their default."""
    words = program.split()
    for field in fields(flags):
        value, flag = getattr(flags, field.name), field.name.replace("_", "-")
        if value in (field.default, ()) or field.name in _OF_THE_CALL:
            continue
        if isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{flag}")
        else:
            words += [f"--{flag}", *map(str, value if isinstance(value, tuple) else (value,))]
    return shlex.join(words)


# The checks


def check_flags(flags: Any) -> None:
    """Check the types and ranges of flags, and that the files that they name exist.

    Raises:
        InputError: one line with the flag, the expected value and the actual value.
    """
    for field in fields(flags):
        value, label = getattr(flags, field.name), _label(field)
        convert(value, field.type, name=label)
        other = field.metadata.get("or", "")  # a flag that stands in place of this one
        if getattr(flags, other, False):
            if value:
                raise InputError(f"--{other} takes no {label}, got {short_repr(value[0])}")
        elif value == () != field.default:
            hint = f"; or --{other}" if other else ""
            raise InputError(f"{label} expects a value, got none{hint}")
        items = value if isinstance(value, tuple) else (value,)
        for i, item in enumerate(items):
            if item in items[:i]:
                raise InputError(f"{label} names {short_repr(str(item))} twice")
            if item is not None and (source := _source(field.type)):
                _check_source(label, item, source)
    if hasattr(flags, "first_seed") and flags.first_seed + flags.seeds - 1 not in SEED:
        raise InputError(
            f"--first-seed {flags.first_seed} and --seeds {flags.seeds} reach beyond the largest "
            f"seed, {SEED.high}"
        )


def _label(field: Any) -> str:
    """Return the flag's name in messages; a positional argument is in capitals."""
    name = field.name.replace("_", "-")
    return name.upper() if field.default is MISSING else f"--{name}"


def _source(kind: Any) -> PathKind | None:
    if get_origin(kind) is tuple:
        kind = get_args(kind)[0]
    return next((note for note in get_args(kind) if isinstance(note, PathKind)), None)


def _check_source(label: str, value: Path | str, source: PathKind) -> None:
    """Check that a flag names a file or folder of its source that exists; else InputError."""
    is_named = source in (PathKind.SETS, PathKind.LOG)
    text = named_file(str(value))[1] if is_named else str(value)
    path, named, is_dir = Path(text), text in NAMED_WEIGHTS, os.path.isdir(text)
    existing = next(x for x in (path, *path.parents) if os.path.exists(x))
    given = named or path.suffix or os.path.lexists(path)
    valid, is_file = {
        PathKind.FILE: (True, True),
        **dict.fromkeys((PathKind.LOG, PathKind.BAG), (True, not is_dir)),
        PathKind.RUN: (is_dir, False),
        PathKind.FOLDER: (os.path.isdir(existing), False),
        PathKind.EXPORTABLE: (given, not named and not is_dir),
        PathKind.WEIGHTS: (given, not named),
        PathKind.SETS: (named or is_dir or path.suffix, not named and not is_dir),
        PathKind.TRAJECTORY: (True, path.suffix == ".toml"),
        PathKind.MODEL: (text in OTHER_MASSES or path.suffix == ".toml", text not in OTHER_MASSES),
        PathKind.ROBOT: (path.suffix == ".toml", True),
    }[source]
    if not valid:
        of_sets = source in (PathKind.WEIGHTS, PathKind.SETS, PathKind.EXPORTABLE)
        renamed = {"best": "; that is `shipped` now, or weights/best.json of a run"}
        hint = renamed.get(text, did_you_mean(text, NAMED_WEIGHTS)) if of_sets else ""
        raise InputError(f"{label} must be {source.value}, got {one_line(str(value))!r}{hint}")
    if is_file:
        check_file(path, "the file")


def latest_run(resumed: bool = False) -> Path | None:
    """Return the tuning under `runs/` that began last, by its own record; None without one.

    A run that was refused before its settings were complete counts only if it is to be `resumed`.
    Of a run and its copies it is the one with the shortest name.
    """
    runs: list[tuple[str, int, Path]] = []
    for folder in (file.parent for file in Path("runs").rglob("versions.json")):
        with suppress(InputError):  # no run
            config = read_json(folder / "config.json", "the settings of a run")
            if not isinstance(config, dict):
                continue
            if resumed or "tune" in config or (folder / "walks").is_dir():
                # older versions recorded it in the name alone
                named = folder.name if re.fullmatch(r"\d{8}-\d{6}", folder.name) else ""
                began = str(config.get("began", named))
                runs.append((began, -len(str(folder)), folder))
    return max(runs)[2] if runs else None


def resolve_latest(flags: Flags) -> Flags:
    """Replace `latest` in the flags of run folders by `latest_run`, which is said.

    Raises:
        InputError: there is no run.
    """

    def newest(path: Path, resumed: bool) -> Path:
        if path != _LATEST or path.exists():
            return path
        if (run := latest_run(resumed)) is None:
            raise InputError("latest: there is no run in the folder `runs` of this directory")
        say(f"latest is {run}")
        return run

    values: dict[str, Any] = {}
    for field in fields(flags):  # pyright: ignore[reportArgumentType]
        value, resumed = getattr(flags, field.name), field.name == "resume"
        if value is not None and _source(field.type) in (PathKind.RUN, PathKind.EXPORTABLE):
            is_tuple = isinstance(value, tuple)
            found = [newest(path, resumed) for path in (value if is_tuple else (value,))]
            values[field.name] = tuple(found) if is_tuple else found[0]
    latest = replace(flags, **values)  # pyright: ignore[reportArgumentType]
    return with_given(latest, getattr(flags, "given", ()))
