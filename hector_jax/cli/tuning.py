"""Tuning, begun or taken up again, and search."""

import dataclasses
import json
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hector_jax.cli import asked, judging
from hector_jax.cli.flags import Search, Tune, Walk
from hector_jax.cli.parse import as_command, as_table, from_file
from hector_jax.control.reference import COMMANDS
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import expert, nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.core.console import say
from hector_jax.core.environment import code_hash, environment, versions
from hector_jax.core.files import as_json, locked, make_folder, write_json
from hector_jax.core.inputs import InputError, plural, short_repr
from hector_jax.core.runtime import workers
from hector_jax.core.tree_file import tree_hash
from hector_jax.grfm.jobs import PIECES
from hector_jax.grfm.network import as_effect
from hector_jax.report import fidelity, pictures
from hector_jax.report.folder import read_json
from hector_jax.report.report import Picture, Report, print_table, write_report
from hector_jax.report.video import check_film
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import kept, metrics, pipeline
from hector_jax.runs.cache import robot_hash
from hector_jax.runs.kept import Judged
from hector_jax.runs.metrics import Score
from hector_jax.search.cmaes import SearchConfig
from hector_jax.sim.engine import choose_engine
from hector_jax.sim.world import hfs
from hector_jax.tuning.difftune import aligned

_CODE = (*pipeline.COLLECTION_CODE, "grfm.training", "sim.standin", "runs.metrics")
_NEW = ("config", "resume", "run", "runs")  # of a call, not of the run that it begins or resumes
_FREE = ("data", "json", "processes", "video")  # may be others when a run is resumed
_TIME = "%Y%m%d-%H%M%S"  # names a run


def tune(args: Tune) -> None:
    """Tune on the trajectories asked for, anew or where a run was left."""
    if args.run and args.resume:
        raise InputError(f"--run {args.run} and --resume {args.resume}: only one can be given")
    if args.video:
        check_film(Path("film.mp4"))
    texts = COMMANDS if args.traj == "all" else (args.traj,)
    base = args.resume or args.run
    if base is None:
        robot, now = load_robot(args.robot), f"{datetime.now():{_TIME}}"
        runs = asked.folder_of(args.runs, args.robot, robot)
        folders = {text: runs / asked.course(text, robot).name / now for text in texts}
    else:
        folders = {text: base / text if args.traj == "all" else base for text in texts}
    several = {folder: replace(args, traj=text) for text, folder in folders.items()}
    if args.resume:
        several = {folder: _as_begun(folder, one) for folder, one in several.items()}
    else:
        for folder, one in several.items():
            _asked_for(one, load_robot(args.robot))
            if args.run and folder.exists():
                raise InputError(_taken(folder))
        several = {_begin(folder, one): one for folder, one in several.items()}
    for folder, one in several.items():
        with locked(folder):
            _tune_in(folder, one)


def _taken(folder: Path) -> str:
    return f"run folder {folder} exists; continue it with --resume or name another with --run"


def _begin(folder: Path, args: Tune) -> Path:
    """Make the folder of a new run, at once with its flags: one that is there can be resumed.

    Returns:
        The folder; if nobody named it and it is there, that of the next free second.
    """
    make_folder(folder.parent)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as part:
        new = Path(part) / "run"
        write_json(new / "versions.json", environment())
        # without the folder, so that `--config` can ask for the same in another one
        flags = as_table(replace(args, run=None, resume=None))
        robot, here = robot_hash(load_robot(args.robot)), str(Path.cwd())
        config = {"flags": flags, "directory": here, "robot": robot, "code": code_hash(*_CODE)}
        write_json(new / "config.json", config)
        while True:
            try:
                return new.rename(folder)
            except OSError:
                if args.run or not folder.exists():
                    raise InputError(_taken(folder)) from None
            later = datetime.strptime(folder.name, _TIME) + timedelta(seconds=1)
            folder = folder.with_name(f"{later:{_TIME}}")


def _as_begun(folder: Path, args: Tune) -> Tune:
    """The flags of the run in `folder`; those given beside --resume have to agree.

    A flag at its default counts as not given. Of those that change no number the given one is
    taken.

    Raises:
        InputError: one line naming the file: no run, one of other flags, other code, another robot,
            or one whose data are not here.
    """
    path, flags = folder / "config.json", {}
    config, made_with = read_json(path), read_json(folder / "versions.json")
    for name in ("robot", "code", "directory"):
        if not isinstance(config.get(name), str):
            raise InputError(f"{path}: {name} must be text, got {short_repr(config.get(name))}")
    begun = from_file(Tune, path)
    if config["code"] != code_hash(*_CODE):
        commit = made_with.get("commit", "no commit is noted")
        raise InputError(
            f"{folder}: begun with other code or other versions of its packages ({commit}); "
            "start a new run"
        )
    _agree(folder, config, {"robot": robot_hash(load_robot(begun.robot))})
    for field in dataclasses.fields(Tune):
        name = field.name
        if name in _NEW:
            continue
        before, given = getattr(begun, name), getattr(args, name)
        flags[name] = before if given == field.default else given
        if name not in _FREE and flags[name] != before:
            raise InputError(f"{folder}: begun with --{name} {before}, got {given}")
    now = replace(args, **flags)
    data = asked.folder_of(now.data, now.robot, load_robot(now.robot))
    if not now.net and not data.exists() and Path(config["directory"]) != Path.cwd():
        raise InputError(
            f"{data}: no data here; the run was begun in {config['directory']}: resume it there, "
            "or name the folder by --data"
        )
    return now


