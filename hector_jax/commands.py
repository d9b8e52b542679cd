"""What each command of `hector` does with its flags (flags.py)."""

import dataclasses
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from datetime import datetime
from functools import partial, singledispatch
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hector_jax import pipeline, study
from hector_jax.console import say
from hector_jax.control.reference import COMMANDS, named_command, standing_anchor
from hector_jax.control.walking import WalkConfig, walk_config
from hector_jax.control.weights import WEIGHT_NAMES, Weights, expert, nominal, weights_to_vector
from hector_jax.evaluation import fidelity, metrics, plots
from hector_jax.evaluation.metrics import Verdict
from hector_jax.evaluation.report import (
    WORLDS,
    Picture,
    Report,
    environment,
    print_table,
    write_fidelity,
    write_report,
)
from hector_jax.evaluation.video import VideoUnavailable, write_video
from hector_jax.flags import (
    Collect,
    Doctor,
    Evaluate,
    Grfm,
    Search,
    Table,
    Train,
    Tune,
    Walk,
    as_command,
    settings,
)
from hector_jax.grfm import training
from hector_jax.grfm.dataset import SOLVED, Walks, at_interval, make_dataset
from hector_jax.grfm.gated import gated_effect
from hector_jax.grfm.network import as_effect, linear_effect
from hector_jax.grfm.training import TrainConfig, predict
from hector_jax.model.effect import last_command
from hector_jax.robot import Robot, load_robot
from hector_jax.runtime import cache_folder, workers
from hector_jax.sim.standin import standin
from hector_jax.sim.walk import Job, walk
from hector_jax.sim.world import Imperfections, hfs, named_world
from hector_jax.storage import (
    as_json,
    load_weights,
    make_folder,
    save_tree,
    save_weights,
    versions,
    write_json,
)
from hector_jax.trajectory import Trajectory, Wrench
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Iteration, TuneConfig, Tuning, aligned
from hector_jax.tuning.loss import LossConfig
from hector_jax.tuning.rollout import RolloutConfig, rollout
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
    return named[text](robot) if text in named else load_weights(Path(text))


def _tuned_as(robot: Robot, **settings: Any) -> TuneConfig:
    """Settings of a tuning, with the controller that the robot's description asks for."""
    return TuneConfig(rollout=RolloutConfig(walk=walk_config(robot)), **settings)


def _of_robot(folder: Path, args: Any, robot: Robot) -> Path:
    """Another robot than the packaged one has a folder of its own in there."""
    return folder if args.robot is None else folder / robot.description.name


def _plants(world: str, seeds: range) -> list[Imperfections]:
    if world == "standin":
        return [standin(seed) for seed in seeds]
    try:
        return [named_world(world, seed) for seed in seeds]
    except ValueError as error:
        raise ValueError(f"{error}, standin (for `walk` also srbm)") from None


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
    for name, errors in found.errors.items():
        print(
            f"{name:7s} force {errors['force']:8.2f} N^2   moment {errors['moment']:7.4f} (N m)^2"
            "   (held-out walks)"
        )
    say(f"the net is in {path}")


@run.register
def _grfm(args: Grfm) -> None:
    robot, config = load_robot(), TuneConfig()
    if args.seeds < 0:
        raise ValueError(f"--seeds must be at least 0, got {args.seeds}")
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
    for name, errors in found["hfs"]["errors"].items():
        print(
            f"{name:9s} force {errors['force']:8.2f} N^2   moment {errors['moment']:7.4f} (N m)^2"
        )
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


def _taken(folder: Path) -> str:
    return f"run folder {folder} exists; name another by --run, nothing was touched"


def _new_folder(args: Tune, robot: Robot) -> Path:
    """The run's folder, made here; an existing one is never written into."""
    runs = _of_robot(args.runs, args, robot)
    folder = args.run or runs / args.traj / f"{datetime.now():%Y%m%d-%H%M%S}"
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise ValueError(_taken(folder)) from None
    return folder


