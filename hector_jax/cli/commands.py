"""The function of each command of `hector`; its flags are in flags.py."""

from collections.abc import Mapping
from contextlib import nullcontext
from functools import partial, singledispatch
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hector_jax.cli import (
    arguments,
    doctor,
    evaluate,
    flags,
    foretell,
    propose,
    tune,
    view,
    walk,
    walker,
)
from hector_jax.cli.arguments import print_result
from hector_jax.control.controller import walk_config
from hector_jax.control.tagged_file import keys_file, read_own, with_weights
from hector_jax.control.twin import TwinConfig
from hector_jax.control.weights import nominal
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.console import say
from hector_jax.core.files import locked, write_file
from hector_jax.core.inputs import InputError
from hector_jax.core.pool import workers
from hector_jax.core.settings import as_toml
from hector_jax.export import export
from hector_jax.export.template import fill_template
from hector_jax.grfm.training import TrainConfig
from hector_jax.importing.propose import TOML, RobotProposal, files_of, propose_robot
from hector_jax.importing.remarks import differences, remarks
from hector_jax.importing.table import section, table_of
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim import margin
from hector_jax.store import nets
from hector_jax.store.run import Run
from hector_jax.tuning.loss import loss_of_robot


@singledispatch
def run(args: Any) -> None:
    """Run a command with its flags.

    Raises:
        InputError: one line that says what is wrong with the input.
    """
    raise NotImplementedError(type(args))


for _command in (
    doctor.run_doctor,
    evaluate.run_evaluate,
    foretell.run_foretell,
    walk.run_walk,
    walk.run_grfm,
    walker.run_check,
    walker.run_twin,
    propose.run_propose,
    propose.run_add,
    tune.run_tune,
    view.run_view,
):
    run.register(_command)


@run.register
def run_collect(args: flags.Collect) -> None:
    """Walk on the simulator with random plants and commands, and save the walks."""
    config = nets.CollectConfig(args.walks, args.seconds, args.seed, args.engine)
    robot = load_robot(args.robot)
    out = arguments.flag_folder(args, "out", robot)
    if not args.is_given("out"):
        out = nets.own_folder(out, config)
    with workers(args.processes, args.cluster) as pool:
        nets.collect_walks(pool, config, robot, out)
    say(f"the walks are in {out}")


@run.register
def run_train(args: flags.Train) -> None:
    """Train a net on walks."""
    config = TrainConfig(args.variant, epochs=args.epochs)
    robot = load_robot(args.robot)
    data = arguments.flag_folder(args, "data", robot)
    path = args.out or nets.own_path(data, config)
    with nullcontext() if args.out else locked(path.parent):
        errors = nets.train_net(config, robot, data, path).errors
    result = {"net": str(path), "errors": errors}
    print_result(args.json, result, partial(arguments.print_errors, errors))
    say(f"the net is in {path}")


@run.register
def run_robot(args: flags.Robot) -> None:
    """Check a robot's TOML, or propose one for its model.

    Raises:
        InputError: one line says what must be corrected in the proposal.
    """
    file, out = args.file, args.out
    if out is not None and (out.exists() or out.suffix in (".toml", ".xml")):
        raise InputError(
            f"--out must be a new folder, which gets robot.toml and robot.xml, got {out}"
        )
    with TemporaryDirectory() as folder:
        proposal = propose_robot(file, Path(folder), args.weld)
        lines, told, wrong = _looked_at(proposal)
    if proposal.refused and out is None and not wrong:
        convert = f"convert it: hector robot {file} --out FOLDER"
        told.append(f"other commands refuse it: {proposal.refused}; {convert}")
    if file.suffix == ".toml" and proposal.filled:
        lines += section("left out", [f"{', '.join(proposal.filled)}: HECTOR's, by the rules"])
    print("\n".join([*lines, *section("wrong", [*told, *wrong])]))
    head = f"Proposed by `hector robot {file.name}`; rules: docs/robot-toml.md."
    comments = [head, *(f"To be fixed: {line}" for line in [*told, *wrong] if wrong)]
    comments += [f"A guess: {line}" for line in proposal.guesses if not wrong]
    if out is not None:
        for name, content in files_of(proposal, file, comments).items():
            write_file(out / name, content)
        next_step = f"walk with it: hector walk --robot {out / TOML}"
        if wrong:
            next_step = f"fix it, then: hector robot {out / TOML} --out FOLDER"
        say(f"the proposal is in {out}; {next_step}")
    elif proposal.filled:
        table = proposal.draft if proposal.wrong else proposal.table
        print(f"\n{as_toml(table, comments)}", end="")
    if wrong:
        raise InputError(wrong[-1])


