"""Tuning on few walks: a folder in which proposals and the logs of their walks alternate.

Whoever walks, a simulator here (`tune_on_walks`) or a robot elsewhere (`hector propose`, `hector
report`), the same functions read the logs and make the proposals (search/few_walks.py), and all
that they know is in the folder:

- `walks.jsonl`: settings, then a line for each proposal that was walked.
- `logs/3-0.npz`: the log of walk 3 in case 0, at the plan interval.
- `proposal.json`: what is to be walked next, until it was.
- `kept/`: the Gauss-Newton matrix at the start.

A weight set is walked in each case: all commands, on each plant. Its loss is the mean over the
cases, each divided by its loss at the start, so that all count alike.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import product, repeat
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.parameters import TUNABLES
from hector_jax.control.reference import Command, anchor_at, reference_at
from hector_jax.control.weights import (
    Weights,
    direction_names,
    directions,
    weights_to_vector,
)
from hector_jax.control.weights_file import save_weights, weights_tree
from hector_jax.core.console import bar
from hector_jax.core.files import write_json
from hector_jax.core.inputs import InputError, one_line, plural
from hector_jax.core.settings import read_json
from hector_jax.core.trajectory import SOLVED, State, Trajectory, Wrench, has_fallen, no_samples
from hector_jax.core.tree_file import load_tree, save_tree, tree_hash
from hector_jax.grfm import network
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.runs import tunings
from hector_jax.runs.cache import content_key, load_or_make, robot_hash
from hector_jax.search import few_walks
from hector_jax.search.cmaes import add_row, log_bounds, project, read_journal
from hector_jax.search.few_walks import Proposal, Space, Walked
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import Imperfections
from hector_jax.tuning.difftune import TuneConfig, init, step_status
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.grounded import Grounding, evaluate_grounded, fit_grounding
from hector_jax.tuning.loss import loss_of
from hector_jax.tuning.status import StepStatus

_PROPOSAL = "proposal.json"
_REFUSED = 20.0  # log-loss of what the model cannot walk
_CODE = ("tuning.curvature",)  # decides the metric


class Log(NamedTuple):
    """What is measured on a walk: the entries of this name in the file of `hector walk --out`."""

    initial: State  # at t = 0, when the command begins
    state: State  # (T, 3) each, at the end of each sample
    joints: Float[Any, "T joints"]  # [rad] leg by leg
    command: Wrench  # (T, feet, 3) each, held over the sample [N, N m]
    fallen: Bool[Any, " T"]
    residual: Float[Any, " T"]  # of the plans


class Seen(NamedTuple):
    """What the log of a case says."""

    loss: float
    margin: float  # share of the way to a fall, of tilt and height; 1 where it fell


class Row(NamedTuple):
    """A proposal, and what its walks came to."""

    point: Float[np.ndarray, " n"]
    method: str
    predicted: float | None
    losses: Float[np.ndarray, " cases"]  # infinite where the robot fell or a QP was not solved
    margin: float  # share of the way to a fall, the largest of the cases


class Campaign(NamedTuple):
    """What is tuned, where, and from where."""

    folder: Path
    config: TuneConfig  # its rollout as long as the walks
    robot: Robot
    start: Weights  # with all numbers that are tuned, feet tied
    commands: Mapping[str, Command]
    plants: Sequence[Imperfections | None]  # None: somebody else walks
    seed: int

    @property
    def cases(self) -> list[tuple[Imperfections | None, str]]:
        """What a weight set is walked in."""
        return list(product(self.plants, self.commands))

    @property
    def seconds(self) -> float:
        """Length of a walk."""
        return self.config.rollout.ticks * self.config.rollout.walk.gait.tick


def campaign(
    folder: Path,
    config: TuneConfig,
    robot: Robot,
    start: Weights,
    commands: Mapping[str, Command],
    plants: Sequence[Imperfections | None] = (None,),
    seed: int = 0,
) -> Campaign:
    """Settings of a tuning on walks; see `Campaign`."""
    start = jax.tree.map(np.asarray, init(config, start).best)
    return Campaign(folder, config, robot, start, commands, plants, seed)


# Points and weights


def _box(one: Campaign) -> Float[np.ndarray, "n 2"]:
    """Least and largest steps: of the log-weights, and of other numbers in tenths of their box."""
    rows = [log_bounds(one.start)]
    for name in one.config.others:
        part, at = TUNABLES[name], float(one.start.others[name])
        rows.append((np.array([[part.lower, part.upper]]) - at) / _unit(name))
    return np.concatenate(rows)


def _unit(name: str) -> float:
    return 0.1 * (TUNABLES[name].upper - TUNABLES[name].lower)


def weights_at(one: Campaign, space: Space, point: Float[np.ndarray, " n"]) -> Weights:
    """The weights of a point."""
    steps, count = space.to_steps @ point, len(direction_names(one.start))
    weights = project(one.start, steps[:count])
    moved = {
        name: np.clip(
            weights.others[name] + step * _unit(name), TUNABLES[name].lower, TUNABLES[name].upper
        )
        for name, step in zip(one.config.others, steps[count:], strict=True)
    }
    return weights._replace(others={**weights.others, **moved})


def _slope(one: Campaign, space: Space, weights: Weights, gradient: Weights) -> np.ndarray:
    """Gradient by the point, of that by the weights."""
    by_log = np.asarray(weights_to_vector(gradient)) * np.asarray(weights_to_vector(weights))
    others = [float(gradient.others[name]) * _unit(name) for name in one.config.others]
    return space.to_steps.T @ np.append(directions(weights) @ by_log, others)


def _moved(start: Weights, weights: Weights) -> str:
    """The three weights that moved farthest: "Q_x 1.8 times, ..."."""
    sizes = [np.asarray(weights_to_vector(w)) for w in (start, weights)]
    farthest = directions(start).argmax(axis=1)  # of the first foot
    logs = np.log(sizes[1] / sizes[0])[farthest]
    order = sorted(range(len(logs)), key=lambda i: -abs(logs[i]))[:3]
    names = direction_names(start)
    return ", ".join(f"{names[i]} {np.exp(logs[i]):.2g} times" for i in order)


# Logs


def log_of(walked: Trajectory) -> Log:
    """What is read of a walk."""
    return Log(*(getattr(walked, name) for name in Log._fields))


def read_log(path: Path, robot: Robot, seconds: float) -> Log:
    """The log of a walk: an .npz with the entries of `Log`, such as `hector walk --out` writes.

    `fallen` and `residual` may be left out. A log that ends early is that of a fall.

    Args:
        path: of the file.
        robot: that walked.
        seconds: that it should have walked; samples are of 1 ms.

    Raises:
        InputError: one line naming the file and the entry that is missing, of another shape, or not
            of finite numbers; or it is not a log of 1 ms.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files if name != "card"}
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not a log (.npz): {one_line(error)}") from None
    wanted, joints, feet = round(seconds / TIME_STEP), len(robot.joint_lower), len(robot.foot_point)
    if "period" in arrays and not np.isclose(arrays["period"], TIME_STEP, rtol=1e-6):
        raise InputError(f"{path}: samples must be of {TIME_STEP} s, got {arrays['period']}")
    count = len(arrays.get("joints", ()))
    if not 1 <= count <= wanted:
        raise InputError(f"{path}: expected {wanted} samples of joints, got {count}")
    row = {"fallen": (), "residual": (), "joints": (joints,)}
    shapes = {
        **{f"initial.{name}": (3,) for name in State._fields},
        **{f"state.{name}": (count, 3) for name in State._fields},
        **{f"command.{name}": (count, feet, 3) for name in Wrench._fields},
        **{name: (count, *rest) for name, rest in row.items()},
    }
    arrays = {"fallen": np.zeros(count, bool), "residual": np.zeros(count), **arrays}
    for name, shape in shapes.items():
        if name not in arrays:
            raise InputError(f"{path}: {name} is missing; expected {', '.join(shapes)}")
        if (got := arrays[name].shape) != shape:
            raise InputError(f"{path}: {name} must have shape {shape}, got {got}")
        if arrays[name].dtype.kind not in "biuf" or not np.isfinite(arrays[name]).all():
            raise InputError(f"{path}: {name} must hold finite numbers")
    rows = np.minimum(np.arange(wanted), count - 1)
    state = State(*(arrays[f"state.{name}"][rows].astype(float) for name in State._fields))
    command = Wrench(*(arrays[f"command.{name}"][rows].astype(float) for name in Wrench._fields))
    down = np.asarray(has_fallen(state, *robot.description.limits))
    fell = np.maximum.accumulate(down | arrays["fallen"][rows].astype(bool))
    return Log(
        State(*(arrays[f"initial.{name}"].astype(float) for name in State._fields)),
        state,
        arrays["joints"][rows].astype(float),
        command,
        fell | (np.arange(wanted) >= count),
        arrays["residual"][rows].astype(float),
    )


