"""How well a phi predicts what the ground returns, and where the body goes.

Errors of the wrench by axis and by the phase of the step; and open-loop prediction: from recorded
states, the rigid body is moved for up to 0.4 s under the recorded commands through phi, and
compared with where the robot was. The row `measured` moves it by the measured wrench: the error
that is left there is not due to the ground, but to a rigid body standing for a robot with legs.
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
from hector_jax.runs.folder import RESULT

PHASES = {  # time [s] since the switch of stance
    "first 30 ms": (0.0, 0.03),
    "middle": (0.03, 0.15),
    "last 50 ms": (0.15, np.inf),
}
HORIZONS = (0.2, 0.4)  # [s]
FIRST, APART = 5, 35  # ticks: of the first prediction in a walk, and from one to the next

_UNITS = {"force": "N^2", "moment": "(N m)^2"}
_AXES = {f"{kind[0].upper()}_{axis}": kind for kind in _UNITS for axis in "xyz"}


class Drift(NamedTuple):
    """RMS error of open-loop predictions by time ahead; NaN where no walk stayed up so long."""

    time: Float[np.ndarray, " ticks"]  # [s]
    position: Float[np.ndarray, " ticks"]  # [m], distance of the centres of mass
    euler: Float[np.ndarray, " ticks"]  # [rad], all three angles


def _mean(rows: np.ndarray) -> np.ndarray:
    """Mean over the rows; NaN, without a warning, where there are none."""
    return rows.mean(axis=0) if len(rows) else np.full(rows.shape[1:], np.nan)


def by_phase(
    effects: Mapping[str, jax.tree_util.Partial], dataset: Dataset
) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Mean square errors by phi, phase of the step and planned contact, per axis.

    Returns:
        `[phi][phase]["stance" | "swing"]`: F_x F_y F_z [N^2], M_x M_y M_z [(N m)^2]; NaN where no
        sample is in the phase.
    """
    since, stands = dataset.window.since_switch[:, None], np.asarray(dataset.window.contact)
    errors: dict[str, dict[str, dict[str, list[float]]]] = {name: {} for name in effects}
    for name, effect in effects.items():
        guess = predict(effect, jax.tree.map(jnp.asarray, dataset.window)).wrench
        pairs = zip(guess, dataset.label, strict=True)
        square = np.concatenate([np.square(np.asarray(g) - y) for g, y in pairs], axis=-1)
        for phase, (low, high) in PHASES.items():
            inside = (since > low - 1e-6) & (since < high - 1e-6)
            places = {"stance": inside & stands, "swing": inside & ~stands}
            errors[name][phase] = {c: _mean(square[rows]).tolist() for c, rows in places.items()}
    return errors


def _ahead(
    config: gait.GaitConfig,
    robot: Robot,
    ticks: int,
    effect: jax.tree_util.Partial | None,
    walk: Trajectory,
    start_tick: Int[Array, ""],
    first: Int[Array, ""],
) -> State:
    """States of the rigid body at the ends of `ticks` ticks from `first` on."""

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
        later = srbm.step(robot, state, ground, feet, config.tick, push)
        return later, later

    begin = jax.tree.map(lambda s: s[first - 1], walk.state)
    return jax.lax.scan(step, begin, first + jnp.arange(ticks))[1]


def drift(
    robot: Robot,
    effect: jax.tree_util.Partial | None,
    walks: Trajectory,
    start_tick: Int[np.ndarray, " W"],
) -> Drift:
    """Open-loop prediction errors of a phi over walks at the plan interval.

    Args:
        robot: the rigid body.
        effect: phi; None moves the body by the measured wrench.
        walks: W walks of T ticks; what follows a fall is left out.
        start_tick: gait tick of their t = 0.

    Raises:
        InputError: no walk is long enough to predict in.
    """
    config = walk_config(robot).gait
    ticks = round(HORIZONS[-1] / config.tick)
    fallen = np.asarray(walks.fallen)
    starts = np.arange(FIRST, fallen.shape[1] - ticks + 1, APART)
    if not len(starts):
        raise InputError(f"walks of {fallen.shape[1]} ticks are too short to predict {ticks} ticks")

    ahead = partial(_ahead, config, robot, ticks)
    over_starts = jax.vmap(ahead, in_axes=(None, None, None, 0))
    guess = jax.jit(jax.vmap(over_starts, in_axes=(None, 0, 0, None)))(
        effect, jax.tree.map(jnp.asarray, walks), jnp.asarray(start_tick), jnp.asarray(starts)
    )
    spans = starts[:, None] + np.arange(ticks)
    whole = ~fallen[:, spans].any(axis=-1)

    def rms(name: str) -> Float[np.ndarray, " ticks"]:
        error = np.asarray(getattr(guess, name)) - getattr(walks.state, name)[:, spans]
        return np.sqrt(_mean(np.sum(error**2, axis=-1)[whole]))

    return Drift(config.tick * np.arange(1, ticks + 1), rms("position"), rms("euler"))


