"""Runs to look at, and iterations that failed once more."""

import shlex
from pathlib import Path

import jax
import numpy as np

from hector_jax.cli import arguments
from hector_jax.cli.flags import Replay, Tensorboard, View
from hector_jax.control.controller import walk_config
from hector_jax.core.console import Broken, say
from hector_jax.core.files import as_json, make_folder
from hector_jax.core.inputs import InputError
from hector_jax.grfm.dataset import at_interval
from hector_jax.grfm.network import as_effect, load_net
from hector_jax.report import fidelity, pictures, plots, view
from hector_jax.report.motion import Motion, motion
from hector_jax.report.report import WORLDS
from hector_jax.report.tensorboard import write_events
from hector_jax.report.video import check_film
from hector_jax.robot.model import Robot, compile_model
from hector_jax.runs import metrics, nets, replay
from hector_jax.runs.folder import read_histories, read_request, weights_of


def view_run(args: View) -> None:
    """Show a run on a page, or leave its film and pictures."""
    beside = args.run / "view"
    folder = args.out or (beside if args.headless else None)
    if folder is None:
        view.check_viser()
    else:
        check_film(folder / "film.mp4")
    begun = read_request(args.run)
    robot = arguments.robot_of(args.run, begun)
    course = arguments.course(begun.trajectory, robot)
    if folder is not None:
        if folder.resolve() == args.run.resolve():
            raise InputError(f"--out must not be the folder of the run, got {folder}")
        make_folder(folder)
    sets = {name: weights_of(args.run, name, robot) for name in args.sets}
    data = arguments.folder_of(args.data or begun.data, begun.robot, robot)
    net = begun.net if args.data is None and begun.net else nets.net_path(data, begun.variant)
    effect = _phi_of(net, begun.variant, robot)
    walks: dict[str, view.ViewedWalk] = {}

    def walk() -> str:
        place = WORLDS.get(args.world, args.world)
        lines = [f"**{begun.trajectory}** in {place}, seed {args.seed}"]
        say(f"walking in {args.world}, seed {args.seed}")
        for when, (name, (weights, words)) in zip(("before", "after"), sets.items(), strict=True):
            trajectory = arguments.walk_once(args, robot, course, weights)
            loss = metrics.score(begun.loss, trajectory).L / 1e6
            lines.append(f"{when}: {words}, L {loss:.3f}e6 in this walk")
            say(f"  {lines[-1]}")
            trajectory = at_interval(trajectory, walk_config(robot).gait.tick)
            stacked = jax.tree.map(lambda x: np.asarray(x)[None], trajectory)
            effects = {} if effect is None else {"residual": effect}
            walks[name] = view.ViewedWalk(trajectory, fidelity.curves(robot, stacked, effects))
        return "\n\n".join(lines)

    def motions() -> tuple[dict[str, Motion], str]:
        lines = walk()
        moving = (motion(robot, *one) for one in walks.values())
        return dict(zip(plots.titles(walks), moving, strict=True)), lines

    if folder is not None:
        walk()
        pictures.of_view(folder, robot, read_histories(args.run), begun.loss, walks)
        say(f"the film and the pictures are in {folder}")
        return
    model = compile_model(robot.description)
    on_open = lambda address: say(f"open {address} in a browser; Ctrl-C ends it")  # noqa: E731
    view.serve(motions, model, args.run, on_open, host=args.host, port=args.port)


def _phi_of(path: Path, variant: str, robot: Robot) -> jax.tree_util.Partial | None:
    """Phi of the net in a file; where there is none, a line says so."""
    if not path.exists():
        say(f"no net at {path}, so its predictions are not shown; --data names another folder")
        return None
    return as_effect(load_net(path, robot, variant)[0])


def replay_dump(args: Replay) -> None:
    """Do a dumped iteration again.

    Raises:
        Broken: it does not come out the same.
    """
    replayed = replay.replay(args.dump)
    print(as_json(replayed._asdict(), indent=2) if args.json else replay.in_words(replayed))
    if not replayed.same:
        raise Broken(f"{args.dump}: {replayed.verdict}")


def tensorboard(args: Tensorboard) -> None:
    """Write the event files of a run."""
    out = args.out or args.run / "tensorboard"
    write_events(args.run, out)
    print(f"tensorboard --logdir {shlex.quote(str(out))}")