@partial(jax.jit, static_argnums=0)
def _references(tick: float, robot: Robot, command: Command, initial: State, ticks: Any) -> State:
    anchor = anchor_at(robot, initial, 0)
    return jax.vmap(lambda t: reference_at(tick, command, anchor, t))(ticks)


def _bare(log: Log, period: float) -> Trajectory:
    """A trajectory of what a log holds; all else is empty."""
    empty = no_samples(log.joints.shape[1], log.command.force.shape[1])
    return empty._replace(period=np.asarray(period), **log._asdict())


def _see(config: TuneConfig, robot: Robot, command: Command, log: Log) -> tuple[Seen, Log]:
    """What a log of 1 ms says, and the log at the plan interval."""
    tick, count = config.rollout.walk.gait.tick, len(log.fallen)
    each = round(tick / TIME_STEP)
    ticks = (np.arange(count) + 1.0) / each
    reference = _references(tick, robot, command, log.initial, ticks)
    loss = float(loss_of(config.loss, _bare(log, TIME_STEP)._replace(reference=reference)))
    least, most = robot.description.limits
    stood = ~log.fallen
    tilt = np.abs(log.state.euler[stood, :2]).max(initial=0.0) / most
    standing = float(robot.standing_height)
    sunk = (standing - log.state.position[stood, 2].min(initial=standing)) / (standing - least)
    bad = log.fallen.any() or not log.residual.max() <= SOLVED
    seen = Seen(np.inf, 1.0) if bad else Seen(loss, float(max(tilt, sunk)))
    thin = {name: jax.tree.map(lambda x: x[each - 1 :: each], part) for name, part in _samples(log)}
    return seen, log._replace(**thin)


