"""Next touchdown of each foot, whether it is in the air or still in stance.

The paper's rule p_c + v dt/2 (Eq. 6) ignores the hips and the velocity error; it is available as
`rule="paper"`. The default rule, which walks, adds the lateral offset of the hip, the travel until
touchdown, a velocity feedback and the lean in a turn (Raibert's rule with the capture-point turn
term).
"""

from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from hector_jax.core.arrays import Array, contract
from hector_jax.core.geometry import rot_z
from hector_jax.core.settings import NOT_NEGATIVE, SHARE, check
from hector_jax.core.trajectory import State
from hector_jax.robot.model import Robot


class Feet(NamedTuple):
    """Foot points and headings of the feet in the world."""

    position: Float[Array, "*batch feet 3"]  # [m]
    yaw: Float[Array, "*batch feet"]  # [rad]


def feet_where(contact: Bool[Array, " feet"], yes: Feet, no: Feet) -> Feet:
    """Select `yes` for the feet in contact and `no` for the others."""
    position = jnp.where(contact[:, None], yes.position, no.position)
    return Feet(position, jnp.where(contact, yes.yaw, no.yaw))


class FootstepParameters(NamedTuple):
    """Traced numbers of the rule."""

    width: Any  # [m] lateral distance of each foot from the middle
    feedback: Any  # [s] k_v, on the velocity error
    turn: Any  # share of the lean (z/g) v x omega


@dataclass(frozen=True)
class FootstepConfig:
    """The rule and the defaults of its numbers."""

    rule: str = "raibert"  # or "paper"
    width: float = 0.08  # [m] lateral distance of each foot from the middle
    feedback: float = 0.12  # [s] k_v, on the velocity error
    turn: float = 0.5  # share of the lean (z/g) v x omega
    travel: Annotated[float, SHARE] = 1.0  # share that counts of the way until touchdown
    ahead: Annotated[float, SHARE] = 0.5  # share of a stance that the body travels past a foot

    def __post_init__(self) -> None:
        check(self, rule=("raibert", "paper"), width=NOT_NEGATIVE)

    @property
    def parameters(self) -> FootstepParameters:
        """The traced numbers."""
        return FootstepParameters(self.width, self.feedback, self.turn)


def touchdown_points(
    config: FootstepConfig,
    robot: Robot,
    parameters: FootstepParameters,
    *,
    state: State,
    reference: State,
    remaining: Float[Array, " feet"],
    stance: float,
    swing: float,
) -> Feet:
    """Return the planned touchdowns of the feet, world frame.

    Args:
        config: the rule.
        robot: longitudinal offsets of the feet, and gravity for the lean in a turn.
        parameters: numbers of the rule.
        state: current base state.
        reference: desired base state, for the commanded velocity and yaw rate.
        remaining: time until each foot touches down [s].
        stance: duration of a stance [s].
        swing: duration of a swing [s].

    Source: Eq. 6; Raibert 1986.
    """
    if config.rule == "paper":
        point = state.position + state.velocity * swing / 2
        points = jnp.broadcast_to(point, (len(remaining), 3))
        return Feet(points.at[:, 2].set(0.0), jnp.full(len(remaining), state.euler[2]))
    yaw = state.euler[2] + reference.ang_velocity[2] * (remaining + stance / 2)
    outwards = parameters.width * jnp.tile(jnp.array([1.0, -1.0]), len(yaw) // 2)
    hips = jnp.stack([jnp.asarray(robot.foot_ahead), outwards, jnp.zeros(len(yaw))], axis=1)
    hips = contract("fxy,fy->fx", jax.vmap(rot_z)(yaw), hips)
    lean = jnp.cross(state.velocity, reference.ang_velocity) * state.position[2] / robot.gravity[2]
    # For a foot still in stance the current sway is irrelevant at touchdown: from the next step on
    # the commanded velocity counts.
    travel = jnp.where(
        (remaining > swing)[:, None],
        state.velocity * swing / 2 + reference.velocity * (remaining[:, None] - swing / 2),
        state.velocity * remaining[:, None],
    )
    points = (
        state.position
        + hips
        + config.travel * travel
        + config.ahead * stance * state.velocity
        + parameters.feedback * (state.velocity - reference.velocity)
        + parameters.turn * lean
    )
    return Feet(points.at[:, 2].set(0.0), yaw)
