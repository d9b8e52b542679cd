"""Tuning on few walks: a folder in which proposals and the logs of their walks alternate.

Whoever walks, a simulator here (`tune_on_walks`) or a robot elsewhere (`hector propose`, `hector
report`), the same functions read the logs and make the proposals (search/few_walks.py), and all
that they know is in the folder:

- `walks.jsonl`: settings, then a line for each proposal that was walked.
- `logs/3-0.npz`: the log of walk 3 in case 0, at the plan interval.
- `proposal.json`: what is to be walked next, until it was.
- `metric.npz`: the Gauss-Newton matrix at the start, which all points are in.

A weight set is walked in each case: all commands, on each plant. Its loss is the mean over the
cases, each divided by its loss at the start, so that all count alike.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from itertools import product, repeat
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.parameters import TUNABLES
from hector_jax.control.reference import Command
from hector_jax.control.weights import (
    Weights,
    direction_names,
    directions,
    moved_most,
    weights_to_vector,
)
from hector_jax.control.weights_file import save_weights, weights_tree
from hector_jax.core.console import bar, say
from hector_jax.core.files import write_json
from hector_jax.core.inputs import InputError, one_line, plural
from hector_jax.core.settings import read_json
from hector_jax.core.trajectory import no_samples
from hector_jax.core.tree_file import load_tree, save_tree, tree_hash
from hector_jax.grfm import network
from hector_jax.robot.model import Robot
from hector_jax.runs import tunings
from hector_jax.runs.cache import content_key, robot_hash
from hector_jax.runs.walk_log import Log, Seen, bare, log_of, read_loss
from hector_jax.search import few_walks
from hector_jax.search.cmaes import add_row, log_bounds, project, read_journal
from hector_jax.search.few_walks import Proposal, Space, Walked
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import Imperfections
from hector_jax.tuning.difftune import TuneConfig, init, step_status
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.grounded import Grounding, evaluate_grounded, fit_grounding
from hector_jax.tuning.status import StepStatus

_PROPOSAL = "proposal.json"
_REFUSED = 20.0  # log-loss of what the model cannot walk


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


# Jobs of worker processes


def _walk_job(one: Campaign, weights: Weights, case: int) -> tuple[Seen, Log]:
    plant, name = one.cases[case]
    assert plant is not None  # else somebody else walks
    command = one.commands[name]
    walked = walk(
        one.config.rollout.walk, one.robot, Job(weights, command, plant, one.seconds, case)
    )
    return read_loss(one.config, one.robot, command, jax.tree.map(np.asarray, log_of(walked)))


def _effect(one: Campaign) -> jax.tree_util.Partial:
    """The plain rigid body: what the ground is like, the walks tell."""
    return network.effect_of(None, one.config.rollout.walk.gait)


def _ground_job(one: Campaign, weights: Weights, name: str, log: Log) -> Grounding:
    walked = bare(log, one.config.rollout.walk.gait.tick)
    inputs = one.config.rollout, one.robot, weights, one.commands[name], _effect(one), walked
    return jax.device_get(fit_grounding(*inputs))


def _evaluate_job(one: Campaign, weights: Weights, name: str, grounding: Grounding) -> Evaluation:
    inputs = one.config.rollout, one.robot, weights, one.commands[name], _effect(one), grounding
    return jax.device_get(evaluate_grounded(*inputs, one.config.loss))


# The folder


def space_of(pool: Executor, one: Campaign) -> Space:
    """The coordinates of a campaign, from the model at its start; kept, as all points are in them.

    Raises:
        InputError: the file of the matrix is damaged, or of another robot.
    """
    path, like = one.folder / "metric.npz", {"matrix": np.zeros((0, 0))}
    if not path.exists():
        first, *others = one.commands.values()
        inputs = one.config, one.robot, one.start, tunings.Problem(first, None, tuple(others))
        matrix = pool.submit(tunings.gauss_newton_job, *inputs).result()
        save_tree(path, {"matrix": matrix}, kind="metric", robot=one.robot)
    tree, _ = load_tree(path, like, kind="metric", robot=one.robot)
    return few_walks.space_of(tree["matrix"], _box(one))


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
    if rows and not _stood(rows[0]):
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
    return list(pool.map(read_loss, repeat(one.config), repeat(one.robot), commands, logs))


def _model(pool: Executor, one: Campaign, space: Space, rows: Sequence[Row]) -> few_walks.Model:
    """The model grounded on the best walk: its loss there is that of the walk."""
    best = few_walks.best_walk(_walked(rows))
    weights, names = weights_at(one, space, rows[best].point), [name for _, name in one.cases]
    like = log_of(no_samples(len(one.robot.joint_lower), len(one.robot.foot_point)))
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
        The weights to believe in, and all that was walked. A start that falls is not tuned from.

    Raises:
        InputError: see `next_proposal` and `read_history`.
    """
    rows, space, cases = read_history(one), space_of(pool, one), len(one.cases)
    with bar(f"tuning with {plural(walks, 'walk')}") as tell:
        while not rows or (_stood(rows[0]) and (len(rows) + 1) * cases <= walks):
            tell(len(rows) * cases, walks, _progress(one, space, rows))
            proposal, weights = next_proposal(pool, one, space, rows)
            seen = list(pool.map(_walk_job, repeat(one), repeat(weights), range(cases)))
            rows = add_walk(one, rows, proposal, seen)
        tell(len(rows) * cases, walks, _progress(one, space, rows))
    if not _stood(rows[0]):
        say("the set from which to tune on walks fell, or a QP was not solved; it is kept as it is")
    return answer(one, space, rows)[0], rows


def _stood(row: Row) -> bool:
    return bool(np.isfinite(row.losses).all())


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
    moved = moved_most(one.start, weights_at(one, space, rows[best].point))
    change = changes(rows)[best].change or 0.0
    return f"best L {change:+.0f} % against the start" + (f"; {moved}" if best else "")