@run.register
def _tune(args: Tune) -> None:
    if args.traj == "all":
        several = [replace(args, traj=name, run=args.run and args.run / name) for name in COMMANDS]
        for one in several:
            if one.run is not None and one.run.exists():
                raise ValueError(_taken(one.run))
        for one in several:
            run(one)
        return
    command, robot = named_command(args.traj), load_robot(args.robot)
    if args.alpha not in ("paper", "auto"):
        raise ValueError(f"--alpha must be 'paper' or 'auto', got {args.alpha!r}")
    least_of = {"seeds": 1, "processes": 1, "iterations": PAPER_ITERATIONS, "refresh": 0}
    for name, least in least_of.items():
        if getattr(args, name) < least:
            raise ValueError(f"--{name} must be at least {least}, got {getattr(args, name)}")
    config, variant = _tuned_as(robot, iterations=args.iterations), args.variant
    TrainConfig(variant)  # refuses an unknown one before a folder is made
    folder, data = _new_folder(args, robot), _of_robot(args.data, args, robot)
    say(f"results go to {folder}")
    with workers(args.processes) as pool:
        net = pipeline.ground(pool, config, robot, data, variant)
        problems = {"without": (command, None), "with": (command, net.params)}
        norms = pipeline.gradient_norms(pool, config, robot, problems)
        if args.alpha == "auto":
            config = replace(config, loss=aligned(config.loss, norms["with"]))
            say(f"loss weights alpha: {config.loss.euler:g} (Euler), {config.loss.position:g}")
        resolved = {"flags": settings(args), "tune": dataclasses.asdict(config)}
        write_json(folder / "config.json", resolved)
        write_json(folder / "versions.json", environment())
        shifts: list[dict[str, Any]] = []
        with (folder / "metrics.jsonl").open("w", buffering=1) as metrics_file:

            def note(name: str, iteration: Iteration) -> None:
                metrics_file.write(pipeline.as_line(name, iteration))

            title = f"tuning {args.traj} without and with GRFM-Net"
            tunings = pipeline.tune_many(pool, config, robot, problems, title, note)
            newest, tuning = net, tunings["with"]
            for count in range(1, args.refresh + 1):
                newest, shift = pipeline.refresh(
                    pool,
                    replace(pipeline.REFRESH, seed=count),
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
                title = f"tuning {args.traj} with the net refreshed"
                tunings |= pipeline.tune_many(pool, config, robot, again, title, note)
                tuning = tunings[name]
        sets = {
            "nominal": nominal(robot),
            "expert": expert(robot),
            **{f"{name}_ten": tunings[name].ten for name in problems},
            **{name: tuning.converged for name, tuning in tunings.items()},
        }
        (folder / "weights").mkdir()
        for name, weights in sets.items():
            save_weights(folder / "weights" / f"{name}.json", weights)
        seeds = range(args.seeds)
        walks = pipeline.judge(
            pool,
            config,
            robot,
            sets,
            command,
            _plants("standin", seeds),
            seeds,
            f"judging on {args.seeds} stand-in plants",
        )
        on_hfs = pipeline.judge(
            pool, config, robot, sets, command, [hfs()], [0], "walking on the simulator of the data"
        )
    verdict = _verdict(config.loss, seeds, walks)
    result = metrics.as_result(verdict)
    for name, found in metrics.as_result(_verdict(config.loss, [0], on_hfs), "hfs")["sets"].items():
        result["sets"][name] |= found
    if shifts:
        result["refresh"] = shifts
    write_json(folder / "result.json", result)
    pictures = _draw(folder, config, robot, net, sets, tunings, walks, on_hfs["nominal"][0])
    film: Picture | str = "left out (--no-video)"
    if args.video:
        say("drawing the film")
        pair = {"nominal": walks["nominal"][0], "tuned with net": walks["with"][0]}
        caption = "Nominal and tuned weights on the first stand-in plant."
        film = _film(folder / "film.mp4", robot, pair, folder / "film.png") or Picture(
            "film.mp4", caption
        )
    told = write_report(
        folder,
        Report(
            trajectory=args.traj,
            verdict=verdict,
            tunings=tunings,
            norms=norms,
            errors=net.errors,
            shifts=shifts,
            pictures=pictures,
            film=film,
            config=resolved,
            environment=environment(),
            command=as_command("tune", replace(args, run=None)),
        ),
    )
    print_table(verdict, f"{args.traj}, {args.seeds} stand-in plants")
    say(f"the whole story, with pictures: {told}")


def _verdict(
    loss: LossConfig, seeds: Sequence[int], walks: Mapping[str, Sequence[Trajectory]]
) -> Verdict:
    scores = {name: [metrics.score(loss, walk) for walk in each] for name, each in walks.items()}
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
    walks: Mapping[str, Sequence[Trajectory]],
    on_hfs: Trajectory,
) -> list[Picture]:
    """All pictures of a run, in the order of the report."""
    four = {name: walks[name][0] for name in ("nominal", "expert", "without", "with")}
    flat = {name: np.asarray(weights_to_vector(sets[name])) for name in four}
    histories = {name: tunings[name].history for name in ("without", "with")}
    sampled = at_interval(on_hfs, config.rollout.walk.gait.tick)
    effects = {"linear": linear_effect(net.linear), "residual": as_effect(net.params)}
    curves = _curves(robot, jax.tree.map(lambda x: np.asarray(x)[None], sampled), effects)
    path = folder / "pictures"
    path.mkdir()
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
    for name, verdict in verdicts.items():
        print_table(verdict, f"{name}, {len(verdict.seeds)} plants")
    say(f"the whole story, with pictures: {told}")