def _samples(log: Log) -> Iterator[tuple[str, Any]]:
    return ((name, part) for name, part in log._asdict().items() if name != "initial")


# Jobs of worker processes


def _walk_job(one: Campaign, weights: Weights, case: int) -> tuple[Seen, Log]:
    plant, name = one.cases[case]
    assert plant is not None  # else somebody else walks
    command = one.commands[name]
    walked = walk(
        one.config.rollout.walk, one.robot, Job(weights, command, plant, one.seconds, case)
    )
    return _see(one.config, one.robot, command, jax.tree.map(np.asarray, log_of(walked)))


def _effect(one: Campaign) -> jax.tree_util.Partial:
    """The plain rigid body: what the ground is like, the walks tell."""
    return network.effect_of(None, one.config.rollout.walk.gait)


def _ground_job(one: Campaign, weights: Weights, name: str, log: Log) -> Grounding:
    walked = _bare(log, one.config.rollout.walk.gait.tick)
    inputs = one.config.rollout, one.robot, weights, one.commands[name], _effect(one), walked
    return jax.device_get(fit_grounding(*inputs))


def _evaluate_job(one: Campaign, weights: Weights, name: str, grounding: Grounding) -> Evaluation:
    inputs = one.config.rollout, one.robot, weights, one.commands[name], _effect(one), grounding
    return jax.device_get(evaluate_grounded(*inputs, one.config.loss))


# The folder


def space_of(pool: Executor, one: Campaign) -> Space:
    """The coordinates of a campaign, from the model at its start."""
    problem = tunings.Problem(*_first_and_others(one.commands))
    key = content_key(one.config, one.robot, one.start, *problem, code=_CODE)
    path = one.folder / "kept" / f"metric-{key}.npz"

    def make(*_: Any) -> Iterator[tuple[str, Any]]:
        inputs = one.config, one.robot, one.start, problem
        yield "matrix", {"matrix": pool.submit(tunings.gauss_newton_job, *inputs).result()}

    like = {"matrix": np.zeros((0, 0))}
    made = load_or_make({"matrix": path}, make, like=lambda _: like, kind="metric", robot=one.robot)
    return few_walks.space_of(made["matrix"]["matrix"], _box(one))


