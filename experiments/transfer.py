"""Does the model's gradient point where the better simulator's does?

Gradients of L in log-weights on the rigid body, through several phi (the command itself, a linear
map, the paper's GRFM-Net, the default one with and without its legs part), against central
differences on the high-fidelity simulator (hfs); and the order in which model and hfs put
disturbed weight sets. The feet share one R: 18 directions.

    python experiments/transfer.py --data data --out runs/transfer

Walks on the hfs are stored under OUT/hfs and used by a later call: walked by MuJoCo C on the
processes, or all at once in MJX where JAX sees an accelerator. Another controller (--effort-about,
--stance-weight) has nets of its own: name a DATA folder for it, and what is missing there is
collected with that controller and trained. With data of another controller, only the command itself
is compared.

    python experiments/transfer.py --effort-about weight --data data-weight --out runs/weight
"""

import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import alignment
import jax
import lib
import numpy as np
import plots
import tyro
from lib import check_names, sample_weights, write_report

from hector_jax.control.controller import WalkConfig
from hector_jax.control.legs import LegConfig
from hector_jax.control.mpc import MpcConfig
from hector_jax.control.reference import COMMANDS, Command, named_command, standing_anchor
from hector_jax.control.weights import (
    Weights,
    direction_names,
    expert,
    nominal,
    scale_weights,
)
from hector_jax.control.weights_file import load_weights
from hector_jax.core.console import bar, exit_code, say
from hector_jax.core.environment import environment
from hector_jax.core.files import make_folder
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.trajectory import Load, Trajectory
from hector_jax.grfm.collection import fingerprint
from hector_jax.grfm.effect import Effect, Window, last_command
from hector_jax.grfm.network import Params, as_effect
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.engine import choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs
from hector_jax.store import nets, tunings
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Problem
from hector_jax.tuning.difftune import TuneConfig, step_status, tune_step
from hector_jax.tuning.loss import PAPER_LOSS, loss_of
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout
from hector_jax.tuning.status import StepStatus

PUBLISHED = {"nominal": nominal, "expert": expert}
SETS = (*PUBLISHED, "tuned")
FACTORS = (1.5, 3.0)  # largest factors of the weight sets of the rank correlation


@dataclass(frozen=True)
class Flags:
    """What to compare."""

    data: Path = Path("data")  # walks and nets; made where missing
    out: Path = Path("runs/transfer")  # folder of the report
    tuned: dict[str, Path] = field(default_factory=dict)  # TRAJ FILE; else tuned here
    trajectories: tuple[str, ...] = COMMANDS
    sets: tuple[str, ...] = SETS
    phases: tuple[int, ...] = (0, 10, 20, 30)  # gait ticks at which the command starts
    lead: int = 40  # ticks in place before t = 0 on the model, beside none
    ranks: int = 64  # weight sets for each rank correlation; 0 leaves them out
    about: Path | None = None  # weights about which these are drawn; nominal by default
    effort_about: Literal["zero", "weight"] = "zero"  # MpcConfig.effort_reference
    stance_weight: bool = False  # LegConfig.gravity_compensation
    processes: int = 2  # one core each

    def __post_init__(self) -> None:
        if not self.sets:
            raise InputError(f"Flags.sets must name one at least of {', '.join(SETS)}, got none")
        check_names("sets", self.sets, SETS)
        check_names("tuned", self.tuned, self.trajectories)


class Walked(NamedTuple):
    """Stored results of walks on the hfs."""

    loss: np.ndarray
    fallen: np.ndarray
    residual: np.ndarray  # largest of a plan


class Result(NamedTuple):
    """All numbers of the report.

    Gradients are (sets, trajectories, phases, 18), losses of sampled weight sets (trajectories,
    factors, sets, phases); those of the model are by phi.
    """

    engine: str  # of the walks on the hfs
    walked: Mapping[str, Walked]  # walks on the hfs, by group
    truth: np.ndarray  # gradients on the hfs
    gradients: Mapping[str, np.ndarray]
    hfs_losses: np.ndarray
    losses: Mapping[str, np.ndarray]


class Point(NamedTuple):
    """Point of evaluation of a gradient or a loss."""

    weights: Weights
    command: Command
    tick: int  # of t = 0


def _without_legs(effect: jax.tree_util.Partial, window: Window) -> Effect:
    loads = effect(window)
    return loads._replace(legs=Load(*(0.0 * part for part in loads.legs)))


