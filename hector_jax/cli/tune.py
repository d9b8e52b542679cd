"""`hector tune`: tune weights with and without the net, evaluate them, and write a run folder."""

import time
from collections.abc import Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.cli import arguments, run_folder
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import OF_ROBOT, Tune, Walk
from hector_jax.cli.parse import as_command, latest_run
from hector_jax.cli.walker import tune_walker
from hector_jax.control.parameters import step_names, tunables
from hector_jax.control.reference import Command
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import save_weights, weights_tree
from hector_jax.core.console import say
from hector_jax.core.environment import environment
from hector_jax.core.files import locked, write_json
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.pool import workers
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree_file import tree_hash
from hector_jax.grfm.network import as_effect
from hector_jax.report import fidelity
from hector_jax.report.report import Picture, elsewhere_line, first_lines, print_tables
from hector_jax.report.run import write_run_report
from hector_jax.robot.model import describe, load_robot
from hector_jax.sim.diagnosis import fall_of
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import on_host
from hector_jax.sim.world import hfs
from hector_jax.store import nets, tunings
from hector_jax.store.run import METRICS, RESULT, VERSIONS
from hector_jax.store.setup import Setup
from hector_jax.tuning.curvature import Determined, determined
from hector_jax.tuning.difftune import TuneConfig, Tuning
from hector_jax.tuning.evaluate import aligned
from hector_jax.verdict import judging, metrics
from hector_jax.verdict.foretell import Carried, carry
from hector_jax.verdict.judging import Judged
from hector_jax.view import pictures
from hector_jax.view.video import check_film
from hector_jax.walk_tuning import best_set
from hector_jax.walk_tuning.campaign import Campaign
from hector_jax.walk_tuning.starts import with_best_start
from hector_jax.walk_tuning.walks import WalkTuning, first_slope, tune_on_walks

_ARTEFACTS = "kept"  # folder in it


def run_tune(args: Tune) -> None:
    """Tune one weight set for all trajectories, in a new or resumed run."""
    if args.out and args.resume:
        raise InputError(f"--out {args.out} and --resume {args.resume}: only one can be given")
    if args.video and not args.walker:
        check_film(Path("film.mp4"))
    if args.resume:
        folder, flags = args.resume, run_folder.resume(args.resume, args)
    else:
        new, flags = run_folder.plan_run(args)
        folder = run_folder.begin(new, flags)
    with locked(folder):
        say(f"the run folder is {folder}")
        (tune_walker if flags.walker else _tune_in)(folder, flags)


class _Run(NamedTuple):
    """Inputs of the steps of a run."""

    setup: Setup
    folder: Path
    args: Tune
    start: Weights
    trajectories: tuple[NamedCommand, ...]

    @property
    def settings_of_best(self) -> tuple[TuneConfig, Weights]:
        """Settings and start of the tuning of `best`."""
        _, config, robot = self.setup
        smooth, safe = self.args.smooth, self.args.safe
        return best_set.settings_of_best(config, robot, self.start, smooth=smooth, safe=safe)

    @property
    def seconds(self) -> float:
        """Length of each walk [s]."""
        return self.trajectories[0].seconds or Walk.seconds

    @property
    def name(self) -> str:
        """Names of the trajectories."""
        return ", ".join(trajectory.name for trajectory in self.trajectories)

    @property
    def commands(self) -> dict[str, Command]:
        """Commands by the names of the trajectories."""
        return {trajectory.name: trajectory.command for trajectory in self.trajectories}

    def problems(self, net: nets.TrainedNet) -> dict[str, tunings.Problem]:
        """Tuning problems of all trajectories, without and with the net."""
        commands = tuple(self.commands.values())
        params = {"without": None, "with": net.params}
        return {name: tunings.Problem(commands, net) for name, net in params.items()}


class _Tuned(NamedTuple):
    """Results of the tunings of a run."""

    net: nets.TrainedNet
    tunings: dict[str, Tuning]
    sets: dict[str, Weights]
    walks: WalkTuning | None  # whose result is `best`; None with --walks 0
    begun_with: str  # name of the set that these walks began with


