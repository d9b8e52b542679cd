"""Tuning on walks: the loop of a tuning whose value is walks, whose slope the model's on each.

A weight set walks in each case, a command on a plant; its value is the mean of log L over the
cases. Gradient and Gauss-Newton matrix are those of the rigid body grounded on each of these walks
(tuning/grounded.py), each divided by its loss. Steps, acceptance and stop are those of
`difftune.descend`. A fall counts as a bounded loss of its case and has no slope; the rest still
steers. A set that falls in more cases than the start is refused. Whether a simulator (`walk_all`)
or a real robot (`added_logs`) walks, all that the loop uses is in a folder, so that it begins
anew in each call and no walk is made twice:

- `walks.jsonl`: the settings, then a line for each weight set that has walked.
- `weights/3.json`: the weights of set 3.
- `logs/3-0.npz`: its log in case 0, at the plan interval, or the file that was added.
- `logs/3-KP-0.npz`: the same with the number KP moved, or a group of weights (`moved`).
- `kept/logs/3-0.npz`: the same of a command to keep (`kept`).
- `starts/with`: the same of a set that was tried as the start.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import replace
from functools import partial
from itertools import product, repeat
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control import parameters
from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import load_weights, save_weights, weights_tree
from hector_jax.core.console import bar, say
from hector_jax.core.environment import code_hash
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.journal import continue_journal, write_rows
from hector_jax.core.trajectory import no_samples
from hector_jax.core.tree_file import load_tree, save_tree, tree_hash
from hector_jax.own.walk_log import Log, ScoredLog, evaluate_log, log_of, walker_hash
from hector_jax.sim.loop import Job
from hector_jax.store.cache import content_key, robot_hash
from hector_jax.tuning import difftune
from hector_jax.tuning.difftune import Iteration, TuneState, step_status
from hector_jax.tuning.evaluate import Evaluation, Objective
from hector_jax.tuning.status import StepStatus
from hector_jax.walk_tuning.campaign import Campaign
from hector_jax.walk_tuning.kept import Kept, compare_kept
from hector_jax.walk_tuning.moved import Moved, MovedWalks
from hector_jax.walk_tuning.slopes import slope_of_walk

RECORD = "walks.jsonl"
_FALL = 1.0  # log L of a fall above the largest of the start


class WalkedSet(NamedTuple):
    """A weight set that has walked."""

    weights: Weights
    losses: Float[np.ndarray, " cases"]  # L; infinite where the robot fell or a QP was not solved
    accepted: bool  # as a step of the tuning
    kept: Float[np.ndarray, " walks"] | None = None  # L of the commands to keep; None: not walked

    @property
    def fell(self) -> Bool[np.ndarray, " cases"]:
        """True where the robot fell or a QP was not solved."""
        return ~np.isfinite(self.losses)


class WalkTuning(NamedTuple):
    """The sets that have walked, and what comes next."""

    sets: list[WalkedSet]  # the start first
    waiting: Weights | None  # the set whose walks are waited for
    reason: str  # why the tuning ended; empty if it has not
    keep: tuple[str, ...] = ()  # names of the commands to keep

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The sets as JSON values: mean change of log L against the start [%], falls, step."""
        rows = [
            {"change": change, "falls": int(x.fell.sum()), "accepted": x.accepted}
            for change, x in zip(changes(self.sets), self.sets, strict=True)
        ]
        for number, row in enumerate(rows):
            if kept := self.kept(number):
                row["kept"] = {name: x._asdict() for name, x in kept.items()}
        return rows

    def kept(self, number: int) -> dict[str, Kept]:
        """Return what a set does to the commands to keep; empty if they have not walked."""
        start, losses = (self.sets[i].kept for i in (0, number))
        if start is None or losses is None:
            return {}
        return compare_kept(self.keep, start, losses)

    @property
    def best(self) -> int:
        """Number of the last accepted set."""
        return max((i for i, x in enumerate(self.sets) if x.accepted), default=0)


class Waiting(Exception):  # noqa: N818
    """The walks of a weight set have not been made yet."""


class Spent(Exception):  # noqa: N818
    """No walks are left for another set."""


