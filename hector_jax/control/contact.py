"""Contact models of stance feet, and the constraints and own costs of the MPC.

A `ContactModel` lists the wrench components that a stance foot can exert: they are the inputs of
the MPC, five for a line foot (no M_x). The others are zero, and so is the whole wrench of a foot in
the air, which has no inputs. A `Constraint` is lower <= A z <= upper on the inputs of each contact
or on the states of each step; `MpcConfig.constraints` holds any number of them. A custom one that
limits the yaw moment of each foot to 2 N m, beside those of a line foot:

>>> def twist(contact: Contact) -> Rows:
...     return Rows(contact.moment[2:], -2.0, 2.0)
>>> constraints = (*LINE_FOOT.constraints, InputConstraint("twist", of=twist))

A `Cost` is a sum of weighted squares, which `MpcConfig.costs` adds to those of Q and R. Its weights
are fixed: a gradient tunes Q, R and what `parameters` lists.

Constraints of the paper (Eq. 4), for each stance foot:

    |F_x| + |F_y| <= mu F_z                    FRICTION
    0 <= F_z <= F_max                          UNILATERAL_FORCE
    -l_t F_z <= M_y <= l_h F_z                 LINE_PRESSURE, foot's yaw frame
    |F_y| <= mu' F_z at toe and heel each      LINE_FRICTION, foot's yaw frame

Constraints of a flat foot, in addition to the first three, with half width w:

    |M_x| <= w F_z                             SIDE_PRESSURE
    |M_z| <= mu' r / 2 F_z                     TORSION, r from the foot's middle to a corner

and instead of TORSION, for feet that need large yaw moments, CORNER_FRICTION: the wrench is a sum
of forces at the four corners, each within the foot-aligned square inscribed in the friction pyramid
(Caron, Pham, Nakamura 2015). Other controllers have BOX_FRICTION, |F_x|, |F_y| <= mu F_z along and
across the foot, and TWIST, |M_z| <= twist F_z.

Differences from the paper: toe and heel of the line foot are in their physical places (pressure at
the toe gives M_y = -l_t F_z; the paper prints them swapped). Toe and heel each satisfy friction,
otherwise the foot would turn on the spot when all pressure is at one end. Friction is MuJoCo's
pyramid, as in the plants; its base is a square with its corners on the world axes. The paper's
|F_x|, |F_y| <= mu F_z would allow sqrt 2 times as much along a diagonal, more than some floors
hold. mu' = mu max(|cos yaw|, |sin yaw|) is the largest friction coefficient across a foot, whatever
forces along the foot toe and heel exert against each other.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax.core.arrays import Array, contract
from hector_jax.core.geometry import rot_z
from hector_jax.core.part import Part
from hector_jax.core.trajectory import State
from hector_jax.robot.model import Robot


class ContactModel(Part):
    """A kind of foot.

    Attributes:
        components: indices into (F_x, F_y, F_z, M_x, M_y, M_z) that a stance foot can exert, F in
            the world, M in the foot's yaw frame.
        constraints: its default constraints, unless a config names others.
    """

    components: tuple[int, ...]
    constraints: "tuple[Constraint, ...]"

    @property
    def inputs(self) -> int:
        """Number of inputs of a stance foot."""
        return len(self.components)

    @property
    def axes(self) -> int:
        """Number of wrench axes that GRFM-Net learns: 6, or 3 for a foot without moments."""
        return 6 if max(self.components) > 2 else 3

    @property
    def selection(self) -> Float[np.ndarray, "6 inputs"]:
        """Matrix from the inputs to the six wrench components."""
        return np.eye(6)[:, list(self.components)]

    def wrench(
        self, yaw: Float[Array, ""], frame: Float[Array, "3 3"] | None = None
    ) -> tuple[Array, Array]:
        """Return the matrices (3, inputs) from a foot's inputs to force and moment, world frame.

        Moments of the inputs are in the foot's yaw frame, or in a `frame` that is given.
        """
        selection = jnp.asarray(self.selection, jnp.result_type(yaw))
        turn = rot_z(yaw) if frame is None else frame
        return selection[:3], contract("xy,yi->xi", turn, selection[3:])

    def in_frame(
        self, yaw: Float[Array, ""], frame: Float[Array, "3 3"] | None
    ) -> tuple[Array, Array, Array]:
        """Return force, moment and yaw of a `Contact`."""
        selection = jnp.asarray(self.selection, jnp.result_type(yaw))
        if frame is None:
            return selection[:3], selection[3:], yaw
        return contract("yx,yi->xi", frame, selection[:3]), selection[3:], jnp.zeros_like(yaw)


class Contact(NamedTuple):
    """Arguments of a constraint or cost on a stance foot: matrices from inputs to wrench.

    In the frame of the trunk, if a twin asks for it, both matrices are in it and the yaw is zero.
    """

    force: Float[Array, "3 inputs"]  # in the world [N]
    moment: Float[Array, "3 inputs"]  # in the foot's yaw frame [N m]
    yaw: Float[Array, ""]  # [rad]
    robot: Robot
    friction: Any  # mu
    max_force: Any  # [N]
    twist: Any = 0.0  # [m] of TWIST


class Step(NamedTuple):
    """Arguments of a constraint or cost on the state at the end of an MPC step."""

    number: Int[Array, ""]  # 0 for the first step
    state: State  # matrices (3, 12) that select each part of the state
    reference: State  # desired state at the end of the step
    contact: Bool[Array, " feet"]  # stance feet of the step
    # centre of mass to foot points [m] at the start of the step, on the reference motion shifted to
    # the current pose
    lever: Float[Array, "feet 3"]


class Rows(NamedTuple):
    """Bounds lower <= A z <= upper; a bound is a number or has an entry for each row."""

    A: Float[Array, "rows z"]
    lower: Any
    upper: Any


class Constraint(Part):
    """Constraint rows of the MPC."""

    on: ClassVar[str]
    of: Callable[..., Rows]


class InputConstraint(Constraint):
    """Rows on the inputs of each contact, `of(contact: Contact)`."""

    on = "inputs"


class StateConstraint(Constraint):
    """Rows on the state at the end of each step, `of(step: Step)`.

    They make A dense, which is slower. The QP has no slack variables, so they can make it
    infeasible. By forward Euler no input moves the pose at the end of the first step (number 0):
    give its row infinite bounds there.
    """

    on = "states"


class Squares(NamedTuple):
    """Cost: the sum of weight (A z - target)^2; both are numbers or have an entry for each row."""

    A: Float[Array, "rows z"]
    target: Any
    weight: Any


class Cost(Part):
    """Cost of the MPC beside Q and R; a factor on its weight can be tuned as `cost_NAME`."""

    on: ClassVar[str]
    of: Callable[..., Squares]

    def times(self, factor: Any) -> "Cost":
        """Return the cost with a factor on its weight."""

        def of(argument: Any) -> Squares:
            squares = self.of(argument)
            return squares._replace(weight=factor * squares.weight)

        return type(self)(str(self), of=of)


class InputCost(Cost):
    """Cost on the inputs of each contact, `of(contact: Contact)`."""

    on = "inputs"


class StateCost(Cost):
    """Cost on the state at the end of each step, `of(step: Step)`."""

    on = "states"


def rows(part: Constraint | Cost, argument: Contact | Step, like: Array) -> tuple[Array, ...]:
    """Return the rows of a part on a contact or step with two numbers per row, dtype as `like`."""
    A, *numbers = part.of(argument)
    wide = (jnp.broadcast_to(jnp.asarray(x, like.dtype), A.shape[:1]) for x in numbers)
    return jnp.asarray(A, like.dtype), *wide


def _by_sign(signs: list[int], A: list[Array]) -> Rows:
    """Return rows that are alternately at least zero (sign 1) and at most zero (-1)."""
    nonnegative = np.tile(signs, len(A) // 2) > 0
    lower, upper = np.where(nonnegative, 0.0, -np.inf), np.where(nonnegative, np.inf, 0.0)
    return Rows(jnp.stack(A), lower, upper)


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
    """Return mu', the largest friction force across the foot per unit of F_z."""
    sin, cos = jnp.sin(contact.yaw), jnp.cos(contact.yaw)
    return contact.friction * jnp.maximum(jnp.abs(cos), jnp.abs(sin))


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
    """Return half length and half width of the sole [m]."""
    return 0.5 * (robot.toe + robot.heel), robot.half_width


