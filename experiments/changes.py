"""Walks on plants that change on the way: payload, slippery floor, slope.

A change lasts for a part of the walk and is unknown to the controller. MuJoCo C switches from one
model to the next and keeps the state: a new payload moves with the trunk at once.

The world's frame is that of the floor, on a slope too, which only tilts gravity. So the robot
stands on a slope as on the flat floor, reference, fall and wrenches keep their meaning, and the
controller takes the floor for level: it does not know the component of the weight along the floor,
as with an attitude estimate that was set to zero on the slope.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from copy import copy
from dataclasses import replace
from functools import partial
from itertools import repeat
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.controller import WalkConfig
from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Trajectory
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.robot.poses import rotation_of
from hector_jax.sim.engine import MUJOCO_C
from hector_jax.sim.loop import Job
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.walk import on_host, walk
from hector_jax.sim.world import World

TRUNK_TOP = (0.0, 0.0, 0.124)  # [m] in the trunk's frame
STEEPEST = 0.5  # [rad]


class Change(NamedTuple):
    """A change of the plant during a part of a walk; changes whose times overlap add up."""

    start: float = -np.inf  # [s] after t = 0; by default the first moment, start-up included
    end: float = np.inf  # [s] after t = 0
    payload: float = 0.0  # [kg] point mass that is fixed to the trunk
    payload_at: tuple[float, float, float] = TRUNK_TOP  # [m] in the trunk's frame
    # replaces the plant's; of several changes the last counts; never below the soles' own 0.1
    floor_friction: float | None = None
    slope: tuple[float, float] = (0.0, 0.0)  # [rad] by which the floor rises towards x and y


class ChangingJob(NamedTuple):
    """A walk on a plant that changes."""

    job: Job
    changes: tuple[Change, ...]

    @property
    def plant(self) -> Robot | None:
        """See `Job`."""
        return self.job.plant


def _check(change: Change) -> None:
    for name, valid, expected in (
        ("start", not np.isnan(change.start), "be a number"),
        ("end", change.end > change.start, "be after its start"),
        ("payload", 0.0 <= change.payload < np.inf, "be finite and >= 0"),
        ("payload_at", np.all(np.isfinite(change.payload_at)), "be finite"),
        ("floor_friction", 0.0 <= (change.floor_friction or 0.0) < np.inf, "be finite and >= 0"),
        ("slope", np.hypot(*change.slope) <= STEEPEST, f"be at most {STEEPEST} rad in all"),
    ):
        if not valid:
            raise InputError(f"Change.{name} must {expected}, got {getattr(change, name)}")


def _add_payload(model: mujoco.MjModel, body: int, mass: float, place: Sequence[float]) -> None:
    """Fix a point mass to a body, in place."""
    R, body_mass = rotation_of(model.body_iquat[body]), model.body_mass[body]
    lever = np.asarray(place) - model.body_ipos[body]
    steiner = lever @ lever * np.eye(3) - np.outer(lever, lever)
    reduced = body_mass * mass / (body_mass + mass)
    inertia = R @ np.diag(model.body_inertia[body]) @ R.T + reduced * steiner
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.linalg.det(axes)  # makes them a rotation
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())
    model.body_inertia[body] = moments
    model.body_ipos[body] += mass / (body_mass + mass) * lever
    model.body_mass[body] = body_mass + mass


def changed_world(world: World, changes: Sequence[Change]) -> World:
    """Return the world while these changes last."""
    model = copy(world.model)
    for change in changes:
        if change.payload:
            _add_payload(model, world.trunk, change.payload, change.payload_at)
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
    """Return the worlds of a walk by the millisecond after t = 0 at which each begins.

    Args:
        world: the world without changes.
        changes: changes of the walk.
        first: the walk's first millisecond.
        end: the millisecond after its last.

    Raises:
        InputError: a number of a change is out of its range.
    """
    for change in changes:
        _check(change)
    spans = [(np.round(c.start / TIME_STEP), np.round(c.end / TIME_STEP)) for c in changes]
    steps = {first} | {int(t) for span in spans for t in span if first < t < end}

    def world_at(step: int) -> World:
        active = [c for c, (start, end) in zip(changes, spans, strict=True) if start <= step < end]
        return changed_world(world, active) if active else world

    return {step: world_at(step) for step in sorted(steps)}


class ChangingPlant(MujocoPlant):
    """A plant in MuJoCo C that changes during a walk."""

    def __init__(
        self,
        job: Job,
        body: Robot,
        first: int,
        end: int,
        *,
        changes: Sequence[Change],
        **options: Any,
    ) -> None:
        """Build as a `BuildPlant` does; `options` are those of `MujocoPlant`."""
        super().__init__(job, body, first, end, **options)
        self._worlds, self._now = worlds_by_step(self.world, changes, first, end), first

    def step(self, torque: Float[np.ndarray, " joints"], push: Float[np.ndarray, "3"]) -> None:
        """See `Plant`."""
        self.world = self._worlds.get(self._now, self.world)
        self._now += 1
        super().step(torque, push)


def walk_with_changes(
    config: WalkConfig, robot: Robot, job: Job, changes: Sequence[Change]
) -> Trajectory:
    """Walk once on a plant that changes."""
    return walk(config, robot, job, build=partial(ChangingPlant, changes=changes))


def _walk_all(
    pool: Executor, config: WalkConfig, robot: Robot, walks: Sequence[ChangingJob]
) -> Iterator[Trajectory]:
    jobs, changes = zip(*walks, strict=True)
    host_robot = jax.tree.map(np.asarray, robot)
    return pool.map(
        walk_with_changes, repeat(config), repeat(host_robot), map(on_host, jobs), changes
    )


CHANGING = MUJOCO_C._replace(walk=_walk_all, differs="the plants change on the way")
"""MuJoCo C that walks a `ChangingJob` in the place of a job."""
