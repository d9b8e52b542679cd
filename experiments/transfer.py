"""Does the model's gradient point where the better simulator's does?

Gradients of L in log-weights on the rigid body, through several phi (the command itself, a linear
map, the paper's GRFM-Net, the default one with and without its legs part), against central
differences on the high-fidelity simulator (hfs); and the order in which model and hfs put
disturbed weight sets. The feet share one R: 18 directions.

    python experiments/transfer.py --data data --out runs/transfer

Walks on the hfs are kept under OUT/hfs and taken up again: by MuJoCo C on the processes, or all at
once in MJX where JAX sees an accelerator. Another controller (--effort-about, --stance-weight) has
nets of its own: name a DATA folder for it, and what is missing there is collected with that
controller and trained. Over data that another one walked, the command alone is compared.

    python experiments/transfer.py --effort-about weight --data data-weight --out runs/weight
"""

import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import tyro

from hector_jax.control.legs import LegConfig
from hector_jax.control.mpc import MpcConfig
from hector_jax.control.reference import COMMANDS, Command, named_command, standing_anchor
from hector_jax.control.walking import WalkConfig
from hector_jax.control.weights import DIRECTION_NAMES, Weights, expert, moved, nominal
from hector_jax.core.console import bar, exit_code, made_at, say
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.trajectory import Load, Trajectory
from hector_jax.grfm.dataset import walked_with
from hector_jax.grfm.effect import Effect, Window, last_command
from hector_jax.grfm.network import Params, as_effect, linear_effect
from hector_jax.report import plots, transfer
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import kept, pipeline
from hector_jax.sim.walk import Job, walk_many
from hector_jax.sim.world import hfs
from hector_jax.storage import environment, load_weights, write_file, write_json
from hector_jax.tuning.difftune import PAPER_ITERATIONS, TuneConfig, refusal, tune_step
from hector_jax.tuning.loss import LossConfig, loss_of
from hector_jax.tuning.rollout import RolloutConfig, rollout

SETS = ("nominal", "expert", "tuned")
FACTORS = (1.5, 3.0)  # within which the weight sets of the rank correlation lie


@dataclass(frozen=True)
class Flags:
    """What to compare."""

    data: Path = Path("data")  # walks and nets; made where missing
    out: Path = Path("runs/transfer")  # folder of the report
    tuned: dict[str, Path] = field(default_factory=dict)  # TRAJ FILE; else tuned here, ten steps
    trajectories: tuple[str, ...] = COMMANDS
    sets: tuple[str, ...] = SETS
    phases: tuple[int, ...] = (0, 10, 20, 30)  # gait ticks at which the command starts
    lead: int = 40  # ticks in place before t = 0 on the model; told beside none
    ranks: int = 64  # weight sets about nominal for each rank correlation; 0 leaves them out
    effort_about: str = "zero"  # or weight: see MpcConfig
    stance_weight: bool = False  # see LegConfig
    processes: int = 2  # one core each

    def __post_init__(self) -> None:
        if not self.sets:
            raise InputError(f"Flags.sets must name one at least of {', '.join(SETS)}, got none")
        for name in self.sets:
            if name not in SETS:
                raise InputError(f"Flags.sets must be of {', '.join(SETS)}, got {name!r}")
        for name in self.tuned:
            if name not in self.trajectories:
                raise InputError(
                    f"Flags.tuned must be of the trajectories {', '.join(self.trajectories)}, "
                    f"got {name!r}"
                )


class Walked(NamedTuple):
    """What there is to say about some walks on the hfs."""

    loss: np.ndarray
    fallen: np.ndarray
    residual: np.ndarray  # worst of a plan


class Point(NamedTuple):
    """Where a gradient is asked for."""

    weights: Weights
    command: Command
    tick: int  # of t = 0


def _without_legs(effect: jax.tree_util.Partial, window: Window) -> Effect:
    found = effect(window)
    return found._replace(legs=Load(*(0.0 * part for part in found.legs)))


def phis(
    pool: Executor, config: TuneConfig, robot: Robot, data: Path
) -> tuple[dict, Params | None]:
    """Each phi by name, and the parameters of the default net; None for another's data."""
    walks = data / "walks"
    effects = {"command": last_command}
    if (walks / "card.json").exists():
        if walked_with(walks).get("controller") != repr(config.rollout.walk):
            say(
                f"{walks}: walked by another controller; only the command itself is compared. "
                "A --data folder of its own gives this one nets"
            )
            return effects, None
    net, paper = (pipeline.ground(pool, robot, data, name) for name in (None, "paper"))
    default = as_effect(net.params)
    effects |= {
        "linear": linear_effect(net.linear),
        "paper": as_effect(paper.params),
        "net": default,
        "net without legs": jax.tree_util.Partial(_without_legs, default),
    }
    host = partial(jax.tree.map, np.asarray)  # what a process is sent must not sit on a device
    return {name: host(effect) for name, effect in effects.items()}, net.params


