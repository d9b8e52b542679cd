"""State, wrench and trajectory, and the only functions that pack a wrench into u.

Everything is in the world frame. A wrench is that of the ground on the robot, at the foot point (on
the sole), in the order of `FEET`. The paper's state is x = [e; p; omega; v; g] with 15 entries
and its input u = [F_0; F_1; M_0; M_1] with 12 (Eq. 2, 3); f feet have 6 f.
Arrays are on the host (numpy) or on a device.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rot_z

FEET = {2: ("left", "right"), 4: ("front_left", "front_right", "hind_left", "hind_right")}
"""Names of the feet by their number: pairs, left before right."""

MIN_HEIGHT = 0.25  # [m] of the centre of mass; below it HECTOR has fallen
MAX_TILT = 0.8  # [rad] of roll or pitch; above it a robot has fallen
SOLVED = 1e-6  # largest relative KKT residual of a plan that is used for learning and results


class State(NamedTuple):
    """Floating base of the single rigid body, in the world frame."""

    euler: Float[Any, "*batch 3"]  # roll, pitch, yaw [rad]; yaw is continuous, not wrapped
    position: Float[Any, "*batch 3"]  # centre of mass [m]
    ang_velocity: Float[Any, "*batch 3"]  # [rad/s]
    velocity: Float[Any, "*batch 3"]  # [m/s]


class Wrench(NamedTuple):
    """Force and moment of the ground on each foot at its foot point, world frame."""

    force: Float[Any, "*batch feet 3"]  # [N]
    moment: Float[Any, "*batch feet 3"]  # [N m]


class Load(NamedTuple):
    """Force on the centre of mass and torque about it."""

    force: Float[Any, "*batch 3"]  # [N]
    torque: Float[Any, "*batch 3"]  # [N m]


class Disturbance(NamedTuple):
    """Accelerations that are missing in the model of the controller, in the yaw frame."""

    linear: Float[Any, "*batch 3"]  # [m/s^2]
    angular: Float[Any, "*batch 3"]  # [rad/s^2]


class Belief(NamedTuple):
    """What the controller planned from, beside the truth: with it each plan can be made again."""

    state: State  # (T, 3) each, error of the estimate when the plan was made
    joints: Float[Any, "*batch T joints"]  # [rad] error of the encoders, backlash included
    disturbance: Disturbance  # (T, 3) each, of the integral action, after the plan


class Trajectory(NamedTuple):
    """One walk, sampled at a constant rate, as every world returns it.

    Sample j covers the interval from j*period to (j+1)*period: `command` is held over it, `effect`
    is the mean wrench of the ground over it, `state`, `joints` and `feet` are true values at its
    end, `reference` is the desired state there.
    """

    period: Float[Any, "*batch"]  # [s] between samples: 0.01 in srbm, 0.001 in the MuJoCo worlds
    initial: State  # true state at t = 0, batch axes only
    state: State  # (T, 3) each
    reference: State  # (T, 3) each
    command: Wrench  # (T, feet, 3) each, commanded by the MPC
    effect: Wrench  # (T, feet, 3) each, exerted by the ground
    contact: Bool[Any, "*batch T feet"]  # planned stance
    feet: Float[Any, "*batch T feet 3"]  # foot points [m]
    joints: Float[Any, "*batch T joints"]  # [rad] leg by leg, from the trunk down
    fallen: Bool[Any, "*batch T"]  # true from the sample of the fall on
    legs_touch: Bool[Any, "*batch T"]  # the legs touched each other, which is not a fall
    residual: Float[Any, "*batch T"]  # largest relative KKT residual of the current plan
    belief: Belief | None = None  # None: of a model, whose variation tells it


def no_samples(joints: int, feet: int, *batch: int) -> Trajectory:
    """Return walks without samples (numpy), leading axes `batch`: the layout of walks in a file."""
    zeros = lambda *shape: np.zeros((*batch, *shape))  # noqa: E731
    state = State(*[zeros(0, 3)] * 4)
    wrench = Wrench(zeros(0, feet, 3), zeros(0, feet, 3))
    return Trajectory(
        period=zeros(),
        initial=State(*[zeros(3)] * 4),
        state=state,
        reference=state,
        command=wrench,
        effect=wrench,
        contact=zeros(0, feet),
        feet=zeros(0, feet, 3),
        joints=zeros(0, joints),
        fallen=zeros(0),
        legs_touch=zeros(0),
        residual=zeros(0),
        belief=Belief(state, zeros(0, joints), Disturbance(zeros(0, 3), zeros(0, 3))),
    )


def from_start(walk: Trajectory) -> Trajectory:
    """Transform a walk into the frame of its start: at the origin, facing x (numpy, no batch).

    A reference starts at the robot's pose at t = 0, which differs between sets of weights. In this
    frame all walks of a command have the same reference.
    """
    walk = jax.tree.map(np.asarray, walk)
    yaw, origin = np.zeros(3), np.zeros(3)
    yaw[2], origin[:2] = walk.initial.euler[2], walk.initial.position[:2]
    R = np.asarray(rot_z(jnp.asarray(yaw[2])))  # v @ R rotates v by -yaw

    def transform(state: State, yaw: Any = yaw, origin: Any = origin) -> State:
        position = (state.position - origin) @ R
        return State(state.euler - yaw, position, state.ang_velocity @ R, state.velocity @ R)

    belief = walk.belief and walk.belief._replace(state=transform(walk.belief.state, 0.0, 0.0))

    return walk._replace(
        initial=transform(walk.initial),
        state=transform(walk.state),
        reference=transform(walk.reference),
        command=Wrench(*(vectors @ R for vectors in walk.command)),
        effect=Wrench(*(vectors @ R for vectors in walk.effect)),
        feet=(walk.feet - origin) @ R,
        belief=belief,
    )


def has_fallen(
    state: State, min_height: float = MIN_HEIGHT, max_tilt: float = MAX_TILT
) -> Bool[Array, "*batch"]:
    """Return whether a base state is that of a fallen robot: too low, too tilted or not finite."""
    low = state.position[..., 2] < min_height
    tilted = jnp.any(jnp.abs(state.euler[..., :2]) > max_tilt, axis=-1)
    finite = jnp.all(jnp.stack([jnp.isfinite(x).all(axis=-1) for x in state]), axis=0)
    return low | tilted | ~finite


def pack_wrench(wrench: Wrench) -> Float[Array, " inputs"]:
    """Return the paper's u = [F_0; F_1; M_0; M_1] (Eq. 3), or its extension to more feet.

    >>> left = Wrench(jnp.array([[1.0, 2, 3], [0, 0, 0]]), jnp.array([[4.0, 5, 6], [0, 0, 0]]))
    >>> pack_wrench(left).tolist()
    [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 4.0, 5.0, 6.0, 0.0, 0.0, 0.0]
    """
    return jnp.concatenate([wrench.force.reshape(-1), wrench.moment.reshape(-1)])


def unpack_wrench(u: Float[Array, " inputs"]) -> Wrench:
    """Return the wrench from u = [F_0; F_1; M_0; M_1], or from its extension to more feet."""
    return Wrench(*u.reshape(2, -1, 3))


def zero_wrench(feet: int = 2) -> Wrench:
    """Return a zero wrench on each foot."""
    return Wrench(jnp.zeros((feet, 3)), jnp.zeros((feet, 3)))
