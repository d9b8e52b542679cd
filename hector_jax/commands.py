"""What each command of `hector` does with its flags (flags.py)."""

import dataclasses
import json
import shlex
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from datetime import datetime
from functools import partial, singledispatch
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hector_jax import doctor, export, kept, pipeline, replay, study
from hector_jax.console import Broken, say
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.trajectories import Course, beyond, course, limits
from hector_jax.control.walking import walk_config
from hector_jax.control.weights import WEIGHT_NAMES, Weights, expert, nominal, weights_to_vector
from hector_jax.evaluation import fidelity, metrics, plots, progress, runs, view
from hector_jax.evaluation.metrics import Score, Verdict
from hector_jax.evaluation.report import (
    WORLDS,
    Picture,
    Report,
    environment,
    print_table,
    write_fidelity,
    write_report,
)
from hector_jax.evaluation.tensorboard import write_events
from hector_jax.evaluation.video import Arrows, VideoUnavailable, write_video
from hector_jax.flags import (
    Collect,
    Compare,
    Doctor,
    Evaluate,
    Export,
    Grfm,
    Replay,
    Search,
    Table,
    Tensorboard,
    Train,
    Tune,
    View,
    Walk,
    as_command,
    from_file,
    settings,
)
from hector_jax.grfm import training
from hector_jax.grfm.dataset import PIECES, SOLVED, Walks, at_interval, make_dataset
from hector_jax.grfm.gated import gated_effect
from hector_jax.grfm.network import as_effect, linear_effect, load_net
from hector_jax.grfm.training import TrainConfig, predict
from hector_jax.inputs import did_you_mean, shown
from hector_jax.kept import Journal, Judged
from hector_jax.model.effect import last_command
from hector_jax.robot import Robot, compile_model, load_robot
from hector_jax.runtime import workers
from hector_jax.sim.standin import standin
from hector_jax.sim.walk import Job, walk
from hector_jax.sim.world import Imperfections, hfs, named_world
from hector_jax.storage import (
    as_json,
    check_versions,
    fingerprint,
    load_weights,
    locked,
    make_folder,
    save_tree,
    save_weights,
    versions,
    write_json,
)
from hector_jax.trajectory import Trajectory, Wrench
from hector_jax.tuning.difftune import TuneConfig, Tuning, aligned
from hector_jax.tuning.loss import LossConfig
from hector_jax.tuning.rollout import RolloutConfig
from hector_jax.tuning.search import SearchConfig


@singledispatch
def run(args: Any) -> None:
    """Do what the flags of a command ask for.

    Raises:
        ValueError, OSError: one line that says what is wrong with the input.
    """
    raise NotImplementedError(type(args))


def _weights(text: str, robot: Robot) -> Weights:
    """A weight set by its name, or from a file."""
    named = {"nominal": nominal, "expert": expert}
    if text not in named and not Path(text).suffix and not Path(text).exists():
        raise ValueError(
            f"no weights {shown(text)}{did_you_mean(text, named)}; there are: "
            f"{', '.join(named)}, or a file"
        )
    return named[text](robot) if text in named else load_weights(Path(text))


def _tuned_as(robot: Robot, **settings: Any) -> TuneConfig:
    """Settings of a tuning, with the controller that the robot's description asks for."""
    return TuneConfig(rollout=RolloutConfig(walk=walk_config(robot)), **settings)


def _of_robot(folder: Path, asked: Any, robot: Robot) -> Path:
    """Another robot than the packaged one has a folder of its own in there."""
    return folder if asked.robot is None else folder / robot.description.name


def _plants(world: str, seeds: range) -> list[Imperfections]:
    if world == "standin":
        return [standin(seed) for seed in seeds]
    return [named_world(world, seed) for seed in seeds]