def tuned_sets(
    pool: Executor,
    flags: Flags,
    config: TuneConfig,
    robot: Robot,
    params: Params | None,
    given: Mapping[str, Weights],
) -> dict[str, Weights]:
    """Weights after the paper's ten iterations by trajectory: given ones, kept ones or made now."""
    problems = {
        name: (named_command(name), params) for name in flags.trajectories if name not in given
    }
    commit = environment().get("commit", "")
    title = "tuning, ten iterations"
    found = kept.tune(pool, config, robot, problems, flags.out, commit, title)
    return {**given, **{name: tuned.tuning.ten for name, tuned in found.items()}}


def _tell(walk: Trajectory) -> Walked:
    loss = loss_of(LossConfig(), walk)
    return Walked(np.asarray(loss), walk.fallen.any(), walk.residual.max())


def walk_groups(
    pool: Executor,
    config: WalkConfig,
    robot: Robot,
    groups: Mapping[str, Sequence[Job]],
    folder: Path,
) -> tuple[dict[str, Walked], str]:
    """Walks of groups of jobs on the hfs, and their engine; a group that is on disk is taken."""
    engine = "c" if jax.default_backend() == "cpu" else "mjx"
    walk = {
        "c": partial(walk_many, pool, config, robot),
        "mjx": partial(pipeline.mjx_walks, config, robot, fine=True, single=False),
    }[engine]
    like = Walked(np.zeros(0), np.zeros(0), np.zeros(0))
    key, title = (config, LossConfig(), engine), f" on the high-fidelity simulator, engine {engine}"
    walked = kept.walk_groups(groups, walk, _tell, like, "transfer", robot, folder, key, title)
    return walked, engine


def gradient_jobs(point: Point, phases: Sequence[int]) -> list[Job]:
    """Walks whose losses make the gradients at a weight set: phases, directions, both sides."""
    steps = transfer.STEP * np.eye(len(DIRECTION_NAMES))
    return [
        Job(moved(point.weights, side * step), point.command, hfs(), start_tick=phase)
        for phase in phases
        for step in steps
        for side in (1, -1)
    ]


@partial(jax.jit, static_argnums=0)
def _model_loss(config, robot, weights, command, anchor, effect):
    walk = rollout(config.rollout, robot, weights, command, anchor, effect)
    return loss_of(config.loss, walk)