def phis(
    pool: Executor, config: TuneConfig, robot: Robot, data: Path
) -> tuple[dict, Params | None]:
    """Return each phi by name, and the parameters of the default net; None for other data."""
    walks = data / "walks"
    effects = {"command": last_command}
    if (walks / "card.json").exists():
        if fingerprint(walks).get("controller") != repr(config.rollout.walk):
            say(
                f"{walks}: walked by another controller; only the command itself is compared. "
                "A --data folder of its own gives this one nets"
            )
            return effects, None
    net, paper = (nets.load_or_train(pool, robot, data, name) for name in ("residual", "paper"))
    default = as_effect(net.params)
    effects |= {
        "linear": as_effect(net.linear),
        "paper": as_effect(paper.params),
        "net": default,
        "net without legs": jax.tree_util.Partial(_without_legs, default),
    }
    host = partial(jax.tree.map, np.asarray)  # inputs of a process must not be on a device
    return {name: host(effect) for name, effect in effects.items()}, net.params


def tuned_sets(
    pool: Executor,
    flags: Flags,
    config: TuneConfig,
    robot: Robot,
    params: Params | None,
    loaded: Mapping[str, Weights],
) -> dict[str, Weights]:
    """Return tuned weights by trajectory; tune if necessary."""
    problems = {
        name: Problem((named_command(name),), params)
        for name in flags.trajectories
        if name not in loaded
    }
    setup = Setup(pool, config, robot, environment().get("commit", ""))
    results = tunings.tune_all(setup, problems, flags.out, title="tuning")
    return {**loaded, **{name: tuned.tuning.weights for name, tuned in results.items()}}


def _walked(walk: Trajectory) -> Walked:
    loss = loss_of(PAPER_LOSS, walk)
    return Walked(np.asarray(loss), walk.fallen.any(), walk.residual.max())


def walk_groups(
    pool: Executor,
    config: WalkConfig,
    robot: Robot,
    groups: Mapping[str, Sequence[Job]],
    folder: Path,
) -> tuple[dict[str, Walked], str]:
    """Walk groups of jobs on the hfs; returns the results and the engine. Groups are cached."""
    engine = choose_engine("auto")
    walked = lib.walk_groups(
        groups,
        partial(engine.walk, pool, config, robot),
        _walked,
        like=Walked(np.zeros(0), np.zeros(0), np.zeros(0)),
        kind="transfer",
        robot=robot,
        folder=folder,
        settings=(config, repr(PAPER_LOSS), engine.name),
        title=f" on the high-fidelity simulator, engine {engine.name}",
    )
    return walked, engine.name


def gradient_jobs(point: Point, phases: Sequence[int]) -> list[Job]:
    """Return the walks of the gradients at a weight set: by phase, direction and side."""
    steps = alignment.STEP * np.eye(len(direction_names()))
    return [
        Job(
            jax.device_get(scale_weights(point.weights, side * step)),
            point.command,
            hfs(),
            start_tick=phase,
        )
        for phase in phases
        for step in steps
        for side in (1, -1)
    ]


@partial(jax.jit, static_argnums=0)
def _model_loss(config: TuneConfig, scenario: Scenario, weights: Weights) -> jax.Array:
    return loss_of(config.loss, rollout(config.rollout, scenario, weights))


def _model_job(
    config: TuneConfig,
    robot: Robot,
    effect: jax.tree_util.Partial,
    points: Sequence[Point],
    others: Sequence[Point],
) -> tuple[np.ndarray, np.ndarray]:
    """Compute gradients at points, NaN if rejected, and losses at others; in a worker."""
    rows = []
    for weights, command, tick in points:
        scenario = Scenario(robot, command, standing_anchor(robot, tick), effect)
        evaluation = jax.device_get(tune_step(config, scenario, weights))
        row = alignment.as_directions(weights, evaluation.gradient)
        accepted = step_status(config, evaluation) == StepStatus.ACCEPTED
        rows.append(np.where(accepted, row, np.nan))
    losses = [
        float(
            _model_loss(
                config, Scenario(robot, command, standing_anchor(robot, tick), effect), weights
            )
        )
        for weights, command, tick in others
    ]
    return np.array(rows), np.array(losses)