def _course(text: str, robot: Robot) -> Course:
    """What to walk; one line says where a file asks for more than the robot may be able to."""
    found = course(text)
    if found.seconds and (told := beyond(limits(robot, walk_config(robot).gait), found.command)):
        say(f"warning: {text}: {told}")
    return found


def _seconds(asked: float, wanted: Course) -> float:
    """Length of a walk: what the trajectory's file says, else what the flag does."""
    if wanted.seconds is None:
        return asked
    if asked != Walk.seconds:
        raise ValueError(
            f"--seconds is for built-in trajectories: {wanted.name} lasts {wanted.seconds:g} s, "
            f"as its file says, got {asked:g}"
        )
    return wanted.seconds


def _lasting(config: TuneConfig, wanted: Course) -> TuneConfig:
    """The tuning with rollouts as long as the trajectory, where its file says how long."""
    if wanted.seconds is None:
        return config
    ticks = round(wanted.seconds / config.rollout.walk.gait.tick)
    return replace(config, rollout=replace(config.rollout, ticks=ticks))


@run.register
def _collect(args: Collect) -> None:
    config = pipeline.CollectConfig(args.walks, args.seconds, args.seed, args.engine)
    robot = load_robot(args.robot)
    tune = _tuned_as(robot)
    with workers(args.processes) as pool:
        pipeline.collect(pool, config, tune, robot, args.out)
    say(f"walks are in {args.out}")


@run.register
def _train(args: Train) -> None:
    config = TrainConfig(args.variant, epochs=args.epochs, seed=args.seed)
    path = args.out or pipeline.net_path(args.data.parent, args.variant)
    found = pipeline.train(config, load_robot(args.robot), args.data, path)
    if args.json:
        print(as_json({"net": str(path), "errors": found.errors}))
    else:
        _print_errors(found.errors)
    say(f"the net is in {path}")


def _print_errors(errors: Mapping[str, Mapping[str, Any]]) -> None:
    print("mean square errors on held-out walks")
    for name, of in errors.items():
        print(f"{name:9s} force {of['force']:8.2f} N^2   moment {of['moment']:7.4f} (N m)^2")


@run.register
def _grfm(args: Grfm) -> None:
    robot, config = load_robot(), TuneConfig()
    make_folder(args.out)
    with workers(args.processes) as pool:
        net = pipeline.ground(pool, config, robot, args.data)
        paper = pipeline.ground(pool, config, robot, args.data, "paper")
        worlds = {"hfs": pipeline.held_out(robot, args.data / "walks")}
        if args.seeds:
            worlds["standin"] = _on_stand_in(pool, config, robot, args.seeds)
    effects = {"raw": last_command, "linear": linear_effect(net.linear)}
    effects["paper"] = as_effect(paper.params)
    effects["residual"] = as_effect(net.params)
    effects["gated"] = gated_effect(net.params.linear)
    say("predicting")
    found, drifts = {}, {}
    for world, walks in worlds.items():
        samples, _ = make_dataset(robot, walks.trajectory, walks.job.start_tick, walks.job.push)
        # a push from outside is in no model
        calm = ~np.any(walks.job.push.force, axis=(1, 2))
        quiet = jax.tree.map(lambda x, calm=calm: x[calm], walks)
        drifts[world] = fidelity.drifts(robot, effects, quiet.trajectory, quiet.job.start_tick)
        found[world] = fidelity.as_result(
            training.report(effects, samples), fidelity.by_phase(effects, samples), drifts[world]
        )
    curves = _curves(robot, worlds["hfs"].trajectory, effects)
    wrenches = plots.wrenches(args.out / "wrenches.png", config.rollout.walk.gait.tick, curves)
    captions = {
        "wrenches": f"{wrenches} The first held-out walk, in the robot's yaw frame.",
        "open_loop": plots.open_loop(
            args.out / "open_loop.png", {WORLDS.get(w, w): found for w, found in drifts.items()}
        ),
        "training": plots.training(args.out / "training.png", net.course),
        "training_paper": plots.training(args.out / "training_paper.png", paper.course),
    }
    pictures = [Picture(f"{name}.png", caption) for name, caption in captions.items()]
    told = write_fidelity(args.out, found, pictures)
    if args.json:
        print(as_json({"report": str(told), "worlds": found}))
    else:
        _print_errors(found["hfs"]["errors"])
    say(f"the whole story, with pictures: {told}")


