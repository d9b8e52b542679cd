"""`hector tune`: weights tuned with and without the net, judged and reported in a run folder."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.cli import arguments, run_folder
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import BASELINES, Tune, Walk
from hector_jax.cli.parse import as_command
from hector_jax.cli.verdict import small_verdict
from hector_jax.control.parameters import tunables
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import save_weights, weights_tree
from hector_jax.core.console import say
from hector_jax.core.environment import environment
from hector_jax.core.files import as_json, locked, write_json
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.runtime import workers
from hector_jax.core.tree_file import tree_hash
from hector_jax.grfm.jobs import PIECES
from hector_jax.grfm.network import as_effect
from hector_jax.report import fidelity, pictures
from hector_jax.report.report import Picture, print_table
from hector_jax.report.run import write_report
from hector_jax.report.video import check_film
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import choice, metrics, nets, tunings, verdicts
from hector_jax.runs.folder import CONFIG, METRICS, RESULT, VERSIONS, Journal, read_object
from hector_jax.runs.verdicts import ScoredWalks
from hector_jax.runs.walks import Row, campaign, changes, tune_on_walks
from hector_jax.sim.diagnosis import not_the_weights
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import on_host
from hector_jax.sim.world import hfs
from hector_jax.tuning.difftune import TuneConfig, Tuning
from hector_jax.tuning.evaluate import aligned

_FOLDERS = ("out", "run", "resume")  # flags that name the run folder


def tune(args: Tune) -> None:
    """Tune one weight set for all trajectories, or one for each, anew or where a run was left."""
    named = [f"--{name} {getattr(args, name)}" for name in _FOLDERS if getattr(args, name)]
    if len(named) > 1:
        raise InputError(f"{' and '.join(named)}: only one can be given")
    if args.video:
        check_film(Path("film.mp4"))
    base, robot = args.resume or args.out or args.run, load_robot(args.robot)
    runs = run_folder.by_folder(args, base, robot)
    if args.resume:
        runs = {folder: run_folder.resume(folder, one) for folder, one in runs.items()}
    else:
        for folder, one in runs.items():
            _trajectories(one, robot)
            arguments.weights(one.start, robot)
            if base and folder.exists():
                raise run_folder.exists_error(folder)
        runs = {run_folder.begin(folder, one): one for folder, one in runs.items()}
    for folder, one in runs.items():
        with locked(folder):
            _tune_in(folder, one)


def _trajectories(args: Tune, robot: Robot) -> tuple[NamedCommand, ...]:
    """What a tuning is to walk.

    Raises:
        InputError: there is no such trajectory, they last differently, or --refresh cannot take
            them.
    """
    courses = arguments.courses(args.traj, robot, "; add --each")
    first, pieces = courses[0], len(courses[0].command.duration)
    plants = max(args.walk_plants, 1)
    if 0 < args.walks < (least := 2 * len(courses) * plants):
        what = f"{plural(len(courses), 'command')} on {plural(plants, 'plant')}, twice"
        raise InputError(f"--walks must be 0 or at least {least} ({what}), got {args.walks}")
    if not args.refresh:
        return courses
    if args.net:
        raise InputError(f"--net {args.net}: --refresh needs the walks that a net was trained on")
    if tunables(args.tune) or arguments.weights(args.start, robot).others:
        raise InputError("--refresh takes Q and R alone, neither --tune nor a start with others")
    if len(courses) > 1:
        raise InputError(f"--refresh takes one trajectory, got {len(courses)}; add --each")
    if pieces > PIECES:
        about = f"at most {PIECES} segments, {first.name} has {pieces}"
        raise InputError(f"--refresh takes trajectories of {about}")
    return courses


class _Run(NamedTuple):
    """What the steps of a run share."""

    folder: Path
    args: Tune
    robot: Robot
    start: Weights
    trajectories: tuple[NamedCommand, ...]
    seconds: float  # of each walk
    config: TuneConfig
    net: nets.TrainedNet
    commit: str

    @property
    def artefacts(self) -> Path:
        """Folder of the artefacts."""
        return self.folder / "kept"

    @property
    def name(self) -> str:
        """What is walked."""
        return ", ".join(one.name for one in self.trajectories)

    @property
    def problems(self) -> dict[str, tunings.Problem]:
        """All trajectories, to be tuned without and with the net."""
        command, *others = (one.command for one in self.trajectories)
        params = {"without": None, "with": self.net.params}
        return {name: tunings.Problem(command, net, tuple(others)) for name, net in params.items()}


class _Tuned(NamedTuple):
    """What the tunings of a run came to."""

    tunings: dict[str, Tuning]
    shifts: list[dict[str, Any]]  # of each refresh
    sets: dict[str, Weights]
    choices: dict[str, choice.Choice]  # empty where the last iterations are taken
    walked: list[Row]  # empty where no walk was spent on tuning


def _tune_in(folder: Path, args: Tune) -> None:
    """All of a run, taking up what is in its folder."""
    begun, made_with = time.monotonic(), environment()
    robot = load_robot(args.robot)
    trajectories = _trajectories(args, robot)
    config = tunings.tune_config(robot, iterations=args.iterations, others=tunables(args.tune))
    say(f"the run folder is {folder}")
    with workers(args.processes) as pool:
        _say_what_no_weights_mend(pool, config, robot, trajectories[0])
        run = _Run(
            folder,
            args,
            robot,
            arguments.weights(args.start, robot),
            trajectories,
            trajectories[0].seconds or Walk.seconds,
            arguments.with_length(config, trajectories[0]),
            _net(pool, args, robot),
            made_with.get("commit", ""),
        )
        norms = tunings.gradient_norms(pool, run.config, robot, run.problems)
        if args.alpha == "auto":
            loss = aligned(run.config.loss, norms["with"])
            say("loss weights: " + ", ".join(f"{t.name} {t.weight:g}" for t in loss))
            run = run._replace(config=replace(run.config, loss=loss))
        settings = _note_settings(run)
        curvature = tunings.curvature(pool, run.config, robot, run.start, run.problems["with"])
        tuned = _tune_sets(pool, run)
        walks = _walk_sets(pool, run, tuned.sets)
        where = trajectories[0], run.seconds, run.artefacts / "elsewhere"
        small = small_verdict(pool, run.config, robot, tuned.sets, *where) if args.verdict else None
    result, by_name = _result(run, tuned, walks)
    seconds = f"{time.monotonic() - begun:.0f}"
    write_json(folder / VERSIONS, made_with | {"seconds": seconds})
    standin, on_hfs = walks[trajectories[0].name]
    report = write_report(
        folder,
        trajectory=run.name,
        verdict=by_name[run.name],
        norms=norms,
        curvature=curvature,
        errors=run.net.errors,
        **_of_tunings(tuned),
        chosen=result.get("chosen", {}),
        pictures=_draw(run, tuned, standin, on_hfs),
        film=_film(run, standin),
        config=settings,
        environment=made_with,
        command=as_command("hector tune", run_folder.as_begun(args)),
    )

    def in_words() -> None:
        for name, one in by_name.items():
            print_table(one, f"{name}, {plural(args.seeds, 'plant')}")
        if small:
            small()

    print_result(args.json, {"run": str(folder), "traj": run.name, **result}, in_words)
    say(f"the report is {report}")


def _of_tunings(tuned: _Tuned) -> dict[str, Any]:
    """What the report tells of the tunings themselves."""
    cases = len(tuned.walked[0].losses) if tuned.walked else 0
    walks = {"walked": changes(tuned.walked), "cases": cases}
    return {"tunings": tuned.tunings, "shifts": tuned.shifts, **walks}


def _net(pool: Executor, args: Tune, robot: Robot) -> nets.TrainedNet:
    if args.net is not None:
        return nets.load_net(args.net, robot, args.variant)[0]
    data = arguments.folder_of(args.data, args.robot, robot)
    return nets.load_or_train(pool, robot, data, args.variant)


def _say_what_no_weights_mend(
    pool: Executor, config: TuneConfig, robot: Robot, course: NamedCommand
) -> None:
    """Walk once with nominal weights on the simulator; a line for what is not the weights."""
    seconds = course.seconds or Walk.seconds
    job = Job(nominal(robot), course.command, hfs(robot.description), seconds)
    inputs = config.rollout.walk, jax.tree.map(np.asarray, robot), on_host(job)
    for line in pool.submit(not_the_weights, *inputs).result():
        say(f"before any tuning, {course.name} on hfs with nominal weights: {line}")


def _note_settings(run: _Run) -> dict[str, Any]:
    """Write what the run follows from beside its flags; InputError where it was otherwise."""
    path = run.folder / CONFIG
    begun = read_object(path)
    commands = [
        {name: np.asarray(x).tolist() for name, x in one.command._asdict().items()}
        for one in run.trajectories
    ]
    now = {
        "tune": run.config.as_table(),
        "net": tree_hash(run.net.params),
        "command": commands[0] if len(commands) == 1 else commands,
        "seconds": run.seconds,
        "start": weights_tree(run.start),
        "choice_plants": run.robot.description.tuning.choice_plants,
    }
    here = json.loads(as_json(now))
    run_folder.check_agreement(run.folder, begun, here)
    if begun.get("start", here["start"]) != here["start"]:  # a number came or went
        raise InputError(f"{run.folder}: begun with a start of other numbers beside Q and R")
    write_json(path, begun | now)
    return begun | now


def _refresh(
    pool: Executor, run: _Run, done: dict[str, tunings.Tuned], step: Callable
) -> list[dict[str, Any]]:
    """Train the net anew at the tuned weights and tune through it, into `done`; what shifted."""
    net, name, shifts = run.net, "with", []
    for count in range(1, run.args.refresh + 1):
        config = replace(nets.REFRESH, seed=count, seconds=run.seconds)
        folder = run.folder / f"refresh-{count}"
        seen = run.trajectories[0].command, done[name].tuning
        net, shift = nets.refresh(pool, config, run.robot, *seen, net=net, folder=folder)
        shifts.append(shift)
        name = "with_refreshed" + (str(count) if count > 1 else "")
        problem = {name: run.problems["with"]._replace(params=net.params)}
        done |= step(problem, title=f"tuning {run.name} with the net refreshed")
    return shifts


def _tune_sets(pool: Executor, run: _Run) -> _Tuned:
    """Tune without and with the net, and again with it refreshed; writes the weights."""
    journal = Journal(run.folder / METRICS)
    step = partial(
        tunings.tune,
        pool,
        run.config,
        run.robot,
        folder=run.artefacts,
        start=run.start,
        commit=run.commit,
        journal=journal,
        dumps=run.folder / "dumps",
    )
    done = step(run.problems, title=f"tuning {run.name} without and with GRFM-Net")
    shifts, name = _refresh(pool, run, done, step), list(done)[-1]
    tuned = {name: one.tuning for name, one in done.items()}
    commands = [one.command for one in run.trajectories]
    notes = {"seconds": run.seconds, "folder": run.artefacts / "choice", "commit": run.commit}
    choices = choice.choose(pool, run.config, run.robot, tuned, commands, **notes)
    sets = {
        "nominal": nominal(run.robot),
        "expert": expert(run.robot),
        **({} if run.args.start in BASELINES else {"start": run.start}),
        **{f"{name}_ten": tuned[name].ten for name in run.problems},
        **{name: one.converged for name, one in tuned.items()},
        **{name: one.weights for name, one in choices.items()},
    }
    candidates = {n: sets[n] for n in ("nominal", *tuned)}
    pair = "without", name
    sets["best"] = choice.answer(
        pool, run.config, run.robot, candidates, pair, run.args.share, commands, **notes
    )
    walked: list[Row] = []
    if run.args.walks:
        sets["before_walks"] = sets.pop("best")
        sets["best"], walked = _tune_on_walks(pool, run, sets["before_walks"])
    for name, weights in sets.items():
        save_weights(run.folder / "weights" / f"{name}.json", weights)
    return _Tuned(tuned, shifts, sets, choices, walked)


def _tune_on_walks(pool: Executor, run: _Run, start: Weights) -> tuple[Weights, list[Row]]:
    """Spend the walks that were asked for, from the answer of the tunings on."""
    count = run.args.walk_plants
    plants = choice.drawn_plants(run.robot, count) if count else [hfs(run.robot.description)]
    commands = {one.name: one.command for one in run.trajectories}
    inputs = run.folder / "walks", run.config, run.robot, start, commands, plants
    return tune_on_walks(pool, campaign(*inputs), run.args.walks)


def _walk_sets(
    pool: Executor, run: _Run, sets: Mapping[str, Weights]
) -> dict[str, tuple[ScoredWalks, ScoredWalks]]:
    """Walks of all sets on the stand-in plants and on the hfs, by trajectory."""
    seeds = range(run.args.seeds)
    plants = arguments.plants("standin", seeds, run.robot.description)
    notes: dict[str, Any] = {"seconds": run.seconds, "commit": run.commit}
    judge = partial(verdicts.judge, pool, run.config, run.robot, sets, **notes)
    simulator, walks = hfs(run.robot.description), {}
    for name, command, _ in run.trajectories:
        where = f" {name}" if len(run.trajectories) > 1 else ""
        title = f"evaluating{where} on {plural(len(seeds), 'stand-in plant')}"
        standin = judge(command, plants, seeds, title=title, folder=run.artefacts / "standin")
        title = f"walking{where} on the high-fidelity simulator"
        on_hfs = judge(command, [simulator], [0], title=title, folder=run.artefacts / "hfs")
        walks[name] = standin, on_hfs
        _say_worse(name, on_hfs)
    return walks


def _say_worse(name: str, on_hfs: ScoredWalks) -> None:
    """Say where what was tuned walks worse than what it was tuned from."""
    L = {each: float(scores[0].L) for each, scores in on_hfs.scores.items()}
    for each in ("without", "with", "best"):
        if L.get(each, 0.0) > L["nominal"]:
            say(
                f"{name}: on the high-fidelity simulator `{each}` walks with L {L[each] / 1e6:.3g}"
                f"e6, nominal with {L['nominal'] / 1e6:.3g}e6: its model is wrong about this robot"
            )


def _result(
    run: _Run, tuned: _Tuned, walks: Mapping[str, tuple[ScoredWalks, ScoredWalks]]
) -> tuple[dict[str, Any], dict[str, metrics.Verdict]]:
    """Write result.json; its content, and the verdicts: of all walks, and by trajectory."""

    def verdict(names: Sequence[str], world: int) -> metrics.Verdict:
        each = [walks[name][world] for name in names]
        scores = {n: [s for one in each for s in one.scores[n]] for n in tuned.sets}
        seeds = ([*range(run.args.seeds)], [0])[world] * len(names)
        return metrics.make_verdict(run.config.loss, seeds, scores)

    def content(names: Sequence[str], one: metrics.Verdict) -> dict[str, Any]:
        result = metrics.as_result(one)
        for name, there in metrics.as_result(verdict(names, 1), "hfs")["sets"].items():
            result["sets"][name] |= there
        return result

    names = list(walks)
    by_name = {run.name: verdict(names, 0)}
    result = content(names, by_name[run.name])
    if len(names) > 1:
        by_name |= {name: verdict([name], 0) for name in names}
        result["trajectories"] = {name: content([name], by_name[name]) for name in names}
    if tuned.shifts:
        result["refresh"] = tuned.shifts
    if tuned.walked:
        result["walks"] = [one._asdict() for one in changes(tuned.walked)]
    if tuned.choices:
        chosen = tuned.choices.items()
        result["chosen"] = {n: {"iteration": one.iteration, "of": one.of} for n, one in chosen}
    write_json(run.folder / RESULT, result)
    return result, by_name


def _draw(run: _Run, tuned: _Tuned, walks: ScoredWalks, on_hfs: ScoredWalks) -> list[Picture]:
    effects = {"linear": as_effect(run.net.linear), "residual": as_effect(run.net.params)}
    sampled = jax.tree.map(lambda x: np.asarray(x)[None], on_hfs.first["nominal"])
    curves = fidelity.curves(run.robot, sampled, effects)
    drawn = tuned.sets, tuned.tunings, walks.first, curves, run.net.course
    return pictures.of_run(run.folder, run.config, *drawn)


def _film(run: _Run, walks: ScoredWalks) -> Picture | str:
    """The film of a run, or why there is none."""
    if not run.args.video:
        return "left out (--no-video)"
    pair = {name: walks.first[name] for name in ("nominal", "best")}
    film = run.folder / "film.mp4"
    reason = pictures.film(film, run.robot, pair, run.folder / "film.png")
    return reason or Picture(film.name, "Nominal and tuned weights on the first stand-in plant.")
