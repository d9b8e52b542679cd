"""A tuned controller for other machines."""

from hector_jax.cli import arguments
from hector_jax.cli.flags import Export
from hector_jax.control.controller import walk_config
from hector_jax.control.weights_file import load_weights
from hector_jax.core.console import say
from hector_jax.core.files import as_json, locked
from hector_jax.core.inputs import InputError
from hector_jax.robot.model import load_robot
from hector_jax.runs import export
from hector_jax.runs.folder import read_request


def export_controller(args: Export) -> None:
    """Export the controller of a run, checked against the live one."""
    is_run = args.run.is_dir()
    if is_run and args.robot:
        raise InputError(f"--robot is for weights files; the run {args.run} names its own robot")
    path, config = export.find_weights(args.run, args.set)
    begun = read_request(args.run) if is_run else None
    robot = arguments.robot_of(args.run, begun) if begun else load_robot(args.robot)
    course = arguments.course(args.traj or (begun.trajectory if begun else "straight"), robot)
    weights = load_weights(path, robot)
    name = f"{args.run.resolve().name}/{path.stem}" if is_run else path.stem
    folder = args.out or (args.run if is_run else args.run.parent) / "export"
    say("exporting the controller and comparing it with the live one on a walk")
    controller = config or walk_config(robot)
    with locked(folder):
        card = export.export(
            controller, robot, weights, course.command, folder, name=name, seconds=args.seconds
        )
    if args.json:
        print(as_json(card))
        return
    check = card["check"]
    differences = "{force:.1e} N, {moment:.1e} N m, {torque:.1e} N m at the joints"
    print(f"largest difference from the live controller: {differences.format(**check)}")
    for what, text in (("plan_ms", "with a plan"), ("hold_ms", "between plans")):
        times = "p50 {p50:.2f}, p99 {p99:.2f}, max {max:.2f}; CPU {cpu_p50:.2f}, {cpu_p99:.2f}"
        print(f"a call {text} [ms]: {times.format(**check[what])}")
    say(f"the export is in {folder}")
