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

Those of a flat foot, beside the first three, with w its half width:

    |M_x| <= w F_z                             SIDE_PRESSURE
    |M_z| <= mu' r / 2 F_z                     TORSION, r from the foot's middle to a corner

and instead of TORSION, for feet that have to turn hard, CORNER_FRICTION: the wrench is a sum of
forces at the four corners, each within the square that fits into their pyramids along the foot
(Caron, Pham, Nakamura 2015).

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
        constraints: that hold it, where a config names no others.
    """

    components: tuple[int, ...]
    constraints: "tuple[Constraint, ...]"

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
    contact: Bool[Array, " feet"]  # which stood in the step
    lever: Float[Array, "feet 3"]  # foot points from the centre of mass as planned [m]


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


def _by_sign(signs: list[int], A: list[Array]) -> Rows:
    """Rows that are in turn at least zero (sign 1) and at most zero (-1)."""
    above = np.tile(signs, len(A) // 2) > 0
    return Rows(jnp.stack(A), np.where(above, 0.0, -np.inf), np.where(above, np.inf, 0.0))


def _friction(contact: Contact) -> Rows:
    (fx, fy, fz), mu = contact.force, contact.friction
    A = [fx + fy - mu * fz, fx + fy + mu * fz, fx - fy - mu * fz, fx - fy + mu * fz]
    return _by_sign([-1, 1], A)


def _unilateral_force(contact: Contact) -> Rows:
    return Rows(contact.force[2:], 0.0, contact.max_force)


def _line_pressure(contact: Contact) -> Rows:
    fz, my = contact.force[2], contact.moment[1]
    return _by_sign([1, -1], [my + contact.robot.toe * fz, my - contact.robot.heel * fz])


def _grip(contact: Contact) -> Array:
    """The most that friction holds across the foot, for 1 N of F_z."""
    return contact.friction * jnp.maximum(
        jnp.abs(jnp.cos(contact.yaw)), jnp.abs(jnp.sin(contact.yaw))
    )


def _line_friction(contact: Contact) -> Rows:
    (fx, fy, fz), (_, my, mz) = contact.force, contact.moment
    toe, heel = contact.robot.toe, contact.robot.heel
    sin, cos = jnp.sin(contact.yaw), jnp.cos(contact.yaw)
    side = cos * fy - sin * fx  # force across the foot
    grip = _grip(contact)
    at_toe, at_heel = mz + heel * side, toe * side - mz
    toe_load, heel_load = grip * (heel * fz - my), grip * (toe * fz + my)
    A = [at_toe - toe_load, at_toe + toe_load, at_heel - heel_load, at_heel + heel_load]
    return _by_sign([-1, 1], A)


def _side_pressure(contact: Contact) -> Rows:
    fz, mx, width = contact.force[2], contact.moment[0], contact.robot.half_width
    return _by_sign([1, -1], [mx + width * fz, mx - width * fz])


def _half_sides(robot: Robot) -> tuple[Any, Any]:
    """Half length and half width of the sole [m]."""
    return 0.5 * (robot.toe + robot.heel), robot.half_width


def _torsion(contact: Contact) -> Rows:
    fz, mz = contact.force[2], contact.moment[2]
    most = 0.5 * _grip(contact) * jnp.hypot(*_half_sides(contact.robot)) * fz
    return _by_sign([1, -1], [mz + most, mz - most])


def _corner_friction(contact: Contact) -> Rows:
    (fx, fy, fz), (mx, my, mz) = contact.force, contact.moment
    X, Y = _half_sides(contact.robot)
    sin, cos = jnp.sin(contact.yaw), jnp.cos(contact.yaw)
    mu = 0.5 * contact.friction / jnp.maximum(jnp.abs(cos), jnp.abs(sin))
    along, across = cos * fx + sin * fy, cos * fy - sin * fx
    # moments about the middle of the sole, which is ahead of the foot point
    middle = 0.5 * (contact.robot.toe - contact.robot.heel)
    my, mz = my + middle * fz, mz - middle * across
    load = mu * (X + Y) * fz
    A = [one + sign * mu * fz for one in (along, across) for sign in (1, -1)]
    for a in (1, -1):
        for b in (1, -1):
            low = a * (Y * along - mu * mx) + b * (X * across - mu * my)
            high = a * (Y * along + mu * mx) + b * (X * across + mu * my)
            A += [mz + load - low, mz - load + high]
    return _by_sign([1, -1], A)


FRICTION = InputConstraint("friction", of=_friction)
UNILATERAL_FORCE = InputConstraint("unilateral_force", of=_unilateral_force)
LINE_PRESSURE = InputConstraint("line_pressure", of=_line_pressure)
LINE_FRICTION = InputConstraint("line_friction", of=_line_friction)
SIDE_PRESSURE = InputConstraint("side_pressure", of=_side_pressure)
TORSION = InputConstraint("torsion", of=_torsion)
CORNER_FRICTION = InputConstraint("corner_friction", of=_corner_friction)
_POINT = (FRICTION, UNILATERAL_FORCE)
_LINE = (*_POINT, LINE_PRESSURE, LINE_FRICTION)
_FLAT = (*_POINT, LINE_PRESSURE, SIDE_PRESSURE, TORSION)
CONSTRAINTS = (*_LINE, SIDE_PRESSURE, TORSION, CORNER_FRICTION)
"""Those that a file can name."""

POINT_FOOT = ContactModel("point", components=(0, 1, 2), constraints=_POINT)
LINE_FOOT = ContactModel("line", components=(0, 1, 2, 4, 5), constraints=_LINE)
FLAT_FOOT = ContactModel("flat", components=(0, 1, 2, 3, 4, 5), constraints=_FLAT)
CONTACT_MODELS = (POINT_FOOT, LINE_FOOT, FLAT_FOOT)
"""Those that a file can name."""