def _begin(pool: Executor, folder: Path, args: Tune) -> _Run:
    """Read what the flags name, but the net."""
    robot = load_robot(args.robot)
    trajectories = run_folder.trajectories(args, robot)
    config = tunings.tune_config(robot, iterations=args.iterations, others=tunables(args.tune))
    config = arguments.with_length(config, trajectories[0].seconds)
    start = arguments.weights_by_name(args.start, robot)
    return _Run(Setup(pool, config, robot), folder, args, start, trajectories)


def _with_aligned_loss(run: _Run, norms: Mapping[str, float]) -> _Run:
    """Return a run whose terms of the loss have gradients of the same order."""
    config = run.setup.config
    loss = aligned(config.loss, norms)
    say("loss weights: " + ", ".join(f"{term.name} {term.weight:g}" for term in loss))
    return run._replace(setup=run.setup._replace(config=replace(config, loss=loss)))


def _tune_in(folder: Path, args: Tune) -> None:
    """Execute a run, reusing the results already in its folder."""
    start_time, made_with = time.monotonic(), environment()
    with workers(args.processes, args.cluster) as pool:
        run = _begin(pool, folder, args)
        robot, first = run.setup.robot, run.trajectories[0]
        given = nets.load_trained(args.net, robot, args.variant)[0] if args.net else None
        for line in tunings.compile_programs(
            run.setup,
            run.start,
            first,
            others=[(*run.settings_of_best, tunings.Problem((first.command,), None, 1))],
            meanwhile=partial(_first_walks, run),
        ):
            say(f"before any tuning, {first.name} on hfs: {line}")
        data = arguments.data_folder(args.data, args.robot, robot)
        net = given or nets.load_or_train(pool, robot, data, args.variant)
        norms = tunings.mean_norms(run.setup, run.problems(net))
        if args.alpha == "auto":
            run = _with_aligned_loss(run, norms["with"])
        settings = _note_settings(run, net)
        tuned = _tune_sets(run, net)
        standin, on_hfs = _walk_sets(run, tuned.sets)
    config, precision = run.setup.config, tuned.tunings["with"].precision
    known = determined(precision, config.ridge, step_names(run.start, config.others))
    worlds = {"standin": standin.verdict, "hfs": on_hfs.verdict}
    carried = _carried(run, standin.verdict)
    result = _result(run, tuned, worlds, known, carried)
    write_json(folder / VERSIONS, made_with | {"seconds": f"{time.monotonic() - start_time:.0f}"})
    report = write_run_report(
        folder,
        run=str(folder),
        trajectory=run.name,
        elsewhere=elsewhere_line(carried) if carried else "",
        verdict=standin.verdict,
        norms=norms,
        determined=known,
        errors=net.errors,
        tunings=tuned.tunings,
        walks=tuned.walks,
        begun_with=tuned.begun_with,
        smooth=args.smooth,
        draws=best_set.DRAWS,
        **_draw(run, tuned, standin, on_hfs),
        config=settings,
        environment=made_with,
        command=as_command("hector tune", run_folder.run_flags(args)),
    )
    _print(run, result, standin.verdict, carried)
    say(f"the report is {report}")


def _carried(run: _Run, verdict: metrics.Verdict) -> Carried | None:
    """Return what `best` may bring on another robot; None if that was not measured: not HECTOR."""
    return carry(verdict, "best") if run.setup.robot.description == describe() else None


def _print(
    run: _Run, result: Mapping[str, Any], verdict: metrics.Verdict, carried: Carried | None
) -> None:
    """Print the result of a run."""
    newest = latest_run()
    text = "latest" if newest and newest.samefile(run.folder) else str(run.folder)

    def print_text() -> None:
        print(*first_lines(verdict, text), "", sep="\n")
        line = elsewhere_line(carried) if carried else ""
        print_tables(verdict, more=[line] if line else [])

    print_result(run.args.json, {"run": str(run.folder), "traj": run.name, **result}, print_text)


def _first_walks(run: _Run) -> None:
    """Check the start, and begin to compile the programs of the tuning on walks."""
    _check_start(run)
    campaign, budget = _campaign(run)
    if budget:
        run.setup.pool.submit(first_slope, campaign)


