"""Prediction errors of phi: of the ground wrench, and of the body's motion.

Errors of the wrench by axis and by the phase of the step; and open-loop prediction: from recorded
states, the rigid body is simulated for up to 0.4 s under the recorded commands through phi, and
compared with the recorded motion. The row `measured` applies the measured wrench: its remaining
error is not due to the ground, but to modelling a robot with legs as a rigid body.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hector_jax.control import gait
from hector_jax.control.controller import walk_config
from hector_jax.core.arrays import Array
from hector_jax.core.files import write_file, write_json
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import State, Trajectory, Wrench
from hector_jax.grfm.dataset import Dataset, make_dataset
from hector_jax.grfm.effect import HISTORY, Window, from_yaw_frame, turn
from hector_jax.grfm.training import predict
from hector_jax.report.report import WORLDS, Picture, render
from hector_jax.robot import srbm
from hector_jax.robot.model import Robot
from hector_jax.store.run import RESULT

PHASES = {  # time [s] since the switch of stance
    "first 30 ms": (0.0, 0.03),
    "middle": (0.03, 0.15),
    "last 50 ms": (0.15, np.inf),
}
HORIZONS = (0.2, 0.4)  # [s]
FIRST, SPACING = 5, 35  # ticks: start of the first prediction in a walk; between starts

_UNITS = {"force": "N^2", "moment": "(N m)^2"}
_AXES = {f"{kind[0].upper()}_{axis}": kind for kind in _UNITS for axis in "xyz"}


class Drift(NamedTuple):
    """RMS error of open-loop predictions by time ahead; NaN if no walk stays upright so long."""

    time: Float[np.ndarray, " ticks"]  # [s]
    position: Float[np.ndarray, " ticks"]  # [m], distance of the centres of mass
    euler: Float[np.ndarray, " ticks"]  # [rad], all three angles


def _mean(rows: np.ndarray) -> np.ndarray:
    """Return the mean over the rows; NaN, without a warning, if there are none."""
    return rows.mean(axis=0) if len(rows) else np.full(rows.shape[1:], np.nan)


def by_phase(
    effects: Mapping[str, jax.tree_util.Partial], dataset: Dataset
) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Compute mean square errors by phi, phase of the step and planned contact, per axis.

    Returns:
        `[phi][phase]["stance" | "swing"]`: F_x F_y F_z [N^2], M_x M_y M_z [(N m)^2]; NaN if no
        sample is in the phase.
    """
    since, stance = dataset.window.since_switch[:, None], np.asarray(dataset.window.contact)
    window = jax.tree.map(jnp.asarray, dataset.window)
    errors: dict[str, dict[str, dict[str, list[float]]]] = {name: {} for name in effects}
    for name, effect in effects.items():
        pairs = zip(predict(effect, window).wrench, dataset.label, strict=True)
        square = np.concatenate([np.square(np.asarray(x) - label) for x, label in pairs], axis=-1)
        for phase, (low, high) in PHASES.items():
            inside = (since > low - 1e-6) & (since < high - 1e-6)
            errors[name][phase] = {
                "stance": _mean(square[inside & stance]).tolist(),
                "swing": _mean(square[inside & ~stance]).tolist(),
            }
    return errors


def _predict_states(
    robot: Robot,
    effect: jax.tree_util.Partial | None,
    walk: Trajectory,
    start_tick: Int[Array, ""],
    first: Int[Array, ""],
    *,
    config: gait.GaitConfig,
    ticks: int,
) -> State:
    """Simulate the rigid body; return its states at the ends of `ticks` ticks from `first` on."""

    def step(state: State, j: Int[Array, ""]) -> tuple[State, State]:
        yaw = state.euler[2]
        if effect is None:
            ground, push = jax.tree.map(lambda w: w[j], walk.effect), None
        else:
            past = j - jnp.arange(HISTORY)
            window = Window(
                commands=turn(jax.tree.map(lambda w: w[past], walk.command), -yaw),
                contact=walk.contact[j],
                since_switch=gait.since_switch(config, start_tick + j),
                base=from_yaw_frame(state),
            )
            effects = effect(window)
            ground, push = turn(effects.wrench, yaw), turn(effects.legs, yaw)
        feet = 0.5 * (walk.feet[j - 1] + walk.feet[j])
        state = srbm.step(robot, state, ground, feet, config.tick, load=push)
        return state, state

    initial = jax.tree.map(lambda s: s[first - 1], walk.state)
    return jax.lax.scan(step, initial, first + jnp.arange(ticks))[1]


