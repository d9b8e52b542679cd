"""`hector view`: show a run or a live walk on a web page, or a run as a film and pictures."""

import math
from pathlib import Path

from hector_jax.cli import arguments
from hector_jax.cli.flags import View
from hector_jax.cli.live import run_live
from hector_jax.control.controller import walk_config
from hector_jax.core.console import say
from hector_jax.core.files import make_folder
from hector_jax.core.inputs import InputError, require_package
from hector_jax.core.tree_file import tree_hash
from hector_jax.grfm.dataset import at_interval
from hector_jax.grfm.network import as_effect, load_net
from hector_jax.report import fidelity
from hector_jax.report.plots.style import titled
from hector_jax.report.report import WORLDS
from hector_jax.robot.model import compile_model
from hector_jax.store import nets
from hector_jax.store.run import Run
from hector_jax.verdict import metrics
from hector_jax.view import page, pictures
from hector_jax.view.motion import Motion, motion
from hector_jax.view.video import check_film


def _run_of(args: View) -> Path:
    for name in ("robot", "weights", "at"):
        if args.is_given(name):
            raise InputError(f"--{name} is of a live walk: --live")
    if len(args.run) != 1:
        raise InputError(f"view shows one run, got {len(args.run)}")
    return args.run[0]


def run_view(args: View) -> None:
    """Show a run or a live walk on a page, or write a run's film and pictures."""
    if args.live:
        run_live(args)
        return
    path, folder = _run_of(args), args.out
    if folder is None:
        require_package("viser", "view", "the page", " (--out writes a film without it)")
    else:
        check_film(folder / "film.mp4")
    run = Run(path)
    request, robot = run.request, run.robot
    command = arguments.load_trajectory(request.trajectory, robot)
    if folder is not None:
        if folder.resolve() == path.resolve():
            raise InputError(f"--out must not be the folder of the run, got {folder}")
        make_folder(folder)
    before, after = args.sets
    if not args.is_given("sets") and not (path / "weights" / f"{after}.json").exists():
        after = "with"  # `best` is chosen at the end of a run
    sets = {name: run.weights(name, robot) for name in (before, after)}
    data = arguments.data_folder(request.data, request.robot, robot)
    net = request.net or nets.net_path(data, request.variant)
    effects = {}
    params = load_net(net, robot, request.variant)[0] if net.exists() else None
    if params is not None and tree_hash(params) == request.params:
        effects["residual"] = as_effect(params)
    else:
        what = f"no net at {net}" if params is None else f"{net} is not the net of this run"
        say(f"{what}, so its predictions are not shown")

    def walk() -> tuple[dict[str, page.ViewedWalk], str]:
        """Walk with both sets; return the walks and their description in Markdown."""
        world, walks = WORLDS.get(args.world, args.world), {}
        lines = [f"**{request.trajectory}** in {world}, seed {args.seed}"]
        say(f"walking in {args.world}, seed {args.seed}")
        for when, (name, (weights, words)) in zip(("before", "after"), sets.items(), strict=True):
            trajectory = arguments.walk_once(args, robot, command, weights)
            score = metrics.score(request.loss, trajectory)
            plane, loss = 100 * math.hypot(*score.rms_position[:2]), score.L / 1e6
            lines.append(f"{when}: {words}, {plane:.1f} cm off (RMS), L {loss:.3f}e6")
            say(f"  {lines[-1]}")
            trajectory = at_interval(trajectory, walk_config(robot).gait.tick)
            walks[name] = page.ViewedWalk(trajectory, fidelity.curves(robot, trajectory, effects))
        return walks, "\n\n".join(lines)

    def motions() -> tuple[dict[str, Motion], str]:
        walks, description = walk()
        shown = {name: motion(robot, v.walk, v.ground) for name, v in walks.items()}
        return titled(shown), description

    if folder is not None:
        histories = run.histories
        histories.pop("best", None)  # its loss has another term
        pictures.of_view(folder, robot, histories, request.loss, walk()[0])
        say(f"the film and the pictures are in {folder}")
        return
    on_open = lambda address: say(f"open {address} in a browser; Ctrl-C ends it")  # noqa: E731
    address = {"host": args.host, "port": args.port}
    page.serve(motions, compile_model(robot.description), path, on_open, **address)