def _looked_at(proposal: RobotProposal) -> tuple[list[str], list[str], list[str]]:
    """Return the lines about a robot: its table, remarks on it, and what is wrong with it."""
    robot, standard, wrong = proposal.robot, proposal.standard, list(proposal.wrong)
    if robot is None:
        return [], list(proposal.guesses), wrong
    lines = table_of(robot, proposal.table["joints"].get("weld", ()))
    told = remarks(robot, standard)
    if proposal.error is None:
        try:
            loss_of_robot(robot.description)
            config = walk_config(robot)
            if config.twin == TwinConfig():  # else its legs are another program's
                lines += section("delay", margin.delay_lines(robot, config, nominal(robot)))
        except InputError as error:  # a setting that controller or loss refuse
            wrong.append(str(error))
    elif unlike := differences(robot)[:1]:  # why a robot of unlike legs does not stand
        wrong.append("; ".join([*unlike, wrong.pop()]))
        told = [line for line in told if line not in unlike]
    measured = [f"soles measured on {', '.join(x.files)}" for x in proposal.soles[:1] if x.files]
    lines += section("changed", [*measured, *(standard.notes if standard else ())])
    return lines, [*proposal.guesses, *told], wrong


@run.register
def run_export(args: flags.Export) -> None:
    """Export the controller of a run, checked against the live one; or numbers of a file."""
    run = Run(args.run) if args.run.is_dir() else None
    if args.is_given("set") and run is None:
        raise InputError(f"--set is of a run, and {args.run} is weights")
    path = run.weights_file(args.set) if run else args.run
    folder = args.out or (args.run if run else args.run.parent) / "export"
    if args.template and args.into:
        raise InputError("--template and --into: only one can be given")
    if args.template or args.into:
        out = _fill_in(args, folder, path, load_robot(args.robot or (run and run.robot_file)))
        print_result(args.json, {"file": str(out)}, lambda: None)
        say(f"{out} has the weights {path}")
        return
    if run and args.robot:
        raise InputError(f"--robot is for weights files; the run {args.run} names its own robot")
    robot = run.robot if run else load_robot(args.robot)
    text = run.request.trajectory if run else "straight"
    trajectory = arguments.load_trajectory(text, robot)
    name = f"{args.run.resolve().name}/{path.stem}" if run else path.stem
    weights = arguments.weights_by_name(str(path), robot)
    if robot.description.numbers:
        text = "[numbers] are of a controller of your own, which is not exported"
        raise InputError(
            f"{robot.description.path}: {text}, but they are to a file of yours: --into"
        )
    say("exporting the controller and comparing it with the live one on a walk")
    card = export.export(
        run.controller if run else walk_config(robot),
        robot,
        weights,
        trajectory.command,
        folder,
        name=name,
        seconds=args.seconds,
        prefix=args.prefix,
    )
    print_result(args.json, card, lambda: _print_check(card["check"] or {}))
    say(f"the export is in {folder}")


def _fill_in(args: flags.Export, folder: Path, weights_file: Path, robot: Robot) -> Path:
    """Write a copy of a file of another program with the weights in it; return its path."""
    weights = arguments.weights_by_name(str(weights_file), robot)
    source = args.template or args.into
    assert source is not None
    out = folder / (source.name.removesuffix(".j2") if args.template else source.name)
    if out.resolve() == source.resolve():
        flag = "--template" if args.template else "--into"
        raise InputError(f"{flag} {out} would be overwritten; write to another folder by --out")
    if args.template:
        write_file(out, fill_template(source, weights).encode())
        return out
    numbers = [f"others.{number}" for number, _ in robot.description.numbers]
    text, lacking = with_weights(source, read_own(source), weights_tree(weights), numbers)
    if lacking:
        say(f"{source} has no {', '.join(lacking)}: write these where your legs read them")
    write_file(out, text.encode(errors="surrogateescape"))
    if keys := keys_file(source):  # with which the copy is read
        write_file(folder / keys.name, keys.read_bytes())
    return out


def _print_check(check: Mapping[str, Any]) -> None:
    if not check:
        return
    differences = "{force:.1e} N, {moment:.1e} N m, {torque:.1e} N m at the joints"
    print(f"largest difference from the live controller: {differences.format(**check)}")
    times = "p50 {p50:.3f}, p99 {p99:.3f}, p99.9 {p999:.3f}, max {max:.3f}"
    for key, text in (("plan_ms", "with a plan"), ("hold_ms", "between plans")):
        print(f"CPU time of a call {text} [ms]: {times.format(**check[key])}")