def _check_start(run: _Run) -> None:
    """Walk with the weights at the start on the hfs; `_walk_sets` reads these walks again.

    A fall is told. The rigid body may walk nevertheless, and a tuned set then walks longer.

    Raises:
        InputError: the robot falls in the first half of every walk; the line has the likeliest
            cause and what to change.
    """
    setup, robot, text = run.setup, run.setup.robot, run.args.start
    folder, at = run.folder / _ARTEFACTS, text if text in OF_ROBOT else "start"
    options: dict[str, Any] = {"folder": folder, "about": {"world": "hfs"}}
    falls, longest = [], 0.0
    for name, command in run.commands.items():
        case = name, at, 0
        job = Job(run.start, command, hfs(robot.description), run.seconds)
        title = f"walking {name} with the weights to start from"
        walked, _ = judging.score_jobs(
            setup, {case: job}, title=title, with_walk=[case], **options
        )[case]
        longest = max(longest, walked.upright)
        if walked.score.fallen:
            body, host_job = jax.tree.map(np.asarray, robot), on_host(job)
            falling = setup.pool.submit(fall_of, setup.config.rollout.walk, body, host_job)
            falls.append(f"{name} on the high-fidelity simulator {falling.result() or 'fell'}")
    if longest < run.seconds / 2:
        raise InputError(f"--start {text} cannot be tuned from: {falls[0]}")
    for fall in falls:
        say(f"--start {text} falls late and is tuned from nevertheless: {fall}")


def _note_settings(run: _Run, net: nets.TrainedNet) -> dict[str, Any]:
    """Add the resolved settings to config.json; InputError if they differ from those recorded."""
    as_lists = partial(jax.tree.map, lambda x: np.asarray(x).tolist())
    commands = [as_lists(command)._asdict() for command in run.commands.values()]
    settings = {
        "tune": run.setup.config.as_table(),
        "net": tree_hash(net.params),
        "command": commands[0] if len(commands) == 1 else commands,
        "seconds": run.seconds,
        "start": weights_tree(run.start),
    }
    return run_folder.note_settings(run.folder, settings)


def _tune_sets(run: _Run, net: nets.TrainedNet) -> _Tuned:
    """Tune without and with the net; write the weights."""
    setup, commands = run.setup, list(run.commands.values())
    problems, folder = run.problems(net), run.folder / _ARTEFACTS
    tune_in = partial(tunings.tune_all, folder=folder, metrics=run.folder / METRICS)
    title = f"tuning {run.name} without and with GRFM-Net"
    done = tune_in(setup, problems, title=title, start=run.start)
    models = plural(best_set.DRAWS * len(commands), "drawn model")
    title = f"tuning {run.name} on {models}, for `best`"
    config, start = run.settings_of_best
    problem = {"best": problems["with"]._replace(draws=best_set.DRAWS)}
    of_best = setup._replace(config=config)
    done |= tune_in(of_best, problem, title=title, start=start, before=done)
    sets = {
        "nominal": nominal(setup.robot),
        "expert": expert(setup.robot),
        **({} if run.args.start in OF_ROBOT else {"start": run.start}),
        **{name: tuning.weights for name, tuning in done.items()},
    }
    for name, weights in sets.items():  # a tuning on walks may be long: these can be used meanwhile
        save_weights(run.folder / "weights" / f"{name}.json", weights)
    (campaign, budget), walks, begun = _campaign(run), None, ""
    if budget:
        tuned = {name: sets[name] for name in ("best", "with", "without")}
        starts = {n: w._replace(others={**start.others, **w.others}) for n, w in tuned.items()}
        begun, campaign = with_best_start(setup.pool, campaign, starts | {"start": start})
        walks = tune_on_walks(setup.pool, campaign, walks=budget)
        if not walks.sets[0].accepted:
            say(f"no steps on walks: {walks.reason}")
        sets["best"] = walks.sets[walks.best].weights
        save_weights(run.folder / "weights" / "best.json", sets["best"])
    return _Tuned(net, done, sets, walks, begun)