def measure(flags: Flags, loaded: Mapping[str, Weights], center: Weights) -> Result:
    """Evaluate gradients and losses on the model and on the hfs.

    Args:
        flags: what to compare.
        loaded: tuned weights by trajectory; those of other trajectories are tuned here.
        center: weights about which the sets of the rank correlations are drawn.
    """
    robot = jax.tree.map(np.asarray, load_robot())
    walk = WalkConfig(
        mpc=MpcConfig(effort_reference="gravity" if flags.effort_about == "weight" else "zero"),
        legs=LegConfig(gravity_compensation=flags.stance_weight),
    )
    configs = {
        f", lead {lead}" if lead else "": TuneConfig(rollout=RolloutConfig(walk=walk, lead=lead))
        for lead in sorted({0, flags.lead})
    }
    commands = {name: named_command(name) for name in flags.trajectories}
    sampled = {
        f"ranks-{name}-{factor:g}": [
            Point(weights, command, tick)
            for weights in sample_weights(center, factor, flags.ranks)
            for tick in flags.phases
        ]
        for name, command in commands.items()
        for factor in FACTORS
        if flags.ranks
    }
    with workers(flags.processes) as pool:
        effects, params = phis(pool, configs[""], robot, flags.data)
        sets = {which: dict.fromkeys(commands, w()) for which, w in PUBLISHED.items()}
        if "tuned" in flags.sets:
            sets["tuned"] = tuned_sets(pool, flags, configs[""], robot, params, loaded)
        starts = {
            f"{which}-{name}": Point(sets[which][name], command, 0)
            for which in flags.sets
            for name, command in commands.items()
        }
        groups = {key: gradient_jobs(start, flags.phases) for key, start in starts.items()}
        for key, points in sampled.items():
            groups[key] = [Job(p.weights, p.command, hfs(), start_tick=p.tick) for p in points]
        anchored = [start._replace(tick=tick) for start in starts.values() for tick in flags.phases]
        others = [point for points in sampled.values() for point in points]
        # An accelerator walks while the processes differentiate; without one the walks come after.
        running = {
            name + ending: pool.submit(_model_job, config, robot, effect, anchored, others)
            for ending, config in configs.items()
            for name, effect in effects.items()
        }
        walked, engine = walk_groups(pool, walk, robot, groups, flags.out / "hfs")
        with bar("gradients on the rigid body") as report_progress:
            for done, _ in enumerate(as_completed(running.values()), 1):
                report_progress(done, len(running), "")
    shape = len(flags.sets), len(commands), len(flags.phases)
    losses = [np.where(walked[key].fallen, np.nan, walked[key].loss) for key in starts]
    clouds = len(commands), len(FACTORS), flags.ranks, len(flags.phases)
    return Result(
        engine,
        walked,
        truth=alignment.slopes(np.reshape(losses, (*shape, -1, 2))),
        gradients={kind: job.result()[0].reshape(*shape, -1) for kind, job in running.items()},
        hfs_losses=np.reshape([walked[key].loss for key in sampled], clouds),
        losses={kind: job.result()[1].reshape(clouds) for kind, job in running.items()},
    )


def compare_gradients(flags: Flags, result: Result) -> dict[str, alignment.Rows]:
    """Return the rows of the report's tables by weight set, then by trajectory and phi."""
    rows = {}
    for i, which in enumerate(flags.sets):
        rows[which] = {}
        for j, name in enumerate(flags.trajectories):
            for kind, gradients in result.gradients.items():
                plain, comma, lead = kind.partition(",")
                base = result.gradients[f"command{comma}{lead}"][i, j]
                rows[which][name, kind] = alignment.compare(
                    gradients[i, j], None if plain == "command" else base, result.truth[i, j]
                )
    return rows


def compare_orders(flags: Flags, result: Result) -> dict[tuple[str, str], dict[str, float]]:
    """Return rank correlations by trajectory and phi, then by factor."""
    pairs = {kind: (losses, result.hfs_losses) for kind, losses in result.losses.items()}
    if len(flags.phases) > 1:  # agreement of the simulator with itself
        pairs["hfs, other phases"] = result.hfs_losses[..., ::2], result.hfs_losses[..., 1::2]
    return {
        (name, kind): {
            f"{factor:g}": alignment.rank_correlation(a[i, j].mean(axis=-1), b[i, j].mean(axis=-1))
            for j, factor in enumerate(FACTORS)
        }
        for i, name in enumerate(flags.trajectories)
        for kind, (a, b) in pairs.items()
        if flags.ranks
    }