def _on_stand_in(pool: Executor, config: TuneConfig, robot: Robot, count: int) -> Walks:
    """Walks of the three trajectories with nominal and expert weights, for information only."""
    seeds = range(count)
    jobs = [
        Job(weights, named_command(name), standin(seed), seed=seed)
        for weights in (nominal(), expert())
        for name in COMMANDS
        for seed in seeds
    ]
    return pipeline.walk_all(
        pool, config, robot, jobs, f"walking on {count} stand-in plants, for information"
    )


def _curves(
    robot: Robot, walks: Trajectory, effects: Mapping[str, jax.tree_util.Partial]
) -> dict[str, Wrench]:
    """Command, predictions and measurement of the first of some walks, yaw frame, from t = 0."""
    one = jax.tree.map(lambda x: np.asarray(x)[:1], walks)
    samples, _ = make_dataset(robot, one)
    window = jax.tree.map(jnp.asarray, samples.window)
    names = {"linear": "linear", "paper": "paper", "residual": "predicted"}
    curves = {
        "commanded": jax.tree.map(lambda w: w[:, 0], samples.window.commands),
        "measured": samples.label,
        **{names[n]: predict(effect, window) for n, effect in effects.items() if n in names},
    }

    def by_tick(values: Any) -> np.ndarray:
        """NaN at ticks that are no samples: the first, unsolved ones, those after a fall."""
        rows = np.full((one.fallen.shape[1], *values.shape[1:]), np.nan)
        rows[samples.tick] = values
        return rows

    return {name: jax.tree.map(by_tick, wrench) for name, wrench in curves.items()}


_FREE = ("config", "json", "processes", "resume", "run", "runs", "video")  # change no number


def _taken(folder: Path) -> str:
    return f"run folder {folder} exists; take it up by --resume or name another by --run"


def _begin(folder: Path, args: Tune) -> None:
    """Make the folder of a new run, at once with its flags: one that is there can be resumed."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as part:
        new = Path(part) / "run"
        write_json(new / "versions.json", environment())
        # without the folder, so that `--config` can ask for the same in another one
        asked = settings(replace(args, run=None, resume=None))
        body = fingerprint(load_robot(args.robot))
        write_json(new / "config.json", {"flags": asked, "robot": body})
        try:
            new.rename(folder)
        except OSError:
            raise ValueError(_taken(folder)) from None


def _as_begun(folder: Path, args: Tune) -> Tune:
    """The flags of the run in `folder`; those given beside --resume have to agree.

    Raises:
        ValueError: one line naming the file: no run, one of other flags, versions or another robot.
    """
    as_asked = _read_json(folder / "config.json")
    check_versions(folder / "versions.json", _read_json(folder / "versions.json"))
    begun, taken = from_file(Tune, folder / "config.json"), {}
    _agree(folder, as_asked, {"robot": fingerprint(load_robot(begun.robot))})
    for field in dataclasses.fields(Tune):
        name = field.name
        if name in _FREE:
            continue
        before, given = getattr(begun, name), getattr(args, name)
        if given not in (before, field.default):
            raise ValueError(f"{folder}: begun with --{name} {before}, got {given}")
        taken[name] = before
    return replace(args, **taken)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_bytes())
    except OSError as error:
        raise ValueError(f"{path}: no run to take up: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{path}: no run to take up: {error}") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path}: no run to take up: expected an object")
    return found


def _agree(folder: Path, begun: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Hold what a run follows from against what it followed from when it was begun."""
    for name, value in now.items():
        if isinstance(value, dict):
            _agree(folder, begun.get(name, {}), value)
        elif begun.get(name, value) != value:
            raise ValueError(f"{folder}: begun with {name} {begun[name]}, here is {value}")


