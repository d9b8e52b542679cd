"""What becomes of a plant while it is walked on: payload, slippery floor, slope.

A change lasts for a while of the walk and the controller never learns of it. MuJoCo C goes from one
model to the next, state kept: a payload that arrives moves with the trunk at once.

The world's frame is that of the floor, on a slope too: there gravity is tilted and all else stays.
So the robot of the flat floor stands on it, reference, fall and wrenches mean what they mean
elsewhere, and the controller takes the floor for level: what it never learns is the share of the
weight that pulls along the floor, as under an attitude estimate that was set to zero there.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.sim.world import World

TRUNK_TOP = (0.0, 0.0, 0.124)  # [m] in the trunk's frame
STEEPEST = 0.5  # [rad]


class Change(NamedTuple):
    """What is different over a while of a walk; changes whose times overlap add up."""

    start: float = -np.inf  # [s] after t = 0; by default from the first moment, start-up included
    end: float = np.inf  # [s] likewise
    payload: float = 0.0  # [kg] point mass that is fixed to the trunk
    payload_at: tuple[float, float, float] = TRUNK_TOP  # [m] in the trunk's frame
    # in the place of the plant's own, of several the last; below the soles' own 0.1 it stays 0.1
    floor_friction: float | None = None
    slope: tuple[float, float] = (0.0, 0.0)  # [rad] by which the floor rises towards x and y


def _check(change: Change) -> None:
    for name, good, expected in (
        ("start", not np.isnan(change.start), "be a number"),
        ("end", change.end > change.start, "be after its start"),
        ("payload", 0.0 <= change.payload < np.inf, "be finite and >= 0"),
        ("payload_at", np.all(np.isfinite(change.payload_at)), "be finite"),
        ("floor_friction", 0.0 <= (change.floor_friction or 0.0) < np.inf, "be finite and >= 0"),
        ("slope", np.hypot(*change.slope) <= STEEPEST, f"be at most {STEEPEST} rad in all"),
    ):
        if not good:
            raise InputError(f"Change.{name} must {expected}, got {getattr(change, name)}")


def _loaded(model: mujoco.MjModel, body: int, mass: float, at: Sequence[float]) -> None:
    """Fix a point mass to a body."""
    R, own = np.zeros(9), model.body_mass[body]
    mujoco.mju_quat2Mat(R, model.body_iquat[body])
    R = R.reshape(3, 3)
    lever = np.asarray(at) - model.body_ipos[body]
    apart = lever @ lever * np.eye(3) - np.outer(lever, lever)
    inertia = R @ np.diag(model.body_inertia[body]) @ R.T + own * mass / (own + mass) * apart
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.linalg.det(axes)  # a rotation
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())
    model.body_inertia[body] = moments
    model.body_ipos[body] += mass / (own + mass) * lever
    model.body_mass[body] = own + mass


def changed_world(world: World, changes: Sequence[Change]) -> World:
    """The world while these changes last."""
    model = copy(world.model)
    for change in changes:
        if change.payload:
            _loaded(model, world.trunk, change.payload, change.payload_at)
        if change.floor_friction is not None:
            model.geom_friction[world.floor, 0] = change.floor_friction
    rise = np.sum([change.slope for change in changes], axis=0)
    angle, size = np.hypot(*rise), np.linalg.norm(model.opt.gravity)
    model.opt.gravity[:] = -size * np.append(rise * np.sinc(angle / np.pi), np.cos(angle))
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(world, model=model)


def worlds_by_step(
    world: World, changes: Sequence[Change], first: int, end: int
) -> dict[int, World]:
    """The worlds of a walk, each by the millisecond after t = 0 from which on it holds.

    Args:
        world: without changes.
        changes: what is to happen.
        first: the walk's first millisecond.
        end: the one after its last.

    Raises:
        InputError: a number of a change is out of its range.
    """
    for change in changes:
        _check(change)
    spans = [(np.round(c.start / TIME_STEP), np.round(c.end / TIME_STEP)) for c in changes]
    moments = {first} | {int(t) for span in spans for t in span if first < t < end}

    def at(moment: int) -> World:
        on = [c for c, (begin, over) in zip(changes, spans, strict=True) if begin <= moment < over]
        return changed_world(world, on) if on else world

    return {moment: at(moment) for moment in sorted(moments)}