def report(flags: Flags, result: Result) -> Path:
    """Write the report with its pictures and its numbers as JSON; returns its path."""
    rows, ranks = compare_gradients(flags, result), compare_orders(flags, result)
    fell = {name: int(w.fallen.sum()) for name, w in result.walked.items() if w.fallen.any()}
    residual = max(float(walks.residual.max()) for walks in result.walked.values())
    paragraphs = _introduction(flags, result, fell, residual)
    for which, set_rows in rows.items():
        paragraphs += [f"## {which.capitalize()} weights"]
        paragraphs += [alignment.summary(set_rows, "net")] if "net" in result.gradients else []
        sentences = [
            f"- {alignment.wrong_sentence(name, kind, row)}"
            for (name, kind), row in set_rows.items()
            if row is not None and kind in ("command", "net")
        ]
        paragraphs += [alignment.gradient_table(set_rows), "\n".join(sentences)]
    if ranks:
        paragraphs += [
            "## Order of weight sets",
            f"Spearman's rank correlation of L on the model and on the hfs over {flags.ranks} "
            f"weight sets, drawn log-uniformly about {flags.about or 'nominal'}, each loss the "
            "mean over the start phases; a fall counts as the loss charges it. `hfs, other phases` "
            "is the correlation of the simulator with itself, every other phase against the rest.",
            alignment.rank_table(ranks),
        ]
    numbers = {
        "flags": {k: v for k, v in vars(flags).items() if not isinstance(v, Path | dict)},
        "engine": result.engine,
        "weights": direction_names(),
        "rows": {
            which: {": ".join(key): alignment.as_result(row) for key, row in set_rows.items()}
            for which, set_rows in rows.items()
        },
        "ranks": {": ".join(key): row for key, row in ranks.items()},
        "fell": fell,
        "residual": residual,
        "gradients": {
            f"{which}: {name}": {
                kind: gradients[i, j].tolist()
                for kind, gradients in {"hfs": result.truth, **result.gradients}.items()
            }
            for i, which in enumerate(flags.sets)
            for j, name in enumerate(flags.trajectories)
        },
    }
    return write_report(
        flags.out / "report.md",
        "Does the gradient transfer?",
        [*paragraphs, "## Pictures"],
        numbers=numbers,
        json_name="transfer.json",
        pictures=_draw(flags, result, ranks),
    )


def _introduction(
    flags: Flags, result: Result, fell: Mapping[str, int], residual: float
) -> list[str]:
    falls = ", ".join(f"{name} {count}" for name, count in fell.items())
    falls += " (phases with a fall are left out of the gradients)" if fell else "none"
    count = sum(len(walks.loss) for walks in result.walked.values())
    return [
        f"The model's gradient of L in 18 log-weights against that of the high-fidelity simulator: "
        f"central differences of +-5 %, mean over the start phases (gait ticks "
        f"{', '.join(map(str, flags.phases))}). Controller: effort priced about "
        f"{flags.effort_about}, leg weight in the stance torque "
        f"{'on' if flags.stance_weight else 'off'}. {count} walks, engine {result.engine}; worst "
        f"relative KKT residual {residual:.0e}; falls: {falls}.",
        "Brackets are 95 % intervals from redrawing the start phases, the same ones for model and "
        f"simulator. There are {len(flags.phases)}: with so few the intervals are rough, rather "
        "too narrow (of one phase there is none), and say nothing of other commands or plants.",
        "`command` is the plain rigid body; `lead` counts ticks that the model walks in place "
        "before t = 0. `most wrong` names the weight whose entry differs most between the two unit "
        "gradients, and its share of their squared distance.",
    ]


def _draw(
    flags: Flags, result: Result, ranks: Mapping[tuple[str, str], Mapping[str, float]]
) -> dict[str, str]:
    """Draw the pictures, all without lead; returns their captions by name."""
    plain = [kind for kind in result.gradients if "," not in kind]
    captions = {}
    for j, name in enumerate(flags.trajectories):
        simulator = result.truth[0, j]
        models = {kind: result.gradients[kind][0, j] for kind in plain}
        finite = np.isfinite(simulator + sum(models.values())).all(axis=1)
        if finite.any():
            file = f"gradients-{name}.png"
            models = {kind: rows[finite] for kind, rows in models.items()}
            caption = plots.gradients(
                flags.out / file, direction_names(), simulator[finite], models
            )
            captions[file] = f"{name}, {flags.sets[0]} weights. {caption}"
    if ranks:
        keys = [(name, f"{factor:g}") for name in flags.trajectories for factor in FACTORS]

        def by_key(losses: np.ndarray) -> dict[tuple[str, str], np.ndarray]:
            return dict(zip(keys, losses.mean(axis=-1).reshape(len(keys), -1), strict=True))

        model = {kind: by_key(result.losses[kind]) for kind in plain}
        captions["ranks.png"] = plots.ranks(
            flags.out / "ranks.png",
            by_key(result.hfs_losses),
            {key: {kind: model[kind][key] for kind in plain} for key in keys},
            {key: {kind: ranks[key[0], kind][key[1]] for kind in plain} for key in keys},
        )
    return captions


def main() -> None:
    """Write report.md, transfer.json and the pictures."""
    flags = tyro.cli(Flags)
    setup_jax()
    loaded = {name: load_weights(path) for name, path in flags.tuned.items()}
    center = load_weights(flags.about) if flags.about else nominal()
    make_folder(flags.out)
    print(report(flags, measure(flags, loaded, center)))


if __name__ == "__main__":
    sys.exit(exit_code("transfer", main))
