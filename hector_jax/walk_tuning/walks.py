"""Tuning on few walks: a folder in which proposals and the logs of their walks alternate.

Whether a simulator (`tune_on_walks`) or a real robot (`hector propose`, `hector report`) walks, the
same functions read the logs and make the proposals (search/few_walks.py), and all that they use is
in the folder:

- `walks.jsonl`: settings, then a line for each proposal and, once it was walked, one for its walk.
- `logs/3-0.npz`: the log of walk 3 in case 0, at the plan interval, or the file that was reported.
- `weights/3.json`: the weights of walk 3.
- `metric.npz`: the Gauss-Newton matrix at the start, which defines the coordinates of all points.

A weight set is walked in each case: all commands, on each plant. Its loss is the mean over the
cases, each divided by its loss at the start, so that all count alike.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.parameters import steps_between
from hector_jax.control.weights import Weights, direction_names
from hector_jax.control.weights_file import save_weights, weights_tree
from hector_jax.core.console import bar, say
from hector_jax.core.environment import code_hash
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.journal import add_row, continue_journal
from hector_jax.core.trajectory import no_samples
from hector_jax.core.tree_file import load_tree, save_tree, tree_hash
from hector_jax.search import few_walks
from hector_jax.search.few_walks import Model, Proposal, Space, WalkResult
from hector_jax.sim.loop import Job
from hector_jax.store import tunings
from hector_jax.store.cache import content_key, robot_hash
from hector_jax.store.setup import Setup
from hector_jax.walk_tuning import grounded_model
from hector_jax.walk_tuning.campaign import Campaign, box_of, walker_hash, weights_at
from hector_jax.walk_tuning.walk_log import (
    Log,
    ScoredLog,
    evaluate_log,
    log_of,
    read_log,
)

RECORD = "walks.jsonl"


class Row(NamedTuple):
    """A proposal and the results of its walks."""

    point: Float[np.ndarray, " n"]
    method: str
    predicted: float | None
    losses: Float[np.ndarray, " cases"]  # infinite where the robot fell or a QP was not solved
    margin: float  # share of the way to a fall, the largest of the cases


# Jobs of worker processes


def walk_case(campaign: Campaign, weights: Weights, case: int) -> ScoredLog:
    """Walk a weight set in a case of a campaign, and score the walk."""
    config, robot = campaign.config, campaign.robot
    plant, command = campaign.cases[case]
    assert plant is not None  # None: the walks are made elsewhere
    job = Job(weights, command, plant, campaign.seconds, case)
    walked = next(campaign.engine.walk(None, config.rollout.walk, robot, [job]))
    log = jax.tree.map(np.asarray, log_of(walked))
    return evaluate_log(config, robot, command, log)


def row_of(proposal: Proposal, cases: Sequence[ScoredLog]) -> Row:
    """Return the row of a proposal and the scores of its walks."""
    losses, margin = zip(*((score.loss, score.margin) for score, _ in cases), strict=True)
    point, method, predicted = proposal
    return Row(point, method, predicted, np.array(losses), max(margin))


# The folder


def campaign_space(pool: Executor, campaign: Campaign) -> Space:
    """Return the coordinates of all points, from their file or from the model at the start.

    Raises:
        InputError: the file of the matrix is damaged, or of another robot.
    """
    # reported walks are of the robot's files, however this code reads them: see `walker_hash`
    robot, path = None if campaign.reported else campaign.robot, campaign.folder / "metric.npz"
    if not path.exists():
        problem = tunings.Problem(tuple(campaign.commands.values()), None)
        setup = Setup(pool, campaign.config, campaign.robot)
        matrix = tunings.relative_matrix(setup, campaign.start, problem)
        save_tree(path, {"matrix": matrix}, kind="metric", robot=campaign.robot)
    tree, _ = load_tree(path, {"matrix": np.zeros((0, 0))}, kind="metric", robot=robot)
    return few_walks.space_of(tree["matrix"], box_of(campaign))


def read_record(campaign: Campaign) -> tuple[list[Row], Proposal | None]:
    """Return the walks so far and the proposal that waits for its walk; begin a new record.

    Those that were reported are scored as they were then: see `reported_walks.read_reports`.

    Raises:
        InputError: the folder holds the record of another campaign, or a damaged one.
    """
    size, engine, remedy = len(box_of(campaign)), campaign.engine, "choose another folder"
    head: dict[str, Any] = {
        "format": 3,
        "robot": robot_hash(campaign.robot),
        "start": weights_tree(campaign.start),
        "settings": content_key(campaign.config, campaign.start, code=()),
        "commands": {name: tree_hash(command) for name, command in campaign.commands.items()},
        "plants": [plant and tree_hash(plant) for plant in campaign.plants],
        "seed": campaign.seed,
        "leg_numbers": list(campaign.leg_numbers),
    }
    if campaign.reported:  # data: neither code nor loss can make them those of another campaign
        settings = {"seconds": campaign.seconds, "numbers": list(campaign.numbers)}
        head |= {"robot": walker_hash(campaign.robot), "settings": settings}
        remedy += f" and begin anew with hector propose --start {campaign.folder}/weights/N.json"
    else:
        head |= {
            "model": campaign.model,
            "engine": engine.key,
            "code": code_hash("walk_tuning.walks", *engine.modules),
        }

    def parse(row: Mapping[str, Any]) -> Any:  # a `Proposal`, or losses and margin of its walk
        name, length = ("losses", len(campaign.cases)) if "losses" in row else ("point", size)
        if (values := np.array(row[name], float)).shape != (length,):
            raise ValueError(f"{name} of shape {values.shape}")
        if name == "point":
            return Proposal(values, row["method"], row["predicted"])
        return np.where(np.isfinite(values), values, np.inf), float(row["margin"])

    path = campaign.folder / RECORD
    lines = continue_journal(path, head, "a tuning on walks", parse, remedy)
    proposals, walked = lines[::2], lines[1::2]
    if not all(isinstance(line, Proposal) == (i % 2 == 0) for i, line in enumerate(lines)):
        raise InputError(f"{path}: a walk without a proposal, or a proposal without a walk")
    rows = [Row(*proposal, *walk) for proposal, walk in zip(proposals, walked, strict=False)]
    return rows, proposals[-1] if len(proposals) > len(walked) else None


def _walked(rows: Sequence[Row]) -> list[WalkResult]:
    """Return the rows with the logarithm of their mean loss over the cases relative to the start.

    It is infinite if the mean loss is not finite.
    """
    with np.errstate(invalid="ignore"):
        ratios = [np.mean(row.losses / rows[0].losses) for row in rows]
    losses = [float(np.log(ratio)) if np.isfinite(ratio) else np.inf for ratio in ratios]
    return [WalkResult(*row[:3], L, row.margin) for row, L in zip(rows, losses, strict=True)]


def next_proposal(
    pool: Executor, campaign: Campaign, space: Space, rows: Sequence[Row]
) -> tuple[Proposal, Weights]:
    """Return the next proposal, saved in the folder; it stays the same until it is walked.

    Raises:
        InputError: the start fell, or packages of the extra `search` are missing.
    """
    if rows and not _stood(rows[0]):
        raise InputError(
            f"{campaign.folder}: the start fell or a QP was not solved; tune from another"
        )
    _, proposal = read_record(campaign)
    if proposal is not None:
        return proposal, weights_at(campaign, space, proposal.point)
    history = _walked(rows)
    has_model = campaign.model != "none" and few_walks.needs_model(history)
    model = _model(pool, campaign, space, rows) if has_model else None
    proposal = few_walks.propose(space, history, model, campaign.seed)
    weights = weights_at(campaign, space, proposal.point)
    save_weights(weights_path(campaign.folder, len(rows)), weights)
    _add_proposal(campaign, proposal)
    return proposal, weights


def _add_proposal(campaign: Campaign, proposal: Proposal) -> None:
    fields = {**proposal._asdict(), "point": proposal.point.tolist()}
    add_row(campaign.folder / RECORD, fields)


def weights_path(folder: Path, number: int) -> Path:
    """Return the file of the weights of a walk in the folder of a campaign."""
    return folder / "weights" / f"{number}.json"


def log_paths(campaign: Campaign, number: int) -> list[Path]:
    """Return the files of the logs of a walk, one for each case."""
    names = [f"{number}-{case}.npz" for case in range(len(campaign.cases))]
    return [campaign.folder / "logs" / name for name in names]


def evaluate_logs(pool: Executor, campaign: Campaign, number: int) -> list[ScoredLog]:
    """Evaluate the logs of a walk that was reported; see `evaluate_log`."""
    config, robot, running = campaign.config, campaign.robot, []
    for path, (_, command) in zip(log_paths(campaign, number), campaign.cases, strict=True):
        log = read_log(path, robot, campaign.seconds, config.rollout.walk.gait.tick)
        running.append(pool.submit(evaluate_log, config, robot, command, log))
    return [job.result() for job in running]


def _plan_logs(pool: Executor, campaign: Campaign, number: int) -> list[Log]:
    """Return the logs of a walk at the plan interval."""
    if campaign.reported:
        return [log for _, log in evaluate_logs(pool, campaign, number)]
    like = log_of(no_samples(len(campaign.robot.joint_lower), len(campaign.robot.foot_point)))
    paths = log_paths(campaign, number)
    return [load_tree(path, like, kind="log", robot=campaign.robot)[0] for path in paths]


def _model(pool: Executor, campaign: Campaign, space: Space, rows: Sequence[Row]) -> Model:
    """Return the model grounded on the best walk, or on all: see `Campaign.model`."""
    numbers = [few_walks.best_walk(_walked(rows))]
    if campaign.model == "every_walk":
        numbers = [number for number, row in enumerate(rows) if _stood(row)]
    walked = [(rows[number].point, _plan_logs(pool, campaign, number)) for number in numbers]
    ratios = rows[numbers[0]].losses / rows[0].losses
    return grounded_model.model_of(pool, campaign, space, walked, ratios)


def add_walk(
    campaign: Campaign, rows: Sequence[Row], proposal: Proposal, cases: Sequence[ScoredLog]
) -> list[Row]:
    """Append a walk to the history and save it in the folder: first its logs, then its line.

    The logs of a walk that was reported are there already, and mostly its proposal.
    """
    if read_record(campaign)[1] is None:
        _add_proposal(campaign, proposal)
    if not campaign.reported:
        for path, (_, log) in zip(log_paths(campaign, len(rows)), cases, strict=True):
            save_tree(path, log, kind="log", robot=campaign.robot)
    row = row_of(proposal, cases)
    add_row(campaign.folder / RECORD, {"losses": row.losses.tolist(), "margin": row.margin})
    return [*rows, row]


def answer(campaign: Campaign, space: Space, rows: Sequence[Row]) -> tuple[Weights, int]:
    """Return the best weights and the number of their walk; see `few_walks.incumbent`."""
    number = few_walks.incumbent(space, _walked(rows))
    return weights_at(campaign, space, rows[number].point), number


def candidates(pool: Executor, campaign: Campaign, rows: Sequence[Row]) -> dict[str, Weights]:
    """Return the start, each set that was 1 % better than all before it, and that of `answer`."""
    space, history = campaign_space(pool, campaign), _walked(rows)
    losses = np.array([result.loss for result in history])
    better = losses[1:] < np.minimum.accumulate(losses)[:-1] - few_walks.GAIN
    numbers = {0, *(1 + np.flatnonzero(better)), few_walks.incumbent(space, history)}
    return {f"set {n}": weights_at(campaign, space, rows[n].point) for n in sorted(numbers)}


def tune_on_walks(pool: Executor, campaign: Campaign, walks: int) -> list[Row]:
    """Walk and tune on the plants of a campaign, from the walks in its folder on; return all rows.

    Args:
        pool: worker processes.
        campaign: settings, all of whose plants are present.
        walks: budget; whole rounds of all cases are walked, at least the start. If that falls,
            nothing is tuned.

    Raises:
        InputError: see `next_proposal` and `read_record`.
    """
    space, cases = campaign_space(pool, campaign), len(campaign.cases)
    rows, _ = read_record(campaign)
    with bar(f"tuning with {plural(walks, 'walk')}") as report_progress:
        while not rows or (_stood(rows[0]) and (len(rows) + 1) * cases <= walks):
            report_progress(len(rows) * cases, walks, _progress(campaign, space, rows))
            proposal, weights = next_proposal(pool, campaign, space, rows)
            walked = list(pool.map(walk_case, repeat(campaign), repeat(weights), range(cases)))
            rows = add_walk(campaign, rows, proposal, walked)
        report_progress(len(rows) * cases, walks, _progress(campaign, space, rows))
    if campaign.leg_numbers and all(row.method in ("start", "model") for row in rows):
        say(f"{', '.join(campaign.leg_numbers)} were not moved: walks beyond the model are needed")
    if not _stood(rows[0]):
        say("the set from which to tune on walks fell, or a QP was not solved; it is kept as it is")
    return rows


def _stood(row: Row) -> bool:
    """Tell whether no case fell and all QPs were solved."""
    return bool(np.isfinite(row.losses).all())


class Change(NamedTuple):
    """Result of a proposal relative to the start."""

    method: str
    predicted: float | None  # [%] None where nothing was predicted
    change: float | None  # [%] of L; None where the robot fell or a QP was not solved


def changes_by_walk(rows: Sequence[Row]) -> list[Change]:
    """Return the result of each proposal."""

    def percent(loss: float | None) -> float | None:
        return None if loss is None or np.isinf(loss) else 100.0 * float(np.expm1(loss))

    return [Change(row.method, *map(percent, (row.predicted, row.loss))) for row in _walked(rows)]


def _progress(campaign: Campaign, space: Space, rows: Sequence[Row]) -> str:
    if not rows:
        return "compiling"
    best = few_walks.best_walk(_walked(rows))
    change = f"best L {changes_by_walk(rows)[best].change or 0.0:+.0f} % against the start"
    weights = weights_at(campaign, space, rows[best].point)
    logs = np.asarray(steps_between(campaign.start, weights))
    moved = sorted(zip(direction_names(weights), logs, strict=True), key=lambda x: -abs(x[1]))[:3]
    factors = ", ".join(f"{name} {np.exp(log):.2g} times" for name, log in moved)
    return f"{change}; {factors}" if best else change