def _model_job(
    config: TuneConfig,
    robot: Robot,
    effect: jax.tree_util.Partial,
    points: Sequence[Point],
    others: Sequence[Point],
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients at points, NaN where not to be believed, and losses at others; in a worker."""
    rows = []
    for weights, command, tick in points:
        anchor = standing_anchor(robot, tick)
        found = jax.device_get(tune_step(config, robot, weights, command, anchor, effect))
        row = transfer.as_directions(weights, found.gradient)
        rows.append(np.where(refusal(config, found), np.nan, row))
    told = [
        float(_model_loss(config, robot, weights, command, standing_anchor(robot, tick), effect))
        for weights, command, tick in others
    ]
    return np.array(rows), np.array(told)


def ask_model(
    pool: Executor,
    configs: Mapping[str, TuneConfig],
    robot: Robot,
    effects: Mapping[str, jax.tree_util.Partial],
    points: Sequence[Point],
    others: Sequence[Point],
) -> dict[str, Future]:
    """`_model_job` of each phi with each config; by the phi's name and the config's ending."""
    return {
        name + ending: pool.submit(_model_job, config, robot, effect, points, others)
        for ending, config in configs.items()
        for name, effect in effects.items()
    }


def main() -> None:
    """Write report.md, transfer.json and the pictures."""
    flags = tyro.cli(Flags)
    setup_jax()
    given = {name: load_weights(path) for name, path in flags.tuned.items()}
    robot = jax.tree.map(np.asarray, load_robot())
    walk = WalkConfig(
        mpc=MpcConfig(effort_about=flags.effort_about),
        legs=LegConfig(stance_weight=flags.stance_weight),
    )
    configs = {
        "" if not lead else f", lead {lead}": TuneConfig(
            rollout=RolloutConfig(walk=walk, lead=lead), iterations=PAPER_ITERATIONS
        )
        for lead in sorted({0, flags.lead})
    }
    flags.out.mkdir(parents=True, exist_ok=True)
    with workers(flags.processes) as pool:
        effects, params = phis(pool, configs[""], robot, flags.data)
        tuned = {}
        if "tuned" in flags.sets:
            tuned = tuned_sets(pool, flags, configs[""], robot, params, given)
        spots = {
            (which, name): Point(
                {"nominal": nominal(), "expert": expert(), "tuned": tuned.get(name)}[which],
                named_command(name),
                0,
            )
            for which in flags.sets
            for name in flags.trajectories
        }
        clouds = {
            (name, f"{factor:g}"): [
                Point(weights, named_command(name), tick)
                for weights in transfer.disturbed(nominal(), factor, flags.ranks)
                for tick in flags.phases
            ]
            for name in flags.trajectories
            for factor in FACTORS
            if flags.ranks
        }
        groups = {
            **{"-".join(key): gradient_jobs(spot, flags.phases) for key, spot in spots.items()},
            **{
                f"ranks-{'-'.join(key)}": [
                    Job(p.weights, p.command, hfs(), start_tick=p.tick) for p in cloud
                ]
                for key, cloud in clouds.items()
            },
        }
        points = [spot._replace(tick=tick) for spot in spots.values() for tick in flags.phases]
        others = [point for cloud in clouds.values() for point in cloud]
        # An accelerator walks while the processes differentiate; without one the walks come after.
        running = ask_model(pool, configs, robot, effects, points, others)
        walked, engine = walk_groups(pool, walk, robot, groups, flags.out / "hfs")
        with bar("gradients on the rigid body") as tell:
            for done, _ in enumerate(as_completed(running.values()), 1):
                tell(done, len(running), "")
        found = {name: future.result() for name, future in running.items()}

    truth = {}
    for key in spots:
        seen = walked["-".join(key)]
        believed = np.where(seen.fallen, np.nan, seen.loss)
        truth[key] = transfer.slopes(believed.reshape(len(flags.phases), -1, 2))
    gradients = {
        kind: dict(zip(spots, rows.reshape(len(spots), len(flags.phases), -1), strict=True))
        for kind, (rows, _) in found.items()
    }
    shape = flags.ranks, len(flags.phases)
    lost = {
        kind: dict(zip(clouds, told.reshape(len(clouds), *shape), strict=True))
        for kind, (_, told) in found.items()
    }
    seen = {key: walked[f"ranks-{'-'.join(key)}"].loss.reshape(shape) for key in clouds}
    print(report(flags, engine, walked, truth, gradients, seen, lost))


def report(
    flags: Flags,
    engine: str,
    walked: Mapping[str, Walked],
    truth: Mapping[tuple[str, str], np.ndarray],
    gradients: Mapping[str, Mapping[tuple[str, str], np.ndarray]],
    seen: Mapping[tuple[str, str], np.ndarray],
    lost: Mapping[str, Mapping[tuple[str, str], np.ndarray]],
) -> Path:
    """Write the report with its pictures and its numbers as JSON.

    Args:
        flags: what was asked for.
        engine: of the walks on the hfs.
        walked: those walks, by group.
        truth: gradients on the hfs by weight set and trajectory, a row per phase.
        gradients: on the model likewise, by phi.
        seen: losses of the disturbed weight sets on the hfs, by trajectory and factor, a column
            per phase.
        lost: those on the model likewise, by phi.
    """
    rows: dict[str, dict[tuple[str, str], transfer.Row | None]] = {n: {} for n in flags.sets}
    for (which, name), simulator in truth.items():
        for kind, found in gradients.items():
            plain, _, lead = kind.partition(",")
            base = (
                None if plain == "command" else gradients[f"command,{lead}" if lead else "command"]
            )
            compared = None if base is None else base[which, name]
            rows[which][name, kind] = transfer.compare(found[which, name], compared, simulator)
    mean = lambda losses: {key: values.mean(axis=1) for key, values in losses.items()}  # noqa: E731
    pairs = {kind: (mean(found), mean(seen)) for kind, found in lost.items()}
    if len(flags.phases) > 1:  # how well the simulator agrees with itself
        halves = ({key: values[:, half::2] for key, values in seen.items()} for half in (0, 1))
        pairs["hfs, other phases"] = mean(next(halves)), mean(next(halves))
    ranks = {
        (name, kind): {
            f"{factor:g}": transfer.rank_correlation(*(side[name, f"{factor:g}"] for side in sides))
            for factor in FACTORS
        }
        for name in flags.trajectories
        for kind, sides in pairs.items()
        if flags.ranks
    }
    means = {kind: sides[0] for kind, sides in pairs.items() if kind in lost}
    pictures = _draw(flags, truth, gradients, mean(seen), means, ranks)
    fell = {name: int(seen.fallen.sum()) for name, seen in walked.items() if seen.fallen.any()}
    worst = max(float(seen.residual.max()) for seen in walked.values())
    count, phases = sum(len(seen.loss) for seen in walked.values()), len(flags.phases)
    about = environment()
    text = [
        "# Does the gradient transfer?",
        made_at(about),
        f"The model's gradient of L in 18 log-weights against that of the high-fidelity simulator: "
        f"central differences of +-5 %, mean over the start phases (gait ticks "
        f"{', '.join(map(str, flags.phases))}). Controller: effort priced about "
        f"{flags.effort_about}, leg weight in the stance torque "
        f"{'on' if flags.stance_weight else 'off'}. {count} walks, engine {engine}; worst relative "
        f"KKT residual {worst:.0e}; falls: {_falls(fell)}.",
        "Brackets are 95 % intervals from redrawing the start phases, the same ones for model and "
        f"simulator. There are {phases}: with so few the intervals are rough, rather too narrow "
        "(of one phase there is none), and say nothing of other commands or plants.",
        "`command` is the plain rigid body; `lead` counts ticks that the model walks in place "
        "before t = 0. `most wrong` names the weight whose entry differs most between the two unit "
        "gradients, and its share of their squared distance.",
    ]
    for which in flags.sets:
        text += [f"## {which.capitalize()} weights"]
        if "net" in gradients:
            text += [transfer.verdict(rows[which], "net")]
        text += [transfer.gradient_table(rows[which])]
        text += [
            "\n".join(
                f"- {transfer.wrong_sentence(name, kind, row)}"
                for (name, kind), row in rows[which].items()
                if row is not None and kind in ("command", "net")
            )
        ]
    if ranks:
        text += [
            "## Order of weight sets",
            f"Spearman's rank correlation of L on the model and on the hfs over {flags.ranks} "
            "weight sets, drawn log-uniformly about nominal, each loss the mean over the start "
            "phases; a fall counts as the loss charges it. `hfs, other phases` is the correlation "
            "of the simulator with itself, every other phase against the rest.",
            transfer.rank_table(ranks),
        ]
    text += ["## Pictures", *(f"![{name}]({name})\n\n{caption}" for name, caption in pictures)]
    told = {
        "flags": {k: v for k, v in vars(flags).items() if k not in ("data", "out", "tuned")},
        "environment": about,
        "engine": engine,
        "weights": DIRECTION_NAMES,
        "rows": {
            which: {f"{n}: {k}": transfer.as_result(row) for (n, k), row in found.items()}
            for which, found in rows.items()
        },
        "ranks": {f"{name}: {kind}": row for (name, kind), row in ranks.items()},
        "fell": fell,
        "residual": worst,
        "gradients": {
            f"{which}: {name}": {
                "hfs": simulator.tolist(),
                **{kind: found[which, name].tolist() for kind, found in gradients.items()},
            }
            for (which, name), simulator in truth.items()
        },
    }
    write_json(flags.out / "transfer.json", told)
    write_file(flags.out / "report.md", ("\n\n".join(text) + "\n").encode())
    return flags.out / "report.md"


def _falls(fell: Mapping[str, int]) -> str:
    if not fell:
        return "none"
    each = ", ".join(f"{name} {count}" for name, count in fell.items())
    return f"{each} (phases with a fall are left out of the gradients)"


def _draw(
    flags: Flags,
    truth: Mapping[tuple[str, str], np.ndarray],
    gradients: Mapping[str, Mapping[tuple[str, str], np.ndarray]],
    seen: Mapping[tuple[str, str], np.ndarray],
    lost: Mapping[str, Mapping[tuple[str, str], np.ndarray]],
    ranks: Mapping[tuple[str, str], Mapping[str, float]],
) -> list[tuple[str, str]]:
    """Names and captions of the pictures, all without lead."""
    plain = [kind for kind in gradients if "," not in kind]
    pictures = []
    which = flags.sets[0]
    for name in flags.trajectories:
        simulator = truth[which, name]
        models = {kind: gradients[kind][which, name] for kind in plain}
        kept = np.isfinite(simulator + sum(models.values())).all(axis=1)
        if not kept.any():
            continue
        file = f"gradients-{name}.png"
        models = {kind: rows[kept] for kind, rows in models.items()}
        caption = plots.gradients(flags.out / file, DIRECTION_NAMES, simulator[kept], models)
        pictures.append((file, f"{name}, {which} weights. {caption}"))
    if ranks:
        keys = [(name, f"{factor:g}") for name in flags.trajectories for factor in FACTORS]
        caption = plots.ranks(
            flags.out / "ranks.png",
            {key: seen[key] for key in keys},
            {key: {kind: lost[kind][key] for kind in plain} for key in keys},
            {key: {kind: ranks[key[0], kind][key[1]] for kind in plain} for key in keys},
        )
        pictures.append(("ranks.png", caption))
    return pictures


if __name__ == "__main__":
    sys.exit(exit_code("transfer", main))