@run.register
def _tune(args: Tune) -> None:
    if args.run and args.resume:
        raise ValueError(f"--run {args.run} and --resume {args.resume}: only one can be given")
    asked = COMMANDS if args.traj == "all" else (args.traj,)
    base = args.resume or args.run
    if base is None:
        robot, now = load_robot(args.robot), f"{datetime.now():%Y%m%d-%H%M%S}"
        runs = _of_robot(args.runs, args, robot)
        folders = {text: runs / _course(text, robot).name / now for text in asked}
    else:
        folders = {text: base / text if args.traj == "all" else base for text in asked}
    several = {folder: replace(args, traj=text) for text, folder in folders.items()}
    if args.resume:
        several = {folder: _as_begun(folder, one) for folder, one in several.items()}
    else:
        for folder, one in several.items():
            _asked_for(one, load_robot(args.robot))
            if folder.exists():
                raise ValueError(_taken(folder))
        for folder, one in several.items():
            _begin(folder, one)
    for folder, one in several.items():
        with locked(folder):
            _tune_in(folder, one)


def _asked_for(args: Tune, robot: Robot) -> Course:
    """What a tuning is to walk.

    Raises:
        ValueError: there is no such trajectory, or none that --refresh can take.
    """
    wanted = _course(args.traj, robot)
    if args.refresh and len(wanted.command.duration) > PIECES:
        raise ValueError(
            f"--refresh takes trajectories of at most {PIECES} segments, {wanted.name} has "
            f"{len(wanted.command.duration)}"
        )
    return wanted


def _tune_in(folder: Path, args: Tune) -> None:
    """All of a run, taking up what is in its folder."""
    robot, start = load_robot(args.robot), time.monotonic()
    wanted = _asked_for(args, robot)
    command, lasts = wanted.command, wanted.seconds or Walk.seconds
    shared, shelf = _tuned_as(robot, iterations=args.iterations), folder / "kept"
    config, data = _lasting(shared, wanted), _of_robot(args.data, args, robot)
    made_with = environment()
    commit = made_with.get("commit", "")
    say(f"results go to {folder}")
    with workers(args.processes) as pool:
        net = pipeline.ground(pool, shared, robot, data, args.variant)
        problems = {"without": (command, None), "with": (command, net.params)}
        norms = pipeline.gradient_norms(pool, config, robot, problems)
        if args.alpha == "auto":
            config = replace(config, loss=aligned(config.loss, norms["with"]))
            say(f"loss weights alpha: {config.loss.euler:g} (Euler), {config.loss.position:g}")
        begun = _read_json(folder / "config.json")
        now = {"tune": dataclasses.asdict(config), "net": fingerprint(net.params)}
        _agree(folder, begun, json.loads(as_json(now)))
        resolved = {**begun, **now}
        write_json(folder / "config.json", resolved)
        shifts: list[dict[str, Any]] = []
        journal, dumps = Journal(folder / "metrics.jsonl"), folder / "dumps"
        known = (pool, config, robot)
        title = f"tuning {wanted.name} without and with GRFM-Net"
        tunings = kept.tune(*known, problems, shelf, commit, title, journal, dumps)
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
            tunings |= kept.tune(*known, again, shelf, commit, title, journal, dumps)
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
            _plants("standin", seeds),
            seeds,
            shelf / "standin",
            commit,
            f"judging on {args.seeds} stand-in plants",
            lasts,
        )
        title = "walking on the simulator of the data"
        there = (command, [hfs()], [0], shelf / "hfs")
        on_hfs = kept.judge(*known, sets, *there, commit, title, lasts)
    verdict = _verdict(config.loss, seeds, _scores(judged))
    result = metrics.as_result(verdict)
    told_hfs = metrics.as_result(_verdict(config.loss, [0], _scores(on_hfs)), "hfs")
    for name, found in told_hfs["sets"].items():
        result["sets"][name] |= found
    if shifts:
        result["refresh"] = shifts
    write_json(folder / "result.json", result)
    write_json(folder / "versions.json", made_with | {"seconds": f"{time.monotonic() - start:.0f}"})
    histories = {name: tuned.tuning for name, tuned in tunings.items()}
    walks, sampled = judged.shown, on_hfs.shown["nominal"]
    pictures = _draw(folder, config, robot, net, sets, histories, walks, sampled)
    film: Picture | str = "left out (--no-video)"
    if args.video:
        say("drawing the film")
        pair = {"nominal": walks["nominal"], "tuned with net": walks["with"]}
        caption = "Nominal and tuned weights on the first stand-in plant."
        film = _film(folder / "film.mp4", robot, pair, folder / "film.png") or Picture(
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
            pictures=pictures,
            film=film,
            config=resolved,
            environment=made_with,
            command=as_command("tune", replace(args, run=None, resume=None)),
        ),
    )
    if args.json:
        print(as_json({"run": str(folder), "traj": wanted.name, **result}))
    else:
        print_table(verdict, f"{wanted.name}, {args.seeds} stand-in plants")
    say(f"the whole story, with pictures: {told}")


