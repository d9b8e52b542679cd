"""Does the model's gradient point where the better simulator's does?

Gradients of L in log-weights on the rigid body, through several phi (the command itself, a linear
map, the paper's GRFM-Net, the default one with and without its legs part), against central
differences on the high-fidelity simulator (hfs). The feet share one R: 18 directions.

    python experiments/transfer.py --data data --out runs/transfer

Walks on the hfs are stored under OUT/hfs and used by a later call: walked by MuJoCo C on the
processes, or all at once in MJX where JAX sees an accelerator.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import lib
import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import COMMANDS, Command, named_command, standing_anchor
from hector_jax.control.weights import (
    Weights,
    direction_names,
    directions,
    nominal,
    scale_weights,
    weights_to_vector,
)
from hector_jax.core.console import bar
from hector_jax.core.inputs import plural
from hector_jax.core.pool import workers
from hector_jax.core.settings import check
from hector_jax.core.trajectory import Load
from hector_jax.grfm.effect import Effect, Window, last_command
from hector_jax.grfm.network import as_effect
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.engine import choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs
from hector_jax.store import nets
from hector_jax.store.setup import Setup
from hector_jax.tuning.difftune import TuneConfig, step_status, tune_step
from hector_jax.tuning.rollout import Scenario
from hector_jax.tuning.status import StepStatus
from hector_jax.verdict import judging
from hector_jax.verdict.metrics import Interval

STEP = float(np.log(1.05))  # of the central differences, in log-weights


@dataclass(frozen=True, kw_only=True)
class Flags(lib.Flags):
    """What to compare, at nominal weights."""

    data: Path = Path("data")  # walks and nets; made where missing
    out: Path = Path("runs/transfer")  # folder of the report
    trajectories: tuple[str, ...] = COMMANDS
    phases: tuple[int, ...] = (0, 10, 20, 30)  # gait ticks at which the command starts

    def __post_init__(self) -> None:
        check(self, trajectories=COMMANDS)


class Row(NamedTuple):
    """A phi against the simulator, on a trajectory."""

    cosine: Interval
    wrong: str  # the weight whose entry differs most between the unit gradients
    share: float  # of the squared distance between the unit gradients, due to that weight
    phases: int  # with finite gradients in both


Gradients = Float[np.ndarray, "phases 18"]


def as_directions(weights: Weights, gradient: Weights) -> Float[np.ndarray, "18"]:
    """Convert a gradient in weights to the 18 directions."""
    logs = np.asarray(weights_to_vector(gradient)) * np.asarray(weights_to_vector(weights))
    return directions() @ logs


def slopes(losses: Float[np.ndarray, "*batch 18 2"]) -> Float[np.ndarray, "*batch 18"]:
    """Compute central differences of losses a STEP up and a STEP down."""
    return (losses[..., 0] - losses[..., 1]) / (2.0 * STEP)


def _cosine(model: np.ndarray, simulator: np.ndarray) -> np.ndarray | float:
    """Compute the cosine of the angle between means over phases."""
    a, b = model.mean(axis=-2), simulator.mean(axis=-2)
    return np.sum(a * b, axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))


def compare(model: Gradients, simulator: Gradients) -> Row | None:
    """Compare gradients; phases with a number that is not finite are left out, None if all are.

    The interval redraws the same phases for both. With a handful it is narrow rather than wide, and
    it says nothing of other commands.
    """
    finite = np.isfinite(model + simulator).all(axis=1)
    if not finite.any():
        return None
    model, simulator = model[finite], simulator[finite]
    a, b = (x.mean(axis=0) / np.linalg.norm(x.mean(axis=0)) for x in (model, simulator))
    distances = (a - b) ** 2  # sums to 2 (1 - cosine)
    worst = int(np.argmax(distances))
    share = float(distances[worst] / max(distances.sum(), 1e-12))
    cosine = lib.bootstrap(_cosine, model, simulator)
    return Row(cosine, direction_names()[worst], share, int(finite.sum()))


def _without_legs(effect: jax.tree_util.Partial, window: Window) -> Effect:
    loads = effect(window)
    return loads._replace(legs=Load(*(0.0 * part for part in loads.legs)))


def phis(pool: Executor, robot: Robot, data: Path) -> dict[str, jax.tree_util.Partial]:
    """Return each phi by name; nets are trained if missing."""
    net, paper = (nets.load_or_train(pool, robot, data, name) for name in ("residual", "paper"))
    default = as_effect(net.params)
    effects = {
        "command": last_command,
        "linear": as_effect(net.linear),
        "paper": as_effect(paper.params),
        "net": default,
        "net without legs": jax.tree_util.Partial(_without_legs, default),
    }
    host = partial(jax.tree.map, np.asarray)  # inputs of a process must not be on a device
    return {name: host(effect) for name, effect in effects.items()}


def simulator_gradients(pool: Executor, flags: Flags, robot: Robot) -> dict[str, Gradients]:
    """Return central differences on the hfs by trajectory, NaN where a walk fell."""
    setup, engine, names = (
        Setup(pool, TuneConfig(), robot),
        choose_engine("auto"),
        direction_names(),
    )

    def job(name: str, phase: int, step: np.ndarray) -> Job:
        weights = jax.device_get(scale_weights(nominal(), step))
        return Job(weights, named_command(name), hfs(), start_tick=phase)

    jobs = {
        (name, f"{phase} {direction} {side:+d}", 0): job(name, phase, side * step)
        for name in flags.trajectories
        for phase in flags.phases
        for direction, step in zip(names, STEP * np.eye(len(names)), strict=True)
        for side in (1, -1)
    }
    title = f"{plural(len(jobs), 'walk')} on the high-fidelity simulator, engine {engine.name}"
    folder = flags.out / "hfs"
    walked = judging.score_jobs(setup, jobs, title=title, folder=folder, engine=engine)
    scores = [one.score for one, _ in walked.values()]
    losses = [np.nan if score.fallen else float(score.L) for score in scores]
    shape = len(flags.trajectories), len(flags.phases), len(names), 2
    return dict(zip(flags.trajectories, slopes(np.reshape(losses, shape)), strict=True))


def model_gradients(
    robot: Robot, effect: jax.tree_util.Partial, command: Command, phases: Sequence[int]
) -> Gradients:
    """Return gradients through a phi, NaN where the tuner rejects one; in a worker."""
    config, rows = TuneConfig(), []
    for phase in phases:
        scenario = Scenario(robot, command, standing_anchor(robot, phase), effect)
        evaluation = jax.device_get(tune_step(config, scenario, nominal()))
        row = as_directions(nominal(), evaluation.gradient)
        accepted = step_status(config, evaluation) == StepStatus.ACCEPTED
        rows.append(np.where(accepted, row, np.nan))
    return np.array(rows)


def measure(flags: Flags) -> dict[str, dict[str, Gradients]]:
    """Return gradients by trajectory, then by phi; those of the simulator as "hfs"."""
    robot = jax.tree.map(np.asarray, load_robot())
    with workers(flags.processes) as pool:
        effects = phis(pool, robot, flags.data)
        running = {
            (name, kind): pool.submit(
                model_gradients, robot, effect, named_command(name), flags.phases
            )
            for name in flags.trajectories
            for kind, effect in effects.items()
        }
        truth = simulator_gradients(pool, flags, robot)  # an accelerator walks meanwhile
        with bar("gradients on the rigid body") as report_progress:
            for done, _ in enumerate(as_completed(running.values()), 1):
                report_progress(done, len(running), "")
    return {
        name: {"hfs": truth[name], **{kind: running[name, kind].result() for kind in effects}}
        for name in flags.trajectories
    }


def table(rows: Mapping[str, Mapping[str, Row | None]]) -> str:
    """Return the table by trajectory and phi."""
    lines = []
    for name, by_phi in rows.items():
        for kind, row in by_phi.items():
            cells = ("no phase to compare", "")
            if row is not None:
                cells = (row.cosine.text("{:.2f}".format), f"{row.wrong}, {row.share:.0%}")
            lines.append((name, kind, *cells))
    return markdown_table(("trajectory", "phi", "cosine", "most wrong"), lines, words=2)


def report(flags: Flags, gradients: Mapping[str, Mapping[str, Gradients]]) -> Path:
    """Write the report and its numbers; returns its path."""
    rows = {
        name: {kind: compare(one, each["hfs"]) for kind, one in each.items() if kind != "hfs"}
        for name, each in gradients.items()
    }

    def as_result(row: Row | None) -> Any:
        return row and row._asdict() | {"cosine": row.cosine._asdict()}

    return lib.write_report(
        flags.out / "transfer.json",
        "Does the gradient transfer?",
        [
            "Cosine between the model's gradient of L in 18 log-weights at nominal weights and the "
            "high-fidelity simulator's, by central differences of +-5 %. Both are means over "
            f"{len(flags.phases)} start phases; intervals redraw these, the same ones for both. "
            "`most wrong` names the weight whose entry differs most between the unit gradients, "
            "and its share of their squared distance.",
            table(rows),
        ],
        {
            "weights": direction_names(),
            "phases": flags.phases,
            "rows": {n: {k: as_result(row) for k, row in each.items()} for n, each in rows.items()},
            "gradients": {
                name: {kind: one.tolist() for kind, one in each.items()}
                for name, each in gradients.items()
            },
        },
    )


def main(flags: Flags) -> Path:
    """Write report.md and transfer.json."""
    return report(flags, measure(flags))


if __name__ == "__main__":
    lib.run(main, Flags)