def _agree(folder: Path, begun: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Hold what a run follows from against what it followed from when it was begun."""
    for name, value in now.items():
        if isinstance(value, dict):
            before = begun.get(name, {})
            if not isinstance(before, dict):
                raise InputError(f"{folder / 'config.json'}: {name}: no settings: {before!r}")
            _agree(folder, before, value)
        elif begun.get(name, value) != value:
            raise InputError(f"{folder}: begun with {name} {begun[name]}, here is {value}")


def _asked_for(args: Tune, robot: Robot) -> NamedCommand:
    """What a tuning is to walk.

    Raises:
        InputError: there is no such trajectory, or none that --refresh can take.
    """
    wanted = asked.course(args.traj, robot)
    if args.refresh and args.net:
        raise InputError(f"--net {args.net}: --refresh needs the walks that a net was trained on")
    if args.refresh and len(wanted.command.duration) > PIECES:
        raise InputError(
            f"--refresh takes trajectories of at most {PIECES} segments, {wanted.name} has "
            f"{len(wanted.command.duration)}"
        )
    return wanted


def _tune_in(folder: Path, args: Tune) -> None:
    """All of a run, taking up what is in its folder."""
    robot, start = load_robot(args.robot), time.monotonic()
    wanted = _asked_for(args, robot)
    command, lasts = wanted.command, wanted.seconds or Walk.seconds
    config = asked.lasting(asked.tune_config(robot, iterations=args.iterations), wanted)
    shelf, data = folder / "kept", asked.folder_of(args.data, args.robot, robot)
    made_with = environment()
    commit = made_with.get("commit", "")
    say(f"the run folder is {folder}")
    with workers(args.processes) as pool:
        if args.net is None:
            net = pipeline.ground(pool, robot, data, args.variant)
        else:
            net, _ = pipeline.load_learned(args.net, robot, args.variant)
        problems = {"without": (command, None), "with": (command, net.params)}
        norms = pipeline.gradient_norms(pool, config, robot, problems)
        if args.alpha == "auto":
            config = replace(config, loss=aligned(config.loss, norms["with"]))
            say(f"loss weights alpha: {config.loss.euler:g} (Euler), {config.loss.position:g}")
        begun = read_json(folder / "config.json")
        now = {
            "tune": dataclasses.asdict(config),
            "net": tree_hash(net.params),
            "command": {name: np.asarray(x).tolist() for name, x in command._asdict().items()},
            "seconds": lasts,
        }
        _agree(folder, begun, json.loads(as_json(now)))
        resolved = {**begun, **now}
        write_json(folder / "config.json", resolved)
        shifts: list[dict[str, Any]] = []
        journal, dumps = pipeline.Journal(folder / "metrics.jsonl"), folder / "dumps"
        known = (pool, config, robot)
        title = f"tuning {wanted.name} without and with GRFM-Net"
        notes = {"commit": commit, "journal": journal, "dumps": dumps}
        tunings = pipeline.tune(*known, problems, shelf, title=title, **notes)
        newest, tuning = net, tunings["with"].tuning
        for count in range(1, args.refresh + 1):
            newest, shift = pipeline.refresh(
                pool,
                replace(pipeline.REFRESH, seed=count, seconds=lasts),
                config,
                robot,
                command,
                tuning,
                newest,
                folder / f"refresh-{count}",
            )
            shifts.append(shift)
            name = "with_refreshed" + (str(count) if count > 1 else "")
            again = {name: (command, newest.params)}
            title = f"tuning {wanted.name} with the net refreshed"
            tunings |= pipeline.tune(*known, again, shelf, title=title, **notes)
            tuning = tunings[name].tuning

        sets = {
            "nominal": nominal(robot),
            "expert": expert(robot),
            **{f"{name}_ten": tunings[name].tuning.ten for name in problems},
            **{name: tuned.tuning.converged for name, tuned in tunings.items()},
        }
        for name, weights in sets.items():
            save_weights(folder / "weights" / f"{name}.json", weights)
        seeds = range(args.seeds)
        judged = kept.judge(
            *known,
            sets,
            command,
            asked.plants("standin", seeds),
            seeds,
            shelf / "standin",
            commit,
            f"evaluating on {plural(args.seeds, 'stand-in plant')}",
            lasts,
        )
        title = "walking on the high-fidelity simulator"
        there = (command, [hfs()], [0], shelf / "hfs")
        on_hfs = kept.judge(*known, sets, *there, commit, title, lasts)
    verdict = judging.verdict_of(config.loss, seeds, _scores(judged))
    result = metrics.as_result(verdict)
    told_hfs = metrics.as_result(judging.verdict_of(config.loss, [0], _scores(on_hfs)), "hfs")
    for name, found in told_hfs["sets"].items():
        result["sets"][name] |= found
    if shifts:
        result["refresh"] = shifts
    write_json(folder / "result.json", result)
    write_json(folder / "versions.json", made_with | {"seconds": f"{time.monotonic() - start:.0f}"})
    histories = {name: tuned.tuning for name, tuned in tunings.items()}
    walks, sampled = judged.shown, on_hfs.shown["nominal"]
    effects = {"linear": as_effect(net.linear), "residual": as_effect(net.params)}
    curves = fidelity.curves(robot, jax.tree.map(lambda x: np.asarray(x)[None], sampled), effects)
    drawn = pictures.of_run(folder, config, sets, histories, walks, curves, net.course)
    film: Picture | str = "left out (--no-video)"
    if args.video:
        pair = {name: walks[name] for name in ("nominal", "with")}
        caption = "Nominal and tuned weights on the first stand-in plant."
        film = pictures.film(folder / "film.mp4", robot, pair, folder / "film.png") or Picture(
            "film.mp4", caption
        )
    told = write_report(
        folder,
        Report(
            trajectory=wanted.name,
            verdict=verdict,
            tunings=histories,
            norms=norms,
            errors=net.errors,
            shifts=shifts,
            pictures=drawn,
            film=film,
            config=resolved,
            environment=made_with,
            command=as_command("tune", replace(args, run=None, resume=None)),
        ),
    )
    if args.json:
        print(as_json({"run": str(folder), "traj": wanted.name, **result}))
    else:
        print_table(verdict, f"{wanted.name}, {plural(args.seeds, 'plant')}")
    say(f"the report is {told}")


def _scores(judged: Judged) -> dict[str, list[Score]]:
    return {name: [walk.score for walk in walks] for name, walks in judged.walks.items()}


def search(args: Search) -> None:
    """Search for weights on the simulator, without gradients."""
    robot = load_robot(args.robot)
    wanted = [
        asked.course(text, robot) for text in (COMMANDS if args.traj == "all" else (args.traj,))
    ]
    own = {one.name: one.command for one in wanted}
    config = SearchConfig(args.budget, args.population, args.seed, args.spread)
    engine = choose_engine(args.engine)
    tune, start = (
        asked.lasting(asked.tune_config(robot), wanted[0]),
        asked.weights(args.start, robot),
    )
    out = asked.default_of(args.out, Search.out, args.robot, robot)
    make_folder(out)
    with workers(args.processes) as pool:
        found = pipeline.search(
            pool,
            config,
            tune,
            robot,
            dict.fromkeys(own, start),
            engine,
            args.record or out,
            own,
        )
        say("walking with the start, expert and best weights")
        sets = {name: [start, expert(robot), found[name].weights] for name in own}
        at_once = config.population * len(own)
        compared = pipeline.losses_on_hfs(pool, tune, robot, engine, sets, at_once, own)
    cards = {}
    for name, one in found.items():
        at_start, at_expert, again = compared[name].tolist()
        walks = len(one.history) * config.population
        losses = {"start": at_start, "best": one.loss, "best_again": again, "expert": at_expert}
        cards[name] = {
            "trajectory": name,
            "L": losses,
            "walks": walks,
            "best_at": one.walk,
            "stop": one.stop,
            "search": dataclasses.asdict(config),
            "start": args.start,
            "engine": engine.name,
            "rollout": dataclasses.asdict(tune.rollout),
            "loss": dataclasses.asdict(tune.loss),
            "versions": versions(),
        }
        save_weights(out / f"{name}.json", one.weights)
        write_json(out / f"{name}-card.json", cards[name])
    if args.json:
        print(as_json({"weights": str(out), "cards": cards}))
    else:
        print("L in 1e6 on the high-fidelity simulator")
        print(f"{'':10s}{'start':>9s}{'best':>9s}{'expert':>9s}{'walks':>8s}{'best at':>9s}")
        for name, card in cards.items():
            shown = "".join(f"{card['L'][x] / 1e6:9.3f}" for x in ("start", "best", "expert"))
            print(f"{name:10s}{shown}{card['walks']:8d}{card['best_at']:9d}")
    say(f"the weights are in {out}")