def _scores(judged: Judged) -> dict[str, list[Score]]:
    return {name: [walk.score for walk in walks] for name, walks in judged.walks.items()}


def _verdict(
    loss: LossConfig, seeds: Sequence[int], scores: Mapping[str, Sequence[Score]]
) -> Verdict:
    verdict = metrics.judge(loss, seeds, scores)
    for name, score in verdict.scores.items():
        if score.residual.max() > SOLVED:
            say(f"{name}: a QP of its walks was not solved (residual {score.residual.max():.0e})")
    return verdict


def _draw(
    folder: Path,
    config: TuneConfig,
    robot: Robot,
    net: pipeline.Learned,
    sets: Mapping[str, Weights],
    tunings: Mapping[str, Tuning],
    walks: Mapping[str, Trajectory],
    sampled: Trajectory,
) -> list[Picture]:
    """All pictures of a run, in the order of the report, from walks at the plan interval."""
    four = {name: walks[name] for name in ("nominal", "expert", "without", "with")}
    flat = {name: np.asarray(weights_to_vector(sets[name])) for name in four}
    histories = {name: tunings[name].history for name in ("without", "with")}
    effects = {"linear": linear_effect(net.linear), "residual": as_effect(net.params)}
    curves = _curves(robot, jax.tree.map(lambda x: np.asarray(x)[None], sampled), effects)
    path = folder / "pictures"
    path.mkdir(exist_ok=True)
    captions = {
        "tracking": plots.tracking(path / "tracking.png", four),
        "path": plots.path_from_above(path / "path.png", four),
        "losses": plots.losses(path / "losses.png", config.loss, histories),
        "weights": plots.weights(path / "weights.png", WEIGHT_NAMES, flat),
        "wrenches": plots.wrenches(path / "wrenches.png", config.rollout.walk.gait.tick, curves),
        "training": plots.training(path / "training.png", net.course),
    }
    return [Picture(f"pictures/{name}.png", caption) for name, caption in captions.items()]


@run.register
def _table(args: Table) -> None:
    told, verdicts = study.make_table(args, partial(_plants, "standin"))
    if args.json:
        results = {name: metrics.as_result(verdict) for name, verdict in verdicts.items()}
        print(as_json({"report": str(told), "trajectories": results}))
    else:
        for name, verdict in verdicts.items():
            print_table(verdict, f"{name}, {len(verdict.seeds)} plants")
    say(f"the whole story, with pictures: {told}")


