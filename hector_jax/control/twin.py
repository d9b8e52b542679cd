"""What differs in the MPC of another controller: its twin is this project's MPC with that.

A controller that shares the MPC of `mpc` may predict otherwise: from another reference, with a
frozen linearisation, with contacts looked up elsewhere in a step, in plans of several ticks, with
another mass. Each is a part or a number of `TwinConfig`, the section [twin] of the robot's file;
the defaults are the MPC of this project. `own.parity` says how far the plans of both are apart.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hector_jax.control.footstep import Feet
from hector_jax.control.reference import Anchor, Command, reference_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array, contract
from hector_jax.core.geometry import rot_z, rotation_from_euler, wrap_angle
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.part import Part
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, Range, check
from hector_jax.core.trajectory import State
from hector_jax.robot.model import Robot


class ReferenceInputs(NamedTuple):
    """Arguments of a reference rule."""

    command: Command
    anchor: Anchor
    ticks: Int[Array, " steps"]  # gait ticks, the present one and those at the end of each step
    state: State  # of the robot


class ReferenceRule(Part):
    """Where the MPC wants the robot to be, `of(tick_length, inputs)`: a State (steps, 3)."""

    of: Callable[[float, ReferenceInputs], State]


def _path(tick_length: float, inputs: ReferenceInputs) -> State:
    command, anchor, ticks, _ = inputs
    return jax.vmap(lambda tick: reference_at(tick_length, command, anchor, tick))(ticks)


def _from_robot(tick_length: float, inputs: ReferenceInputs) -> State:
    command, anchor, ticks, state = inputs
    now = reference_at(tick_length, command, anchor, ticks[0])
    dt, steps = tick_length * (ticks[1] - ticks[0]), jnp.arange(len(ticks))
    yaw = state.euler[2] + dt * steps * now.ang_velocity[2]
    turn = jax.vmap(rot_z)(yaw - now.euler[2])
    velocity = contract("kxy,y->kx", turn, now.velocity)
    way = dt * (jnp.cumsum(velocity, axis=0) - velocity)  # forward Euler
    return State(
        euler=jnp.zeros_like(way).at[:, 2].set(yaw),
        position=way + state.position.at[2].set(now.position[2]),
        ang_velocity=jnp.broadcast_to(now.ang_velocity, way.shape),
        velocity=velocity,
    )


def _trunk_velocity(tick_length: float, inputs: ReferenceInputs) -> State:
    command, anchor, ticks, state = inputs
    now = reference_at(tick_length, command, anchor, ticks[0])
    elapsed = tick_length * (ticks - ticks[0])[:, None]
    wanted = contract("xy,y->x", rot_z(-now.euler[2]), now.velocity)
    velocity = contract("xy,y->x", rotation_from_euler(state.euler), wanted)
    start = jnp.stack([state.position[0], state.position[1], now.position[2]])
    return State(
        euler=jnp.array([0.0, 0.0, 1.0]) * (state.euler[2] + elapsed * now.ang_velocity[2]),
        position=start + elapsed * velocity * jnp.array([1.0, 1.0, 0.0]),
        ang_velocity=jnp.broadcast_to(now.ang_velocity, (len(ticks), 3)),
        velocity=jnp.broadcast_to(velocity, (len(ticks), 3)),
    )


PATH = ReferenceRule("path", of=_path)
"""The commanded path, whatever the robot does."""

FROM_ROBOT = ReferenceRule("from_robot", of=_from_robot)
"""From x, y and yaw of the robot on with the present command; height as commanded."""

TRUNK_VELOCITY = ReferenceRule("trunk_velocity", of=_trunk_velocity)
"""From x, y and yaw of the robot on straight ahead, with the command in the trunk's frame."""

ReferenceRule.known = (PATH, FROM_ROBOT, TRUNK_VELOCITY)


class Around(NamedTuple):
    """The motion about which the dynamics of each step are linear."""

    euler: Float[Array, "N 3"]  # [rad]
    lever: Float[Array, "N feet 3"]  # centre of mass to foot points [m]
    foot_yaw: Float[Array, "N feet"]  # [rad]


class Linearisation(Part):
    """Where the dynamics are linearised, `of(state, feet, reference, planned)`.

    Its arguments are the present state and feet, the reference (N + 1, 3) and the feet of each
    step (N, feet) with the touchdowns within the horizon.
    """

    of: Callable[[State, Feet, State, Feet], Around]


def _along_reference(state: State, feet: Feet, reference: State, planned: Feet) -> Around:
    # the reference motion shifted to the current pose: the levers are right under a tracking error
    current, start = (jax.tree.map(lambda r, s=s: r[s], reference) for s in (0, slice(0, -1)))
    path = state.position + start.position - current.position
    heading = state.euler[2] + start.euler[:, 2] - current.euler[2]
    euler = jnp.zeros_like(start.euler).at[:, 2].set(heading)
    return Around(euler, planned.position - path[:, None], planned.yaw)


def _frozen(state: State, feet: Feet, reference: State, planned: Feet) -> Around:
    now = Around(state.euler, feet.position - state.position, feet.yaw)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (len(planned.yaw), *x.shape)), now)