def _torsion(contact: Contact) -> Rows:
    fz, mz = contact.force[2], contact.moment[2]
    limit = 0.5 * _grip(contact) * jnp.hypot(*_half_sides(contact.robot)) * fz
    return _by_sign([1, -1], [mz + limit, mz - limit])


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
    A = [force + sign * mu * fz for force in (along, across) for sign in (1, -1)]
    for a in (1, -1):
        for b in (1, -1):
            low = a * (Y * along - mu * mx) + b * (X * across - mu * my)
            high = a * (Y * along + mu * mx) + b * (X * across + mu * my)
            A += [mz + load - low, mz - load + high]
    return _by_sign([1, -1], A)


def _box_friction(contact: Contact) -> Rows:
    (fx, fy, fz), mu = contact.force, contact.friction
    sin, cos = jnp.sin(contact.yaw), jnp.cos(contact.yaw)
    sides = (cos * fx + sin * fy, cos * fy - sin * fx)
    return _by_sign([-1, 1], [side + sign * mu * fz for side in sides for sign in (-1, 1)])


def _twist(contact: Contact) -> Rows:
    fz, mz = contact.force[2], contact.moment[2]
    return _by_sign([1, -1], [mz + contact.twist * fz, mz - contact.twist * fz])


FRICTION = InputConstraint("friction", of=_friction)
BOX_FRICTION = InputConstraint("box_friction", of=_box_friction)
TWIST = InputConstraint("twist", of=_twist)
UNILATERAL_FORCE = InputConstraint("unilateral_force", of=_unilateral_force)
LINE_PRESSURE = InputConstraint("line_pressure", of=_line_pressure)
LINE_FRICTION = InputConstraint("line_friction", of=_line_friction)
SIDE_PRESSURE = InputConstraint("side_pressure", of=_side_pressure)
TORSION = InputConstraint("torsion", of=_torsion)
CORNER_FRICTION = InputConstraint("corner_friction", of=_corner_friction)
_POINT = (FRICTION, UNILATERAL_FORCE)
_LINE = (*_POINT, LINE_PRESSURE, LINE_FRICTION)
_FLAT = (*_POINT, LINE_PRESSURE, SIDE_PRESSURE, TORSION)
Constraint.known = (*_LINE, SIDE_PRESSURE, TORSION, CORNER_FRICTION, BOX_FRICTION, TWIST)

POINT_FOOT = ContactModel("point", components=(0, 1, 2), constraints=_POINT)
LINE_FOOT = ContactModel("line", components=(0, 1, 2, 4, 5), constraints=_LINE)
FLAT_FOOT = ContactModel("flat", components=(0, 1, 2, 3, 4, 5), constraints=_FLAT)
ContactModel.known = (POINT_FOOT, LINE_FOOT, FLAT_FOOT)