@run.register
def _search(args: Search) -> None:
    robot = load_robot(args.robot)
    wanted = [_course(text, robot) for text in (COMMANDS if args.traj == "all" else (args.traj,))]
    own = {one.name: one.command for one in wanted}
    config = SearchConfig(args.budget, args.population, args.seed, args.spread)
    engine = pipeline.choose_engine(args.engine)
    tune, start = _lasting(_tuned_as(robot), wanted[0]), _weights(args.start, robot)
    make_folder(args.out)
    with workers(args.processes) as pool:
        found = pipeline.search(
            pool,
            config,
            tune,
            robot,
            dict.fromkeys(own, start),
            engine,
            args.record or args.out,
            own,
        )
        say("walking start, expert and the best once more")
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
            "engine": engine,
            "rollout": dataclasses.asdict(tune.rollout),
            "loss": dataclasses.asdict(tune.loss),
            "versions": versions(),
        }
        save_weights(args.out / f"{name}.json", one.weights)
        write_json(args.out / f"{name}-card.json", cards[name])
    if args.json:
        print(as_json({"weights": str(args.out), "cards": cards}))
    else:
        print("L in 1e6 on the high-fidelity simulator")
        print(f"{'':10s}{'start':>9s}{'best':>9s}{'expert':>9s}{'walks':>8s}{'best at':>9s}")
        for name, card in cards.items():
            shown = "".join(f"{card['L'][x] / 1e6:9.3f}" for x in ("start", "best", "expert"))
            print(f"{name:10s}{shown}{card['walks']:8d}{card['best_at']:9d}")
    say(f"weights are in {args.out}")


@run.register
def _evaluate(args: Evaluate) -> None:
    robot = load_robot(args.robot)
    wanted = _course(args.traj, robot)
    seconds = _seconds(args.seconds, wanted)
    # ideal and hfs are one plant each, without chance
    count = args.seeds if args.world in ("standin", "hfs-varied") else 1
    seeds = range(args.first_seed, args.first_seed + count)
    sets = {text: _weights(text, robot) for text in args.weights}
    plants = _plants(args.world, seeds)
    with workers(args.processes) as pool:
        title = f"judging on {args.world}, {count} plants"
        walks = pipeline.judge(
            pool, _tuned_as(robot), robot, sets, wanted.command, plants, seeds, title, seconds
        )
    scores = {n: [metrics.score(LossConfig(), walk) for walk in each] for n, each in walks.items()}
    verdict = _verdict(LossConfig(), seeds, scores)
    if args.json:
        print(as_json(metrics.as_result(verdict, args.world)))
    else:
        print_table(verdict, f"{wanted.name}, {count} plants", args.world)


@run.register
def _walk(args: Walk) -> None:
    robot = load_robot(args.robot)
    weights, wanted = _weights(args.weights, robot), _course(args.traj, robot)
    say("compiling (only the first time on a machine) and walking")
    trajectory = _walked(args, robot, wanted, weights)
    found = metrics.score(LossConfig(), trajectory)
    upright = float(trajectory.period * np.sum(~np.asarray(trajectory.fallen)))
    if args.out is not None:
        save_tree(args.out, trajectory, kind="trajectory", robot=robot, about=settings(args))
    if args.json:
        losses = {part: float(getattr(found, part)) for part in metrics.PARTS}
        errors = {name: getattr(found, name).tolist() for name in ("rms_position", "rms_euler")}
        told = {"seconds": upright, "fell": bool(found.fallen), **losses, **errors}
        print(as_json(told))  # a walk that falls at once has no errors
    else:
        print(
            f"{wanted.name} in {args.world}, {args.weights} weights: "
            + (f"fell after {upright:.2f} s" if found.fallen else f"walked {upright:.2f} s")
            + f"; L {found.L / 1e6:.3f}e6 (L_Eul {found.L_Eul:.2f} rad^2, "
            f"L_pos {found.L_pos:.2f} m^2, L_ctrl {found.L_ctrl / 1e6:.3f}e6)"
        )
        cm, degrees = 100 * found.rms_position, np.degrees(found.rms_euler)
        print("RMS error: x {:.1f}, y {:.1f}, z {:.1f} cm; ".format(*cm), end="")
        print("roll {:.1f}, pitch {:.1f}, yaw {:.1f} degrees".format(*degrees))
    if args.video is not None:
        beside, other = ("nominal", nominal) if args.weights != "nominal" else ("expert", expert)
        _film(
            args.video,
            robot,
            {beside: _walked(args, robot, wanted, other(robot)), args.weights: trajectory},
        )