def _first_and_others(commands: Mapping[str, Command]) -> tuple[Command, None, tuple]:
    first, *others = commands.values()
    return first, None, tuple(others)


def read_history(one: Campaign) -> list[Row]:
    """What was walked so far; begins the record of a new campaign.

    Raises:
        InputError: the folder holds the record of another campaign, or a damaged one.
    """
    size = len(_box(one))
    head = {
        "format": 1,
        "robot": robot_hash(one.robot),
        "settings": content_key(one.config, code=()),
        "start": weights_tree(one.start),
        "commands": {name: tree_hash(command) for name, command in one.commands.items()},
        "plants": [plant and tree_hash(plant) for plant in one.plants],
        "seed": one.seed,
    }

    def parse(row: Mapping[str, Any]) -> Row:
        point, losses = np.array(row["point"], float), np.array(row["losses"], float)
        if (got := (point.shape, losses.shape)) != ((size,), (len(one.cases),)):
            raise ValueError(f"point and losses of shapes {got}")
        losses = np.where(np.isfinite(losses), losses, np.inf)
        return Row(point, row["method"], row["predicted"], losses, float(row["margin"]))

    return read_journal(one.folder / "walks.jsonl", head, what="tuning on walks", parse=parse)


def _walked(rows: Sequence[Row]) -> list[Walked]:
    """The rows with one loss each, of the mean over the cases."""
    return [
        Walked(row.point, row.method, row.predicted, _log_loss(rows, row), row.margin)
        for row in rows
    ]


def _log_loss(rows: Sequence[Row], row: Row) -> float:
    with np.errstate(invalid="ignore"):
        ratio = np.mean(row.losses / rows[0].losses)
    return float(np.log(ratio)) if np.isfinite(ratio) else np.inf


def next_proposal(
    pool: Executor, one: Campaign, space: Space, rows: Sequence[Row]
) -> tuple[Proposal, Weights]:
    """What to walk next, written into the folder; the same until it was walked.

    Raises:
        InputError: the start fell, the file of the proposal is damaged, or packages of the extra
            `search` are missing.
    """
    if rows and not np.isfinite(rows[0].losses).all():
        raise InputError(f"{one.folder}: the start fell, or a QP was not solved; tune from another")
    if (given := pending(one, rows)) is not None:
        return given, weights_at(one, space, given.point)
    history = _walked(rows)
    model = _model(pool, one, space, rows) if few_walks.needs_model(history) else None
    proposal = few_walks.propose(space, history, model, one.seed)
    weights = weights_at(one, space, proposal.point)
    save_weights(weights_path(one, len(rows)), weights)
    listed = {**proposal._asdict(), "point": proposal.point.tolist()}
    write_json(one.folder / _PROPOSAL, {"walk": len(rows), **listed})
    return proposal, weights