Ask = Callable[[int, Weights], Sequence[ScoredLog]]
"""Returns the scored logs of a set by its number, one for each case, or raises `Waiting`."""


def changes(sets: Sequence[WalkedSet]) -> list[float | None]:
    """Return the mean change of log L against the start [%], over the cases in which both stood."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = [np.log(x.losses / sets[0].losses) for x in sets]
    both = [x[np.isfinite(x)] for x in logs]
    return [100.0 * float(np.expm1(x.mean())) if x.size else None for x in both]


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


def first_slope(campaign: Campaign) -> None:
    """Compile the programs of the tuning, of which this walk is none, into the cache."""
    slope_of_walk(campaign, campaign.start, 0, walk_case(campaign, campaign.start, 0).log)


# The objective


def bounded_logs(
    losses: Float[np.ndarray, "*cases"], known: Float[np.ndarray, "*others"]
) -> Float[np.ndarray, "*cases"]:
    """Return log L, that of a fall and of what is worse a bound above the largest known one."""
    worst = np.exp(_FALL) * known[np.isfinite(known)].max(initial=1.0)
    return np.log(np.where(np.isfinite(losses), np.minimum(losses, worst), worst))


class _Walks:
    """The objective of `difftune.descend` on walks; remembers the sets."""

    def __init__(
        self, pool: Executor, campaign: Campaign, ask: Ask, walks: int | None = None
    ) -> None:
        self.pool, self.campaign, self.ask = pool, campaign, ask
        self.losses: list[np.ndarray] = []
        self.kept: dict[int, np.ndarray] = {}  # by set
        self.left = np.inf if walks is None else walks
        self.state: TuneState | None = None
        self.moved = MovedWalks(campaign.along)

    def place(self, state: TuneState) -> TuneState:
        """Return the state at the set that has walked, should the code place it elsewhere.

        Raises:
            Spent: it cannot walk.
        """
        if self.left < self.campaign.set_walks:
            raise Spent
        self.state = self._placed(state)
        return self.state

    def _placed(self, state: TuneState) -> TuneState:
        path = weights_path(self.campaign.folder, len(self.losses))
        config = self.campaign.config
        trial = jax.device_get(difftune.trial_weights(config, state))
        if not path.exists():
            save_weights(path, trial)
        there = load_weights(path, self.campaign.robot)
        if there.others.keys() != trial.others.keys():
            names, got = (", ".join(sorted(w.others)) or "none" for w in (trial, there))
            raise InputError(f"{path}: others must be those of the start, {names}; got {got}")
        if jax.tree.all(jax.tree.map(np.array_equal, there, trial)):
            return state
        steps = parameters.steps_between(state.start, there, config.others)
        return state._replace(steps=jnp.asarray(steps))

    def slope(self, weights: Weights) -> tuple[Evaluation, Float[np.ndarray, "n n"]]:
        """Walk a set; value and slope of the mean of log L."""
        campaign, number = self.campaign, len(self.losses)
        logs = self.ask(number, weights)
        self.left -= len(logs)
        losses = np.array([walked.loss for walked in logs])
        stood = np.isfinite(losses)
        self.losses.append(losses)
        value = float(np.exp(bounded_logs(losses, self.losses[0]).mean()))
        gains = self._gains(weights, value)
        refused = stood.sum() < np.isfinite(self.losses[0]).sum()
        refused = refused or bool(gains and stood.any() and self._breaks(weights))
        # a slope takes as long as a walk
        on = np.flatnonzero(stood).tolist() if gains and not refused else []
        some = [logs[case].log for case in on]
        if on:
            self._move(weights, dict(zip(on, some, strict=True)))
        moved = [self.moved.of_case(case) for case in on]
        found = list(
            self.pool.map(slope_of_walk, repeat(campaign), repeat(weights), on, some, moved)
        )
        errors = [x for x in found if isinstance(x, InputError)]
        if errors and len(errors) == len(found) and not number:
            raise errors[0]
        for error in errors:
            say(f"a walk without its slope: {error}")
        slopes = [x for x in found if not isinstance(x, InputError)]
        usable = [x for x in slopes if step_status(campaign.config, x[0]) == StepStatus.ACCEPTED]
        shares = [value / len(losses) / float(found.loss) for found, _ in usable]

        def mean(trees: Sequence[Any]) -> Any:
            return jax.tree.map(lambda *x: np.tensordot(shares, x, axes=1), *trees)

        numbers = len(parameters.step_names(weights, campaign.config.others))
        gradient, matrix = jax.tree.map(np.zeros_like, weights), np.zeros((numbers, numbers))
        residual, fallen = np.zeros(()), np.asarray(float(gains and not usable))
        if usable:
            gradient, matrix = mean([(found.gradient, curved) for found, curved in usable])
            residual = np.max([found.residual for found, _ in usable])
            self.moved.matrix = matrix
        return Evaluation(np.asarray(value), {}, gradient, fallen, np.asarray(residual)), matrix

    def _gains(self, weights: Weights, value: float) -> bool:
        """Return whether a set is accepted if it falls no more often than the start."""
        zero = np.zeros(())
        found = Evaluation(np.asarray(value), {}, jax.tree.map(np.zeros_like, weights), zero, zero)
        if self.state is None:  # nothing to compare with
            return True
        status = difftune.trial_status(self.campaign.config, self.state, found)
        return int(status) == StepStatus.ACCEPTED

    def _breaks(self, weights: Weights) -> bool:
        """Walk the commands to keep; return whether one is worse than with the start."""
        if not self.campaign.kept:
            return False
        one, number = self.campaign.of_kept, len(self.losses) - 1
        losses = np.array([walked.loss for walked in walk_all(self.pool, one, number, weights)])
        self.left -= len(losses)
        self.kept[number] = losses
        found = compare_kept([*one.commands], self.kept[0], losses)
        return any(x.broken for x in found.values())

    def _move(self, weights: Weights, stood: Mapping[int, Log]) -> None:
        """Walk a set again along the directions, unless no walks are left for a set after that."""
        campaign, number = self.campaign, len(self.losses) - 1
        due = self.moved.due(number)
        if self.left < len(due) * len(stood) + campaign.set_walks:
            return
        self.left -= len(due) * len(stood)
        back = {c for c in stood if (c + c // len(campaign.commands)) % 2}
        each, others = list(product(due, stood)), campaign.config.others
        nudges = [
            parameters.nudged(weights, others, of.at, -of.size if case in back else of.size)
            for of, case in each
        ]
        sets = {
            (f"{number}-{of.name}", case): x
            for (of, case), (x, _) in zip(each, nudges, strict=True)
        }
        found = walk_sets(self.pool, campaign, sets).values()
        for (of, case), (_, step), walked in zip(each, nudges, found, strict=True):
            self.moved.sets[of.name] = number
            if np.isfinite(walked.loss):
                self.moved.walks[of.name, case] = Moved(of.at, step, stood[case], walked.log)


def tune_on_walks(
    pool: Executor, campaign: Campaign, ask: Ask | None = None, walks: int | None = None
) -> WalkTuning:
    """Tune on the walks of a campaign, from those in its folder on.

    Args:
        pool: worker processes.
        campaign: the settings.
        ask: makes the walks of a set; by default the engine of the campaign does.
        walks: budget, of those with numbers moved too; whole sets walk in all cases. None: the
            iterations of the settings.

    Returns:
        The sets; if the start falls in all cases it alone.

    Raises:
        InputError: the folder holds the record of another campaign, or a damaged one.
    """
    head = record_head(campaign)
    continue_journal(campaign.folder / RECORD, head, "a tuning on walks", dict, remedy(campaign))
    config, cases = campaign.config, len(campaign.cases)
    if walks is not None:
        config = replace(config, iterations=max(walks // cases - 1, 1))
    objective = _Walks(pool, campaign, ask or partial(walk_all, pool, campaign), walks)
    sets: list[WalkedSet] = []
    keep = tuple(campaign.kept)
    with bar(f"tuning on walks, {plural(cases, 'case')}") as report_progress:

        def write_record() -> None:
            rows = [{"losses": x.losses.tolist(), "accepted": x.accepted} for x in sets]
            for row, x in zip(rows, sets, strict=True):
                row |= {} if x.kept is None else {"kept": x.kept.tolist()}
            write_rows(campaign.folder / RECORD, [head, *rows])

        def on_iteration(iteration: Iteration) -> None:
            losses = objective.losses[-1]
            kept = objective.kept.get(len(sets))
            sets.append(WalkedSet(iteration.weights, losses, bool(iteration.accepted), kept))
            write_record()
            best = WalkTuning(sets, None, "").best
            remark = f"L {changes(sets)[best] or 0.0:+.0f} % against the start"
            report_progress(len(sets), config.iterations + 1, remark)

        report_progress(0, config.iterations + 1, "compiling")
        try:
            loss = Objective(objective.slope, objective.place)
            tuning = difftune.descend(config, campaign.start, loss, on_iteration)
        except Waiting:
            write_record()  # without sets whose logs were taken back
            waiting = load_weights(weights_path(campaign.folder, len(sets)), campaign.robot)
            return WalkTuning(sets, waiting, "", keep)
        except Spent:
            reason = f"no more of its {plural(walks or 0, 'walk')} are left"
            return WalkTuning(sets, None, reason, keep)
        except InputError:
            if sets and not sets[0].accepted:
                reason = "the start fell or was not solved in all walks"
                return WalkTuning(sets, None, reason, keep)
            raise
    return WalkTuning(sets, None, tuning.reason, keep)


def remedy(campaign: Campaign) -> str:
    """Return what to do with a folder of another campaign."""
    anew = f" and begin anew with hector propose --start {campaign.folder}/weights/N.json"
    return f"choose another folder{anew * campaign.by_logs}"


def record_head(campaign: Campaign) -> dict[str, Any]:
    """Return what identifies a campaign, as JSON values."""
    head: dict[str, Any] = {
        "format": 4,
        "start": weights_tree(campaign.start),
        "commands": {name: tree_hash(command) for name, command in campaign.commands.items()},
        "plants": [plant and tree_hash(plant) for plant in campaign.plants],
        "numbers": list(map(parameters.name_of, campaign.config.others)),
        "seconds": campaign.seconds,
    }
    if campaign.by_logs:  # data: neither code nor loss can make them those of another campaign
        return head | {"robot": walker_hash(campaign.robot)}
    settings = replace(campaign.config, iterations=1)  # with a larger budget it goes on
    return head | {
        "robot": robot_hash(campaign.robot),
        "slopes": "walks" if campaign.groups else "plans",
        "kept": {name: tree_hash(command) for name, command in campaign.kept.items()},
        "settings": content_key(settings, campaign.start, code=()),
        "engine": campaign.engine.key,
        "code": code_hash(("walk_tuning.walks", *campaign.engine.modules)),
    }


def walk_sets(
    pool: Executor, campaign: Campaign, sets: Mapping[tuple[str, int], Weights]
) -> dict[tuple[str, int], ScoredLog]:
    """Walk sets, by name and case, and keep each walk in the folder as it ends."""
    robot = campaign.robot
    like = ScoredLog(0.0, log_of(no_samples(len(robot.joint_lower), len(robot.foot_point))))
    paths = {(name, case): log_paths(campaign, name)[case] for name, case in sets}
    missing = [at for at, path in paths.items() if not path.exists()]
    running = {pool.submit(walk_case, campaign, sets[at], at[1]): at for at in missing}
    for job in as_completed(running):
        save_tree(paths[running[job]], job.result(), kind="log", robot=robot)
    return {at: load_tree(x, like, kind="log", robot=robot)[0] for at, x in paths.items()}


def walk_all(
    pool: Executor, campaign: Campaign, number: int, weights: Weights
) -> Sequence[ScoredLog]:
    """Walk a set in all cases."""
    cases = range(len(campaign.cases))
    return list(walk_sets(pool, campaign, {(str(number), c): weights for c in cases}).values())


def weights_path(folder: Path, number: int) -> Path:
    """Return the file of the weights of a set in the folder of a campaign."""
    return folder / "weights" / f"{number}.json"


def log_paths(campaign: Campaign, name: int | str) -> list[Path]:
    """Return the files of the logs of a set, one for each case."""
    names = [f"{name}-{case}.npz" for case in range(len(campaign.cases))]
    return [campaign.folder / "logs" / name for name in names]