def _walked(args: Walk | View, robot: Robot, wanted: Course, weights: Weights) -> Trajectory:
    """One walk in the world of the flags."""
    seconds = _seconds(args.seconds, wanted)
    if args.world == "srbm":
        return pipeline.walk_rigid_body(robot, weights, wanted.command, seconds)
    plant = _plants(args.world, range(args.seed, args.seed + 1))[0]
    return walk(walk_config(robot), robot, weights, wanted.command, plant, seconds, args.seed)


def _film(
    path: Path, robot: Robot, walks: Mapping[str, Trajectory], strip: Path | None = None
) -> str:
    """Film two walks. A missing back end costs one line, not the run; returns why there is none."""
    try:
        write_video(path, robot, walks, strip)
    except VideoUnavailable as error:
        say(str(error))
        return str(error)
    return ""


@run.register
def _doctor(args: Doctor) -> None:
    told, faults = doctor.examine()
    if args.json:
        print(as_json({**told, "faults": faults}))
    else:
        for name, text in told.items():
            print(f"{name:12s} {text}")
    if faults:
        raise Broken("; ".join(faults))


@run.register
def _compare(args: Compare) -> None:
    told = runs.compare_runs([runs.load_run(folder) for folder in args.runs])
    if args.json:
        print(as_json(told))
    else:
        runs.print_comparison(told)


@run.register
def _tensorboard(args: Tensorboard) -> None:
    out = args.out or args.run / "tensorboard"
    write_events(args.run, out)
    print(f"tensorboard --logdir {shlex.quote(str(out))}")


@run.register
def _export(args: Export) -> None:
    # before the first array: see hector_jax.export
    jax.config.update("jax_platforms", "cpu")
    command = named_command(args.traj)
    path, config, robot = export.find_weights(args.run, args.set)
    weights, name = load_weights(path), f"{args.run.name}/{path.stem}"
    folder = args.out or (args.run if args.run.is_dir() else args.run.parent) / "export"
    say("exporting, walking once and asking both controllers")
    known = (config, load_robot(robot), weights, command, folder)
    card = export.export(*known, name=name, seconds=args.seconds)
    if args.json:
        print(as_json(card))
        return
    found = card["check"]
    differences = "{force:.1e} N, {moment:.1e} N m, {torque:.1e} N m at the joints"
    print(f"largest difference from the live controller: {differences.format(**found)}")
    for what, text in (("plan_ms", "with a plan"), ("hold_ms", "between plans")):
        times = "p50 {p50:.2f}, p99 {p99:.2f}, max {max:.2f}; CPU {cpu_p50:.2f}, {cpu_p99:.2f}"
        print(f"a call {text} [ms]: {times.format(**found[what])}")
    say(f"all of it is in {folder}")


