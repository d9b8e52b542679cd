"""What a stance foot can exert, and what the MPC must keep within bounds.

A `ContactModel` says which components of its wrench a stance foot has: those are the inputs of the
MPC, five for a line foot (no M_x), and the others are zero, as is all of a foot in the air, which
has no inputs. A `Constraint` is lower <= A z <= upper on the inputs of each contact or on the
states of each step; `MpcConfig.constraints` holds as many as are wanted. One of one's own, by which
no foot twists by more than 2 N m:

>>> def twist(contact: Contact) -> Rows:
...     return Rows(contact.moment[2:], -2.0, 2.0)
>>> TWIST = InputConstraint("twist", of=twist)

Those of the paper (Eq. 4), for each stance foot:

    |F_x| + |F_y| <= mu F_z                    FRICTION
    0 <= F_z <= F_max                          UNILATERAL_FORCE
    -l_t F_z <= M_y <= l_h F_z                 LINE_PRESSURE, foot's yaw frame
    |F_y| <= mu' F_z at toe and heel each      LINE_FRICTION, foot's yaw frame

Where this leaves the paper: toe and heel of the line foot are in their physical places (pressure at
the toe gives M_y = -l_t F_z; the paper prints them swapped); toe and heel hold by friction each, or
the foot would turn on the spot when the pressure is all at one end. Friction is the pyramid of the
plants, MuJoCo's, whose base is a square on its corner in world axes: the paper's |F_x|, |F_y| <= mu
F_z would ask for sqrt 2 times as much along a diagonal, more than some floors hold. mu' =
mu max(|cos yaw|, |sin yaw|) is the most that it holds across a foot, whatever toe and heel push
against each other along it.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rot_z
from hector_jax.core.part import Part
from hector_jax.core.trajectory import State
from hector_jax.robot.model import Robot


class ContactModel(Part):
    """A kind of foot.

    Attributes:
        components: of (F_x, F_y, F_z, M_x, M_y, M_z) those that a stance foot can exert, F in the
            world, M in the foot's yaw frame.
    """

    components: tuple[int, ...]

    @property
    def inputs(self) -> int:
        """Inputs of a stance foot."""
        return len(self.components)

    @property
    def selection(self) -> Float[np.ndarray, "6 inputs"]:
        """The six components from the inputs."""
        return np.eye(6)[:, list(self.components)]

    def wrench(self, yaw: Float[Array, ""]) -> tuple[Array, Array]:
        """Force and moment in the world, (3, inputs) each, that the inputs of a foot exert."""
        selection = jnp.asarray(self.selection, jnp.result_type(yaw))
        return selection[:3], rot_z(yaw) @ selection[3:]


LINE_FOOT = ContactModel("line", components=(0, 1, 2, 4, 5))
CONTACT_MODELS = (LINE_FOOT,)
"""Those that a file can name."""


class Contact(NamedTuple):
    """A stance foot, as its constraints see it: rows that read its wrench from its inputs."""

    force: Float[Array, "3 inputs"]  # in the world [N]
    moment: Float[Array, "3 inputs"]  # in the foot's yaw frame [N m]
    yaw: Float[Array, ""]  # [rad]
    robot: Robot
    friction: Any  # mu
    max_force: Any  # [N]


class Step(NamedTuple):
    """The end of an MPC step, as its constraints see it."""

    state: State  # rows (3, 12) that read each part of the state
    reference: State  # where it should be
    contact: Bool[Array, "2"]  # which feet stood in the step
    lever: Float[Array, "2 3"]  # foot points from the centre of mass as planned [m]


class Rows(NamedTuple):
    """Bounds lower <= A z <= upper; a bound is one number or one for each row."""

    A: Float[Array, "rows z"]
    lower: Any
    upper: Any


class Constraint(Part):
    """Rows of the MPC."""

    on: ClassVar[str]
    of: Callable[..., Rows]


class InputConstraint(Constraint):
    """Rows on the inputs of each contact, `of(contact: Contact)`."""

    on = "inputs"


class StateConstraint(Constraint):
    """Rows on the state at the end of each step, `of(step: Step)`.

    They make A dense, which costs speed, and may leave no solution.
    """

    on = "states"


def rows(constraint: Constraint, of: Contact | Step, like: Array) -> Rows:
    """Rows of a constraint for one contact or step, with a bound for each row, as `like`."""
    A, lower, upper = constraint.of(of)
    bounds = (jnp.broadcast_to(jnp.asarray(b, like.dtype), A.shape[:1]) for b in (lower, upper))
    return Rows(jnp.asarray(A, like.dtype), *bounds)


def _friction(contact: Contact) -> Rows:
    (fx, fy, fz), mu = contact.force, contact.friction
    A = [fx + fy - mu * fz, fx + fy + mu * fz, fx - fy - mu * fz, fx - fy + mu * fz]
    return Rows(jnp.stack(A), np.array([-np.inf, 0.0] * 2), np.array([0.0, np.inf] * 2))


def _unilateral_force(contact: Contact) -> Rows:
    return Rows(contact.force[2:], 0.0, contact.max_force)


def _line_pressure(contact: Contact) -> Rows:
    fz, my = contact.force[2], contact.moment[1]
    A = [my + contact.robot.toe * fz, my - contact.robot.heel * fz]
    return Rows(jnp.stack(A), np.array([0.0, -np.inf]), np.array([np.inf, 0.0]))


def _line_friction(contact: Contact) -> Rows:
    (fx, fy, fz), (_, my, mz) = contact.force, contact.moment
    toe, heel = contact.robot.toe, contact.robot.heel
    sin, cos = jnp.sin(contact.yaw), jnp.cos(contact.yaw)
    side = cos * fy - sin * fx  # force across the foot
    grip = contact.friction * jnp.maximum(jnp.abs(cos), jnp.abs(sin))
    at_toe, at_heel = mz + heel * side, toe * side - mz
    toe_load, heel_load = grip * (heel * fz - my), grip * (toe * fz + my)
    A = [at_toe - toe_load, at_toe + toe_load, at_heel - heel_load, at_heel + heel_load]
    return Rows(jnp.stack(A), np.array([-np.inf, 0.0] * 2), np.array([0.0, np.inf] * 2))


FRICTION = InputConstraint("friction", of=_friction)
UNILATERAL_FORCE = InputConstraint("unilateral_force", of=_unilateral_force)
LINE_PRESSURE = InputConstraint("line_pressure", of=_line_pressure)
LINE_FRICTION = InputConstraint("line_friction", of=_line_friction)
CONSTRAINTS = (FRICTION, UNILATERAL_FORCE, LINE_PRESSURE, LINE_FRICTION)
"""Those that a file can name, and the default."""
