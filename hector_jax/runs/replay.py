"""Dumps of evaluations that a tuning rejected, so that they can be repeated.

A step of a tuning is rejected if the walk falls, a QP is not solved or a number is not finite. Its
dump holds all inputs of the evaluation (robot, weights, command, anchor, net and settings) and its
result; `replay` repeats the evaluation and tells whether the result is the same.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.control.reference import Anchor, Command, standing_anchor
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.console import say
from hector_jax.core.environment import environment
from hector_jax.core.files import WriteError
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import from_table, to_table
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree_file import load_tree, read_card, save_tree
from hector_jax.grfm.network import Params, effect_of, layout, variant_of
from hector_jax.robot.description import Description
from hector_jax.robot.model import Robot, Structure, load_robot
from hector_jax.tuning.difftune import (
    Iteration,
    TuneConfig,
    rejection_reason,
    step_status,
    tune_step,
)
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.rollout import rollout, variation_of
from hector_jax.tuning.status import StepStatus

MOST = 3
"""Most dumps of a tuning per reason, so that many rejections do not fill the disk."""

_KIND = "refused evaluation"


class Dump(NamedTuple):
    """Inputs of an evaluation, except its settings, and its result."""

    robot: Robot
    weights: Weights
    command: Command
    anchor: Anchor
    params: Params | None  # of the net; None: the plain rigid body
    seen: Evaluation


class Replay(NamedTuple):
    """Result of repeating the evaluation of a dump."""

    name: str  # of the tuning
    iteration: int
    recorded: dict[str, Any]  # reason and numbers
    again: dict[str, Any]  # reason and numbers of the repetition
    first: dict[str, int | None]  # first tick of the repetition not finite, fallen or unsolved
    same: bool  # to the last bit, the gradient included
    changed: dict[str, list[str | None]]  # versions and machine that differ: then and now

    @property
    def verdict(self) -> str:
        """Sentence: whether the results are the same, and which versions or machines differ."""
        if self.same:
            return "the same to the last bit"
        then, now = self.recorded["reason"], self.again["reason"]
        what = "the same reason, other numbers" if then == now else f"now {now or 'not refused'}"
        changes = [f"{name} {a or '-'} -> {b or '-'}" for name, (a, b) in self.changed.items()]
        made = f"changed since: {', '.join(changes)}" if changes else "same versions, same machine"
        return f"not reproduced: {what}; {made}"


def keep(
    folder: Path,
    name: str,
    iteration: Iteration,
    *,
    config: TuneConfig,
    robot: Robot,
    command: Command,
    net: Params | None,
) -> Path | None:
    """Write a dump of an iteration whose evaluation was rejected.

    The first `MOST` of a tuning are written for each reason. If the folder cannot be written, one
    line on stderr says so and the tuning goes on.

    Args:
        folder: folder of the dumps.
        name: name of the tuning.
        iteration: any iteration of the tuning; nothing is written for accepted ones.
        config, robot, command, net: inputs of the tuning, which starts from standing.

    Returns:
        The file, or None if nothing was written.
    """
    code = StepStatus(int(step_status(config, iteration.evaluation)))
    kind = code.name.lower().replace("_", "-")
    if code is StepStatus.ACCEPTED or len(list(folder.glob(f"{name}-*-{kind}.npz"))) >= MOST:
        return None
    path = folder / f"{name}-{iteration.iteration:03d}-{kind}.npz"
    weights, anchor = iteration.weights, standing_anchor(robot)
    dump = Dump(robot, weights, command, anchor, net, iteration.evaluation)
    variant = None if net is None else variant_of(net)
    about = {
        "name": name,
        "iteration": int(iteration.iteration),
        "reason": iteration.reason,
        "others": list(weights.others),
        "net": variant and {"variant": variant.name, "hidden": variant.widths(net)},
        "config": config.as_table(),
        "description": to_table(robot.description),
        "structure": to_table(robot.structure),
        "environment": environment(),
    }
    try:
        save_tree(path, dump, kind=_KIND, robot=robot, about=about)
    except WriteError as error:
        say(f"a refused step was not recorded: {error}")
        return None
    say(f"{name}, iteration {iteration.iteration}: {iteration.reason}; see hector replay {path}")
    return path


def load(path: Path) -> tuple[Dump, TuneConfig, dict[str, Any]]:
    """Load a dump with its settings and the notes on its card.

    Raises:
        InputError: one line naming the file that is damaged, not a dump or of another version.
    """
    about = read_card(path, _KIND)["about"]
    net, none, hector = about.get("net"), np.zeros(()), load_robot()
    try:
        description = from_table(f"{path}: description", Description, about.get("description", {}))
        before = to_table(hector.structure)  # of files without this entry
        structure = from_table(f"{path}: structure", Structure, about.get("structure", before))
        config = TuneConfig.from_table(f"{path}: config", about.get("config"))
        walk = config.rollout.walk
        params = None if net is None else layout(net["variant"], tuple(net["hidden"]), walk)
        weights = config.rollout.walk.with_others(nominal(), about.get("others", ()))
    except InputError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: settings that this version does not know: {error!r}") from error
    terms = {term.name: none for term in config.loss}
    # axes of length 0 stand for any number of feet and joints
    robot, weights = jax.tree.map(lambda x: np.zeros((0,) * np.ndim(x)), (hector, weights))
    like = Dump(
        robot._replace(description=description, structure=structure),
        weights,
        Command(np.zeros(0), np.zeros((0, 2)), np.zeros(0)),
        Anchor(np.zeros(3), none, none),
        params,
        Evaluation(none, terms, weights, none, none),
    )
    dump, _ = load_tree(path, like, kind=_KIND)
    return dump, config, about


def replay(path: Path) -> Replay:
    """Repeat the evaluation of a dump.

    Raises:
        InputError: JAX computes on another device than the CPU; or see `load`.
    """
    dump, config, about = load(path)
    if jax.default_backend() != "cpu":  # the dump is from a CPU, whose program a GPU does not trace
        raise InputError("replaying needs JAX on the CPU (JAX_PLATFORMS=cpu)")
    inputs = *dump[:4], effect_of(dump.params, config.rollout.walk)
    evaluation = jax.device_get(tune_step(config, *inputs))
    walk = partial(jax.jit(rollout, static_argnums=0), config.rollout)
    trajectory = jax.device_get(walk(*inputs, variation_of(dump.robot)))
    same = jax.tree.map(partial(np.array_equal, equal_nan=True), dump.seen, evaluation)
    then, now = about["environment"], environment()
    machines = {name: [then.get(name), now.get(name)] for name in sorted(then.keys() | now.keys())}
    return Replay(
        name=about["name"],
        iteration=about["iteration"],
        recorded=_summary(about["reason"], dump.seen),
        again=_summary(rejection_reason(config, evaluation), evaluation),
        first=_first_ticks(config, trajectory),
        same=all(jax.tree.leaves(same)),
        changed={name: [a, b] for name, (a, b) in machines.items() if a != b},
    )


def _summary(reason: str, evaluation: Evaluation) -> dict[str, Any]:
    """Return the reason and the numbers of an evaluation."""
    numbers = {
        "loss": evaluation.loss,
        **evaluation.terms,
        "gradient": max(np.max(np.abs(g)) for g in jax.tree.leaves(evaluation.gradient)),
        "fallen": evaluation.fallen,
        "residual": evaluation.residual,
    }
    return {"reason": reason, **{name: float(x) for name, x in numbers.items()}}


def _first_ticks(config: TuneConfig, trajectory: Trajectory) -> dict[str, int | None]:
    """Return the first tick of each fault; None if there is none."""
    series = *trajectory.state, *trajectory.command
    rows = [np.reshape(x, (len(trajectory.fallen), -1)) for x in series]
    faults = {
        "not finite": ~np.isfinite(np.hstack(rows)).all(axis=1),
        "fallen": trajectory.fallen,
        "unsolved": ~(trajectory.residual <= config.residual),
    }
    return {name: int(np.argmax(at)) if at.any() else None for name, at in faults.items()}


def in_words(replayed: Replay) -> str:
    """Format the recorded and the repeated numbers as a table, with the verdict."""
    labels = {"gradient": "largest gradient", "fallen": "share fallen", "residual": "QP residual"}
    cell = lambda x: x if isinstance(x, str) else f"{x:.17g}"  # noqa: E731
    lines = [f"{replayed.name}, iteration {replayed.iteration}", f"{'':18s}{'recorded':32s}again"]
    for name, value in replayed.recorded.items():
        lines.append(f"{labels.get(name, name):18s}{cell(value):32s}{cell(replayed.again[name])}")
    for name, tick in replayed.first.items():
        lines.append(f"{f'first {name}':18s}{'':32s}{'never' if tick is None else f'tick {tick}'}")
    return "\n".join([*lines, replayed.verdict])