def _campaign(run: _Run) -> tuple[Campaign, int]:
    """Return the tuning of `best` on walks, from the start of that on the model, and its budget."""
    robot, args, (config, start) = run.setup.robot, run.args, run.settings_of_best
    plants, budget = best_set.walk_plants(robot, args.walk_plants, args.walks, len(run.commands))
    settings, engine = best_set.on_walks(config), arguments.engine_of(args)
    folder, commands = run.folder / "walks", run.commands
    return Campaign(folder, settings, robot, start, commands, plants, engine), budget


def _walk_sets(run: _Run, sets: Mapping[str, Weights]) -> tuple[Judged, Judged]:
    """Walk all sets on the stand-in plants, and on the hfs."""
    seeds, description = range(run.args.seeds), run.setup.robot.description
    plants = arguments.plants("standin", seeds, description)
    options: dict[str, Any] = {"seconds": run.seconds, "folder": run.folder / _ARTEFACTS}
    judge = partial(judging.judge, run.setup, sets, run.commands, **options)
    title = f"evaluating on {plural(len(seeds), 'stand-in plant')}"
    standin = judge(plants, seeds, title=title, about={"world": "standin"})
    title = "walking on the high-fidelity simulator"
    on_hfs = judge([hfs(description)], [0], title=title, about={"world": "hfs"})
    for name in run.commands:
        _say_worse(name, on_hfs.verdict.of_scene(name))
    return standin, on_hfs


def _say_worse(name: str, on_hfs: metrics.Verdict) -> None:
    """Report tuned sets that walk worse than the nominal weights."""
    L = {set_name: score.L.item() for set_name, score in on_hfs.scores.items()}
    for tuned in ("without", "with", "best"):
        if L.get(tuned, 0.0) > 1.05 * L["nominal"]:  # less says nothing, of one walk
            say(
                f"{name}: on the high-fidelity simulator `{tuned}` has L {L[tuned] / 1e6:.3g}e6, "
                f"nominal {L['nominal'] / 1e6:.3g}e6: the model or the loss may not fit this robot"
            )


def _result(
    run: _Run,
    tuned: _Tuned,
    verdicts: Mapping[str, metrics.Verdict],
    known: Determined,
    carried: Carried | None,
) -> dict[str, Any]:
    """Write result.json, with the verdict in each world; return its content."""
    result = metrics.verdict_result(verdicts)
    if tuned.walks:
        result |= {"walks": tuned.walks.rows, "walks_begun_with": tuned.begun_with}
    if carried:
        change = {scene: ends._asdict() for scene, ends in carried.change.items()}
        result["elsewhere"] = {**carried._asdict(), "change": change}
    directions = [direction._asdict() for direction in known.directions]
    result["determined"] = {"directions": directions, "weights": known.weights}
    write_json(run.folder / RESULT, result)
    return result


def _draw(run: _Run, tuned: _Tuned, standin: Judged, on_hfs: Judged) -> dict[str, Any]:
    """Draw the pictures and the film of a run, for its report."""
    effects = {"linear": as_effect(tuned.net.linear), "residual": as_effect(tuned.net.params)}
    name = run.trajectories[0].name
    walks, on_simulator = standin.first(name), on_hfs.first(name)["nominal"]
    with ThreadPoolExecutor(1) as background:  # another process draws the film
        film = background.submit(_film, run, walks)
        curves = fidelity.curves(run.setup.robot, on_simulator, effects)
        drawings = pictures.of_run(
            run.folder,
            run.setup.config,
            sets=tuned.sets,
            tunings=tuned.tunings,
            walks=walks,
            ground=curves,
            training=tuned.net.history,
        )
    return {"pictures": drawings, "film": film.result()}


def _film(run: _Run, walks: Mapping[str, Trajectory]) -> Picture | str:
    """Make the film of a run; return the reason if there is none."""
    if not run.args.video:
        return "left out (--no-video)"
    pair = {name: walks[name] for name in ("nominal", "best")}
    film = [run.folder / f"film.{kind}" for kind in ("mp4", "png")]
    reason = pictures.film(film[0], run.setup.robot, pair, film[1])
    return reason or Picture("film.mp4", "Nominal and tuned weights on the first stand-in plant.")