def drift(
    robot: Robot,
    effect: jax.tree_util.Partial | None,
    walks: Trajectory,
    start_tick: Int[np.ndarray, " W"],
) -> Drift:
    """Compute open-loop prediction errors of a phi over walks at the plan interval.

    Args:
        robot: the rigid body.
        effect: phi; None applies the measured wrench.
        walks: W walks of T ticks; ticks after a fall are excluded.
        start_tick: gait tick of their t = 0.

    Raises:
        InputError: the walks are too short.
    """
    config = walk_config(robot).gait
    ticks = round(HORIZONS[-1] / config.tick)
    fallen = np.asarray(walks.fallen)
    starts = np.arange(FIRST, fallen.shape[1] - ticks + 1, SPACING)
    if not len(starts):
        raise InputError(f"walks of {fallen.shape[1]} ticks are too short to predict {ticks} ticks")

    predict_walk = partial(_predict_states, robot, config=config, ticks=ticks)
    over_starts = jax.vmap(predict_walk, in_axes=(None, None, None, 0))
    predicted = jax.jit(jax.vmap(over_starts, in_axes=(None, 0, 0, None)))(
        effect, jax.tree.map(jnp.asarray, walks), jnp.asarray(start_tick), jnp.asarray(starts)
    )
    spans = starts[:, None] + np.arange(ticks)
    upright = ~fallen[:, spans].any(axis=-1)

    def rms(name: str) -> Float[np.ndarray, " ticks"]:
        error = np.asarray(getattr(predicted, name)) - getattr(walks.state, name)[:, spans]
        return np.sqrt(_mean(np.sum(error**2, axis=-1)[upright]))

    return Drift(config.tick * np.arange(1, ticks + 1), rms("position"), rms("euler"))


def as_result(
    errors: Mapping[str, Mapping[str, Any]], phases: Mapping[str, Any], drifts: Mapping[str, Drift]
) -> dict[str, Any]:
    """Return all errors of one world as JSON values; `errors` is from `training.errors_by_phi`."""

    def at(horizon: float, drift: Drift) -> dict[str, float]:
        parts = {"position": drift.position, "euler": drift.euler}
        return {name: float(np.interp(horizon, drift.time, x)) for name, x in parts.items()}

    open_loop = {
        name: {f"{horizon:g} s": at(horizon, drift) for horizon in HORIZONS}
        for name, drift in drifts.items()
    }
    return {"errors": dict(errors), "phases": dict(phases), "open_loop": open_loop}


def curves(
    robot: Robot, walk: Trajectory, effects: Mapping[str, jax.tree_util.Partial]
) -> dict[str, Wrench]:
    """Return commanded, predicted and measured wrenches of a walk, for a picture.

    Point feet have no moments in any of them.

    Args:
        robot: the body that walked.
        walk: at the plan interval.
        effects: phis by name; `linear`, `paper` and `residual` are used, the last as `predicted`.

    Returns:
        Wrenches (ticks, feet, 3) in the yaw frame, from t = 0; NaN at ticks without a sample.
    """
    samples, _ = make_dataset(robot, jax.tree.map(lambda x: np.asarray(x)[None], walk))
    window = jax.tree.map(jnp.asarray, samples.window)
    wrenches = {
        "commanded": jax.tree.map(lambda w: w[:, 0], samples.window.commands),
        "measured": samples.label,
    }
    for name, label in (("linear", "linear"), ("paper", "paper"), ("residual", "predicted")):
        if name in effects:
            wrenches[label] = predict(effects[name], window).wrench

    def by_tick(values: Any) -> np.ndarray:
        """Place values by tick; NaN at the first ticks, unsolved ones and those after a fall."""
        rows = np.full((len(walk.fallen), *values.shape[1:]), np.nan)
        rows[samples.tick] = values
        return rows

    return {name: jax.tree.map(by_tick, wrench) for name, wrench in wrenches.items()}


def write_net_report(
    folder: Path, worlds: Mapping[str, Mapping[str, Any]], pictures: Sequence[Picture]
) -> Path:
    """Write report.md on the nets' prediction errors, and the same numbers as result.json.

    Args:
        folder: folder of the pictures.
        worlds: results of `as_result` by world.
        pictures: pictures to show.

    Returns:
        report.md.
    """
    values = {"worlds": worlds, "pictures": pictures, "WORLDS": WORLDS, "PHASES": PHASES}
    text = render("fidelity.md.j2", **values, error_rows=error_rows)
    write_file(folder / "report.md", text.encode())
    write_json(folder / RESULT, worlds)
    return folder / "report.md"


def error_rows(errors: Iterable[Mapping[str, Any]]) -> list[tuple[str, list[float]]]:
    """Return labelled mean square errors: of force and moment, by contact and axis, of touchdowns.

    What is zero for every phi, such as the moments of point feet, is left out.

    Args:
        errors: results of `training.errors_by_phi`, one per phi.
    """
    errors = list(errors)
    rows = [(f"{kind}, all [{unit}]", [x[kind] for x in errors]) for kind, unit in _UNITS.items()]
    for contact in ("stance", "swing"):
        for i, (axis, kind) in enumerate(_AXES.items()):
            rows.append((f"{axis}, {contact} [{_UNITS[kind]}]", [x[contact][i] for x in errors]))
    if all(any(x.get("touchdown", ())) for x in errors):
        for i, axis in enumerate(("forward", "sideways")):
            rows.append((f"touchdown, {axis} [cm^2]", [x["touchdown"][i] for x in errors]))
    return [row for row in rows if any(row[1])]