def drifts(
    robot: Robot,
    effects: Mapping[str, jax.tree_util.Partial],
    walks: Trajectory,
    start_tick: Int[np.ndarray, " W"],
) -> dict[str, Drift]:
    """`drift` of several phi, and of the measured wrench."""
    phis = {**effects, "measured": None}
    return {name: drift(robot, effect, walks, start_tick) for name, effect in phis.items()}


def as_result(
    whole: Mapping[str, Mapping[str, Any]], phases: Mapping[str, Any], drifts: Mapping[str, Drift]
) -> dict[str, Any]:
    """All errors of one world as JSON values; `whole` is `training.report`."""

    def at(horizon: float, one: Drift) -> dict[str, float]:
        parts = {"position": one.position, "euler": one.euler}
        return {name: float(np.interp(horizon, one.time, x)) for name, x in parts.items()}

    ahead = {
        name: {f"{horizon:g} s": at(horizon, one) for horizon in HORIZONS}
        for name, one in drifts.items()
    }
    return {"errors": dict(whole), "phases": dict(phases), "open_loop": ahead}


def curves(
    robot: Robot, walks: Trajectory, effects: Mapping[str, jax.tree_util.Partial]
) -> dict[str, Wrench]:
    """Command, predictions and measurement of the first of some walks, for a picture.

    Args:
        robot: the body that walked.
        walks: as `make_dataset` takes them.
        effects: phis by name; drawn are `linear`, `paper` and `residual`, the last as `predicted`.

    Returns:
        Wrenches (ticks, feet, 3) in the yaw frame, from t = 0; NaN at ticks that are no samples.
    """
    one = jax.tree.map(lambda x: np.asarray(x)[:1], walks)
    samples, _ = make_dataset(robot, one)
    window = jax.tree.map(jnp.asarray, samples.window)
    wrenches = {
        "commanded": jax.tree.map(lambda w: w[:, 0], samples.window.commands),
        "measured": samples.label,
    }
    for name, drawn in (("linear", "linear"), ("paper", "paper"), ("residual", "predicted")):
        if name in effects:
            wrenches[drawn] = predict(effects[name], window).wrench

    def by_tick(values: Any) -> np.ndarray:
        """NaN at ticks that are no samples: the first, unsolved ones, those after a fall."""
        rows = np.full((one.fallen.shape[1], *values.shape[1:]), np.nan)
        rows[samples.tick] = values
        return rows

    return {name: jax.tree.map(by_tick, wrench) for name, wrench in wrenches.items()}


def write_report(
    folder: Path, worlds: Mapping[str, Mapping[str, Any]], pictures: Sequence[Picture]
) -> Path:
    """Write report.md on the nets' fidelity, and the same numbers as result.json.

    Args:
        folder: where the pictures are.
        worlds: by their names, the values of `as_result`.
        pictures: to show.

    Returns:
        report.md.
    """
    values = {"worlds": worlds, "pictures": pictures, "WORLDS": WORLDS, "PHASES": PHASES}
    text = render("fidelity.md.j2", **values, error_rows=error_rows)
    write_file(folder / "report.md", text.encode())
    write_json(folder / RESULT, worlds)
    return folder / "report.md"


def error_rows(errors: Iterable[Mapping[str, Any]]) -> list[tuple[str, list[float]]]:
    """Mean square errors, labelled: of force and moment, by contact and axis, of touchdowns.

    Args:
        errors: of several phis, as `training.report` has them.
    """
    errors = list(errors)
    rows = [(f"{kind}, all [{unit}]", [x[kind] for x in errors]) for kind, unit in _UNITS.items()]
    for contact in ("stance", "swing"):
        for i, (axis, kind) in enumerate(_AXES.items()):
            rows.append((f"{axis}, {contact} [{_UNITS[kind]}]", [x[contact][i] for x in errors]))
    if all(any(x.get("touchdown", ())) for x in errors):
        for i, axis in enumerate(("forward", "sideways")):
            rows.append((f"touchdown, {axis} [cm^2]", [x["touchdown"][i] for x in errors]))
    return rows