ALONG_REFERENCE = Linearisation("along_reference", of=_along_reference)
"""At the yaw of the reference, with the feet of each step."""

FROZEN = Linearisation("frozen", of=_frozen)
"""At the present attitude with the present feet, for all steps.

A foot in the air is where it is in logs and simulators, at its touchdown in the rollouts."""

Linearisation.known = (ALONG_REFERENCE, FROZEN)


@dataclass(frozen=True)
class TwinConfig:
    """How the MPC predicts and how often it plans; the defaults are those of this project."""

    reference: ReferenceRule = PATH
    # [m/s], [rad/s] x, y and yaw, world frame, whose command is slower are those of the path
    at_rest: Annotated[float, NOT_NEGATIVE] = 0.0
    late: Annotated[int, NOT_NEGATIVE] = 0  # steps by which the target of a step is that before it
    linearisation: Linearisation = ALONG_REFERENCE
    # share of a step at which its contacts are read; below 0: before it, and the present ones too
    contact_at: Annotated[float, Range(-1.0, 1.0)] = 0.5
    plan_ticks: Annotated[int, AT_LEAST_ONE] = 1  # gait ticks from plan to plan
    air_moments: bool = False  # feet in the air have inputs too; constraints make their force zero
    frame: str = "foot"  # of moments and constraints: each foot's yaw, or "trunk", its attitude
    com: tuple[float, ...] | None = None  # [m] in the trunk's frame; None: the robot's, as below
    height: float | None = None  # [m] of this point in the reference
    mass: float | None = None  # [kg]
    inertia: tuple[float, ...] | None = None  # [kg m^2] about the trunk's x, y and z
    toe: float | None = None  # [m] ahead of the foot point; heel behind it
    heel: float | None = None
    # times R: 2 or 0.5 where a cost has halves, the step [s] or 1 over it where it is by the second
    input_cost: Annotated[float, POSITIVE] = 1.0
    # conventions of its logs (`own.walk_file`)
    legs: tuple[str, ...] = ()  # order of forces, moments and contacts; empty: that of the robot
    joint_legs: tuple[str, ...] = ()  # order of the joints, likewise
    wrenches: str = "on_robot"  # of the ground on the robot, or of the robot "on_ground"
    wrench_frame: str = "world"  # their axes: also the "heading", or the "trunk"
    angles: str = "rpy"  # order of `euler`; or "ypr"

    def __post_init__(self) -> None:
        positive = dict.fromkeys(("height", "mass", "inertia"), POSITIVE)
        words = {"frame": ("foot", "trunk"), "wrenches": ("on_robot", "on_ground")}
        words |= {"wrench_frame": ("world", "heading", "trunk"), "angles": ("rpy", "ypr")}
        check(self, toe=NOT_NEGATIVE, heel=NOT_NEGATIVE, **positive, **words)
        for name in ("com", "inertia"):
            if (got := getattr(self, name)) is not None and len(got) != 3:
                text = f"TwinConfig.{name} must be 3 numbers"
                raise InputError(f"{text}, got {short_repr(got)}")
        if self.com is not None and self.height is None:
            raise InputError("TwinConfig.com needs height, that of this point in the reference")

    def body(self, robot: Robot) -> Robot:
        """Return the robot as the MPC takes it to be."""
        given = {name: getattr(self, name) for name in ("mass", "toe", "heel")}
        given["inertia"] = None if self.inertia is None else np.diag(self.inertia)
        return robot._replace(**{name: x for name, x in given.items() if x is not None})

    def weights(self, weights: Weights) -> Weights:
        """Return weights with R in the units of the twin's cost."""
        if self.input_cost == 1.0:
            return weights
        return weights._replace(R=jax.tree.map(lambda x: self.input_cost * x, weights.R))

    def state(self, robot: Robot, state: State) -> State:
        """Return the state of the point that the MPC takes for the centre of mass."""
        if self.com is None:
            return state
        shift = np.array(self.com) - robot.com_offset
        offset = contract("xy,y->x", rotation_from_euler(state.euler), shift)
        velocity = state.velocity + jnp.cross(state.ang_velocity, offset)
        return state._replace(position=state.position + offset, velocity=velocity)

    def target(self, reference: State, path: State, desired: State | None) -> State:
        """Return the reference at the twin's height, from the path on where it is at rest.

        Args:
            reference: by the rule, at the steps (N + 1, 3).
            path: the commanded motion now.
            desired: pose at the start of the reference of a log; None: there is none.
        """
        position, euler = reference.position, reference.euler
        if self.at_rest:
            still = jnp.abs(reference.velocity[0]) < self.at_rest
            position = position + jnp.where(still, path.position - position[0], 0.0)
            still = jnp.abs(reference.ang_velocity[0]) < self.at_rest
            euler = euler + jnp.where(still, path.euler - euler[0], 0.0)
        if self.height is not None:
            position = position.at[:, 2].set(self.height)
        if desired is not None:
            position = position + desired.position - position[0]
            euler = euler + wrap_angle(desired.euler - euler[0])
        return reference._replace(position=position, euler=euler)