@run.register
def _view(args: View) -> None:
    beside = args.run.with_name(f"{args.run.name}-view")
    folder = args.out or (beside if args.headless else None)
    if folder is None:
        view.check_viser()
    if args.seconds < 0.1:
        raise ValueError(f"--seconds must be at least 0.1 to be looked at, got {args.seconds}")
    if args.sets[0] == args.sets[1]:
        raise ValueError(f"--sets must name two different weight sets, got {args.sets[0]} twice")
    asked = progress.read_asked(args.run)
    robot = load_robot(asked.robot)
    wanted = _course(asked.trajectory, robot)
    if folder is not None:
        if folder.resolve() == args.run.resolve():
            raise ValueError(f"--out must not be the folder of the run, got {folder}")
        make_folder(folder)
    sets = {name: progress.weights_of(args.run, name, robot) for name in args.sets}
    data = _of_robot(args.data or asked.data, asked, robot)
    effect = _phi_of(data, asked.variant, robot)
    story = [f"**{asked.trajectory}** in {WORLDS.get(args.world, args.world)}, seed {args.seed}"]
    shown: dict[str, view.Shown] = {}
    say(f"walking anew in {args.world}, seed {args.seed}")
    for when, (name, (weights, told)) in zip(("before", "after"), sets.items(), strict=True):
        walked = _walked(args, robot, wanted, weights)
        loss = metrics.score(asked.loss, walked).L / 1e6
        story.append(f"{when}: {told}, L {loss:.3f}e6 in this walk")
        say(f"  {story[-1]}")
        walked = at_interval(walked, walk_config(robot).gait.tick)
        stacked = jax.tree.map(lambda x: np.asarray(x)[None], walked)
        effects = {} if effect is None else {"residual": effect}
        curves = _curves(robot, stacked, effects)
        shown[name] = view.Shown(walked, curves)
    model = compile_model(robot.description)
    motions = [view.motion(robot, model, one) for one in shown.values()]
    if folder is not None:
        histories = progress.read_metrics(args.run)
        _draw_view(folder, robot, histories, asked.loss, shown, view.film_arrows(motions))
        say(f"film and pictures are in {folder}")
        return
    view.serve(
        dict(zip(_titles(shown), motions, strict=True)),
        model,
        args.run,
        "\n\n".join(story),
        lambda address: say(f"open {address} in a browser; Ctrl-C ends it"),
        args.host,
        args.port,
    )


def _phi_of(data: Path, variant: str, robot: Robot) -> jax.tree_util.Partial | None:
    """Phi of the net that is kept under `data`; where there is none, a line says so."""
    path = pipeline.net_path(data, variant)
    if not path.exists():
        say(f"no net at {path}, so none of its predictions; --data names another folder")
        return None
    return as_effect(load_net(path, robot, variant)[0])


def _titles(names: Iterable[str]) -> list[str]:
    return [f"{when}: {name}" for when, name in zip(("before", "after"), names, strict=True)]


def _draw_view(
    folder: Path,
    robot: Robot,
    histories: progress.Histories,
    loss: LossConfig,
    shown: Mapping[str, view.Shown],
    arrows: Sequence[Arrows],
) -> None:
    """What the page shows, as a film and pictures."""
    walks = {name: one.walk for name, one in shown.items()}
    plots.tracking(folder / "tracking.png", walks)
    plots.path_from_above(folder / "path.png", walks)
    after = list(shown.values())[-1]
    period, ticks = float(after.walk.period), len(after.walk.fallen)
    first = min(0.4, period * ticks)  # [s], two steps
    plots.wrenches(folder / "wrenches.png", period, after.ground, seconds=first)
    tuned = {name: histories[name] for name in ("without", "with") if histories.get(name)}
    if tuned:
        plots.losses(folder / "losses.png", loss, tuned)
    say("drawing the film")
    try:
        titled = dict(zip(_titles(walks), walks.values(), strict=True))
        write_video(folder / "film.mp4", robot, titled, folder / "film.png", arrows=arrows)
    except VideoUnavailable as error:
        raise ValueError(str(error)) from None


@run.register
def _replay(args: Replay) -> None:
    found = replay.again(args.dump)
    print(as_json(found._asdict(), indent=2) if args.json else replay.in_words(found))
    if not found.same:
        raise Broken(f"{args.dump}: {replay.verdict(found)}")