@run.register
def _search(args: Search) -> None:
    names = COMMANDS if args.traj == "all" else (args.traj,)
    for name in names:
        named_command(name)
    config = SearchConfig(args.budget, args.population, args.seed, args.spread)
    engine = pipeline.choose_engine(args.engine)
    robot = load_robot(args.robot)
    tune, start = _tuned_as(robot), _weights(args.start, robot)
    make_folder(args.out)
    with workers(args.processes) as pool:
        found = pipeline.search(
            pool, config, tune, robot, dict.fromkeys(names, start), engine, args.record or args.out
        )
        say("walking start, expert and the best once more")
        sets = {name: [start, expert(robot), found[name].weights] for name in names}
        at_once = config.population * len(names)
        compared = pipeline.losses_on_hfs(pool, tune, robot, engine, sets, at_once)
    print("L in 1e6 on the high-fidelity simulator")
    print(f"{'':10s}{'start':>9s}{'best':>9s}{'expert':>9s}{'walks':>8s}{'best at':>9s}")
    for name, one in found.items():
        at_start, at_expert, again = compared[name].tolist()
        walks = len(one.history) * config.population
        losses = {"start": at_start, "best": one.loss, "best_again": again, "expert": at_expert}
        card = {
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
        write_json(args.out / f"{name}-card.json", card)
        shown = "".join(f"{x / 1e6:9.3f}" for x in (at_start, one.loss, at_expert))
        print(f"{name:10s}{shown}{walks:8d}{one.walk:9d}")
    say(f"weights are in {args.out}")


@run.register
def _evaluate(args: Evaluate) -> None:
    command, robot = named_command(args.traj), load_robot(args.robot)
    config = _tuned_as(robot)
    _check_seconds(args.seconds)
    # ideal and hfs are one plant each, without chance
    count = args.seeds if args.world in ("standin", "hfs-varied") else 1
    seeds = range(args.first_seed, args.first_seed + count)
    sets = {text: _weights(text, robot) for text in args.weights}
    plants = _plants(args.world, seeds)
    with workers(args.processes) as pool:
        title = f"judging on {args.world}, {count} plants"
        walks = pipeline.judge(
            pool, config, robot, sets, command, plants, seeds, title, args.seconds
        )
    verdict = _verdict(LossConfig(), seeds, walks)
    if args.json:
        print(as_json(metrics.as_result(verdict, args.world)))
    else:
        print_table(verdict, f"{args.traj}, {count} plants", args.world)


def _check_seconds(seconds: float) -> None:
    if not 0.0 < seconds <= 600.0:
        raise ValueError(f"--seconds must be above 0 and at most 600, got {seconds}")


@run.register
def _walk(args: Walk) -> None:
    command, robot = named_command(args.traj), load_robot(args.robot)
    weights, config = _weights(args.weights, robot), walk_config(robot)
    _check_seconds(args.seconds)

    def walked(weights: Weights) -> Trajectory:
        if args.world == "srbm":
            return _rigid_body(robot, weights, command, args.seconds)
        plant = _plants(args.world, range(args.seed, args.seed + 1))[0]
        return walk(config, robot, weights, command, plant, args.seconds, args.seed)

    say("compiling (only the first time on a machine) and walking")
    trajectory = walked(weights)
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
            f"{args.traj} in {args.world}, {args.weights} weights: "
            + (f"fell after {upright:.2f} s" if found.fallen else f"walked {upright:.2f} s")
            + f"; L {found.L / 1e6:.3f}e6 (L_Eul {found.L_Eul:.2f} rad^2, "
            f"L_pos {found.L_pos:.2f} m^2, L_ctrl {found.L_ctrl / 1e6:.3f}e6)"
        )
        cm, degrees = 100 * found.rms_position, np.degrees(found.rms_euler)
        print("RMS error: x {:.1f}, y {:.1f}, z {:.1f} cm; ".format(*cm), end="")
        print("roll {:.1f}, pitch {:.1f}, yaw {:.1f} degrees".format(*degrees))
    if args.video is not None:
        beside, other = ("nominal", nominal) if args.weights != "nominal" else ("expert", expert)
        _film(args.video, robot, {beside: walked(other(robot)), args.weights: trajectory})


def _rigid_body(robot: Robot, weights: Weights, command: Any, seconds: float) -> Trajectory:
    controller = walk_config(robot)
    config = RolloutConfig(controller, ticks=round(seconds / controller.gait.tick))
    walked = jax.jit(rollout, static_argnums=0)
    anchor = standing_anchor(robot)
    return jax.device_get(walked(config, robot, weights, command, anchor, last_command))


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
    rows = {
        **versions(),
        "device": ", ".join(str(device) for device in jax.devices()),
        "precision": f"{64 if jax.config.read('jax_enable_x64') else 32} bits",
        "cache": str(cache_folder()),
    }
    for name, text in rows.items():
        print(f"{name:12s} {text}")
    start = time.monotonic()
    robot, command = load_robot(), named_command("straight")
    walks = {
        "srbm": _rigid_body(robot, expert(), command, 1.0),
        "ideal": walk(WalkConfig(), robot, expert(), command, _plants("ideal", range(1))[0], 0.2),
    }
    for world, found in walks.items():
        if found.fallen.any() or not found.residual.max() <= SOLVED:
            raise ValueError(f"self-test failed: the robot does not walk in {world}")
    print(f"{'self-test':12s} walks in {' and '.join(walks)}: {time.monotonic() - start:.1f} s")
    with tempfile.TemporaryDirectory() as folder:
        short = {name: walks["ideal"] for name in ("one", "other")}
        missing = _film(Path(folder) / "film.mp4", robot, short)
    print(f"{'video':12s} {missing or 'works'}")
