"""The command `hector robot`: what a model holds, what is wrong with it, and its TOML."""

from pathlib import Path

from hector_jax.cli.flags import Robot as RobotFlags
from hector_jax.control.controller import walk_config
from hector_jax.core.console import say
from hector_jax.core.inputs import InputError
from hector_jax.robot.description import description_of
from hector_jax.robot.model import Robot, load_robot, robot_of
from hector_jax.robot.propose import Proposal, as_toml, propose
from hector_jax.robot.table import mended, remarks, table_of, table_of_survey
from hector_jax.tuning.loss import loss_of_robot


def examine_robot(args: RobotFlags) -> None:
    """Check a robot's TOML, or propose one for its model.

    Raises:
        InputError: the robot cannot be used as it is; the one line says what is to be mended.
    """
    if args.file.suffix == ".toml":
        if args.out is not None:
            raise InputError(f"--out is for a proposal, and {args.file} is checked")
        robot = load_robot(args.file)
        _check(robot)
        _print_table(robot, remarks(robot))
        return
    if args.out is not None:
        _check_out(args.out, args.file)
    proposal = propose(args.file)
    text = as_toml(proposal.table, _comments(args.file, proposal))
    path = args.out or args.file.with_suffix(".toml")
    try:
        robot = robot_of(description_of(path, proposal.table))
    except InputError:
        print("\n".join([*table_of_survey(proposal.survey), *_list("wrong", proposal.wrong)]))
        raise
    _check(robot)
    _print_table(robot, [*proposal.wrong, *remarks(robot)])
    if args.out is None:
        print(f"\n{text}", end="")
        return
    try:
        with args.out.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise InputError(f"{args.out}: cannot be written: {error.strerror}") from None
    say(f"the proposal is in {args.out}; walk with it: hector walk --robot {args.out}")


def _check(robot: Robot) -> None:
    """What the controller and the loss read of the TOML."""
    walk_config(robot)
    loss_of_robot(robot.description)


def _check_out(out: Path, file: Path) -> None:
    """Raises InputError where a proposal could not be written or would not find its model."""
    if out.suffix != ".toml":
        raise InputError(f"--out must end in .toml, got {str(out)!r}")
    if out.exists():
        raise InputError(f"--out must be a new file, and {out} exists")
    if out.absolute().parent.resolve() != file.absolute().parent.resolve():
        raise InputError(
            f"--out must be beside the model, in {file.absolute().parent}, got {str(out)!r}"
        )


def _comments(file: Path, proposal: Proposal) -> list[str]:
    head = f"Proposed by `hector robot {file.name}`; rules: docs/howto/robot.md."
    return [head, *(f"To be mended: {line}" for line in proposal.wrong)]


def _print_table(robot: Robot, wrong: list[str]) -> None:
    lines = [*table_of(robot), *_list("mended", mended(robot)), *_list("wrong", wrong)]
    print("\n".join(lines))


def _list(title: str, lines: list[str] | tuple[str, ...]) -> list[str]:
    """Lines under a title."""
    each = list(lines) or ["nothing"]
    return [f"{title if i == 0 else '':8s} {line}" for i, line in enumerate(each)]