def pending(one: Campaign, rows: Sequence[Row]) -> Proposal | None:
    """The proposal that waits for its walk, if any.

    Raises:
        InputError: its file is damaged.
    """
    path = one.folder / _PROPOSAL
    given = read_json(path, "a proposal") if path.exists() else {}
    try:
        if given.get("walk") != len(rows):
            return None
        point = np.array(given["point"], float)
        if point.shape != (len(_box(one)),):
            raise ValueError(f"a point of shape {point.shape}")
        return Proposal(point, given["method"], given["predicted"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged: {one_line(error)}; remove it") from None


def weights_path(one: Campaign, number: int) -> Path:
    """File of the weights of a walk."""
    return one.folder / "weights" / f"{number}.json"


def see(pool: Executor, one: Campaign, logs: Sequence[Log]) -> list[tuple[Seen, Log]]:
    """What the logs of all cases say, and they at the plan interval."""
    commands = [one.commands[name] for _, name in one.cases]
    return list(pool.map(_see, repeat(one.config), repeat(one.robot), commands, logs))


def _model(pool: Executor, one: Campaign, space: Space, rows: Sequence[Row]) -> few_walks.Model:
    """The model grounded on the best walk: its loss there is that of the walk."""
    best = few_walks.best_walk(_walked(rows))
    weights, names = weights_at(one, space, rows[best].point), [name for _, name in one.cases]
    like = _empty_log(one.robot)
    logs = [
        load_tree(_log_path(one, best, case), like, kind="log", robot=one.robot)[0]
        for case in range(len(names))
    ]
    groundings = list(pool.map(_ground_job, repeat(one), repeat(weights), names, logs))

    def evaluate(weights: Weights) -> list[Evaluation]:
        return list(pool.map(_evaluate_job, repeat(one), repeat(weights), names, groundings))

    shares = rows[best].losses / rows[0].losses
    scales = shares / np.array([seen.loss for seen in evaluate(weights)]) / len(names)

    def model(point: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        weights = weights_at(one, space, point)
        each = evaluate(weights)
        if any(step_status(one.config, seen) != StepStatus.ACCEPTED for seen in each):
            return _REFUSED, np.zeros_like(point)
        loss = sum(scale * float(seen.loss) for scale, seen in zip(scales, each, strict=True))
        slopes = [_slope(one, space, weights, seen.gradient) for seen in each]
        slope = sum(scale * of for scale, of in zip(scales, slopes, strict=True)) / loss
        return float(np.log(loss)), np.asarray(slope)

    return model


def _empty_log(robot: Robot) -> Log:
    return log_of(no_samples(len(robot.joint_lower), len(robot.foot_point)))


def _log_path(one: Campaign, number: int, case: int) -> Path:
    return one.folder / "logs" / f"{number}-{case}.npz"


def add_walk(
    one: Campaign, rows: Sequence[Row], proposal: Proposal, seen: Sequence[tuple[Seen, Log]]
) -> list[Row]:
    """The history with one walk more, kept in the folder: first its logs, then its row."""
    for case, (_, log) in enumerate(seen):
        save_tree(_log_path(one, len(rows), case), log, kind="log", robot=one.robot)
    losses = np.array([each.loss for each, _ in seen])
    row = Row(*proposal, losses, max(each.margin for each, _ in seen))
    listed = {"point": row.point.tolist(), "losses": row.losses.tolist()}
    add_row(one.folder / "walks.jsonl", row._asdict() | listed)
    return [*rows, row]


def answer(one: Campaign, space: Space, rows: Sequence[Row]) -> tuple[Weights, int]:
    """The weights to believe in, and which walk they are of; see `few_walks.incumbent`."""
    which = few_walks.incumbent(space, _walked(rows))
    return weights_at(one, space, rows[which].point), which


def tune_on_walks(pool: Executor, one: Campaign, walks: int) -> tuple[Weights, list[Row]]:
    """Spend walks on the plants of a campaign, taking up what is in its folder.

    Args:
        pool: worker processes.
        one: the campaign.
        walks: to spend; whole rounds of all cases are walked, at least the start.

    Returns:
        The weights to believe in, and all that was walked.

    Raises:
        InputError: see `next_proposal` and `read_history`.
    """
    space, rows, cases = space_of(pool, one), read_history(one), len(one.cases)
    with bar(f"tuning with {plural(walks, 'walk')}") as tell:
        while not rows or (len(rows) + 1) * cases <= walks:
            tell(len(rows) * cases, walks, _progress(one, space, rows))
            proposal, weights = next_proposal(pool, one, space, rows)
            seen = list(pool.map(_walk_job, repeat(one), repeat(weights), range(cases)))
            rows = add_walk(one, rows, proposal, seen)
        tell(len(rows) * cases, walks, _progress(one, space, rows))
    return answer(one, space, rows)[0], rows


class Change(NamedTuple):
    """What a proposal came to, against the start."""

    method: str
    predicted: float | None  # [%] None where nothing was
    change: float | None  # [%] of L; None where the robot fell or a QP was not solved


def changes(rows: Sequence[Row]) -> list[Change]:
    """What each proposal came to."""
    percent = lambda loss: 100.0 * float(np.expm1(loss))  # noqa: E731
    return [
        Change(
            row.method,
            None if row.predicted is None else percent(row.predicted),
            percent(row.loss) if np.isfinite(row.loss) else None,
        )
        for row in _walked(rows)
    ]


def _progress(one: Campaign, space: Space, rows: Sequence[Row]) -> str:
    if not rows:
        return "compiling"
    history = _walked(rows)
    best = few_walks.best_walk(history)
    moved = _moved(one.start, weights_at(one, space, rows[best].point))
    change = changes(rows)[best].change or 0.0
    return f"best L {change:+.0f} % against the start" + (f"; {moved}" if best else "")
