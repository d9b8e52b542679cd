"""The numbers of the controller as one tree, and those that can be tuned.

These numbers are traced: a new value needs no compilation and has a derivative. Settings that shape
a program stay in `WalkConfig`, whose numbers are the defaults:

>>> from hector_jax.control.controller import WalkConfig
>>> from hector_jax.control.weights import expert
>>> parameters = WalkConfig().parameters(expert())
>>> feedback = TUNABLES["footstep_feedback"]
>>> feedback.read(parameters)
0.12
>>> feedback.write(parameters, 0.2).footstep.feedback
0.2
"""

from collections.abc import Iterable, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.control.footstep import FootstepParameters
from hector_jax.control.legs import LegParameters
from hector_jax.control.mpc import MpcParameters
from hector_jax.control.weights import (
    Weights,
    direction_names,
    directions,
    nominal,
    scale_weights,
    weight_names,
    weights_to_vector,
)
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import Range
from hector_jax.robot.description import HECTOR, Description
from hector_jax.robot.model import Robot


class Parameters(NamedTuple):
    """All traced numbers of the controller."""

    mpc: MpcParameters
    footstep: FootstepParameters
    legs: LegParameters


class Tunable(NamedTuple):
    """An entry of `Parameters` that can be tuned, and its bounds; or another controller's number.

    A function that takes `others` takes names of `TUNABLES` and tunables of another controller.
    """

    path: str  # for example "mpc.weights.Q"; of another controller "plan" or "legs", which use it
    lower: float
    upper: float
    each_joint: bool = False  # an array with a number for each joint of a leg, else a scalar
    cost: str = ""  # the factor on the weight of this cost of one's own
    log: bool = False  # stepped in logarithms, else in shares of its box
    name: str = ""  # in `Weights.others`, of another controller's

    @property
    def of_legs(self) -> bool:
        """True if the rigid-body model does not have it, so that no gradient tunes it."""
        return self.path.startswith("legs")

    @property
    def width(self) -> float:
        """Length of its box."""
        return self.upper - self.lower

    def shape(self, robot: Robot | None = None) -> tuple[int, ...]:
        """Return the shape of the entry in a robot's `Weights.others`, HECTOR by default."""
        description = HECTOR if robot is None else robot.description
        return (description.leg_joints,) if self.each_joint else ()

    def read(self, parameters: Parameters) -> Any:
        """Return the entry: a number or a tree of numbers."""
        found = attrgetter(self.path)(parameters)
        return found[self.cost] if self.cost else found

    def write(self, parameters: Parameters, value: Any) -> Parameters:
        """Return the parameters with another value of the entry."""
        if self.cost:
            value = {**attrgetter(self.path)(parameters), self.cost: value}

        def replace(tree: Any, names: Sequence[str]) -> Any:
            first, *rest = names
            new = replace(getattr(tree, first), rest) if rest else value
            return tree._replace(**{first: new})

        return replace(parameters, self.path.split("."))


Q, R = Tunable("mpc.weights.Q", 1e-2, 1e4), Tunable("mpc.weights.R", 1e-7, 1.0)
TUNABLES = {
    "footstep_feedback": Tunable("footstep.feedback", 0.0, 0.5),
    "footstep_width": Tunable("footstep.width", 0.0, 0.2),
    "turn_lead": Tunable("footstep.turn", 0.0, 2.0),
    "effort_reference": Tunable("mpc.effort_reference", 0.0, 1.0),
    "horizontal_gain": Tunable("mpc.integral.horizontal", 0.0, 50.0),
    "height_gain": Tunable("mpc.integral.height", 0.0, 200.0),
    "tilt_gain": Tunable("mpc.integral.tilt", 0.0, 1000.0),
    "yaw_gain": Tunable("mpc.integral.yaw", 0.0, 1000.0),
    "friction": Tunable("mpc.friction", 0.1, 1.0),
    "position_limit": Tunable("mpc.position_limit", 1e-3, 10.0),
    "yaw_limit": Tunable("mpc.yaw_limit", 1e-2, 10.0),
    "integral_limit": Tunable("mpc.integral.limit", 1e-2, 20.0),
    "gravity_compensation": Tunable("legs.gravity_compensation", 0.0, 1.0),
    "foot_height": Tunable("legs.height", 0.02, 0.2),
    "landing": Tunable("legs.landing", -0.05, 0.05),
    "kp": Tunable("legs.kp", 1.0, 3000.0, each_joint=True),
    "kd": Tunable("legs.kd", 0.05, 100.0, each_joint=True),
}
"""Numbers that can be tuned in addition to Q and R, by their names in `Weights.others`.

A new one is added here and to the choices in cli/flags.py."""
COST = "cost_"
"""Begins the name of the factor on the weight of a cost of one's own, which is a tunable too."""


Other = str | Tunable
"""A number beside Q and R: a name of this controller's, or what another controller's is."""


def tunable(other: Other) -> Tunable:
    """Return the tunable of a name in `Weights.others`; KeyError if there is none."""
    if isinstance(other, Tunable):
        return other
    if other.startswith(COST):
        return Tunable("mpc.costs", 1e-3, 1e3, cost=other.removeprefix(COST), log=True)
    return TUNABLES[other]


def name_of(other: Other) -> str:
    """Return the name of a number in `Weights.others`."""
    return other.name if isinstance(other, Tunable) else other


def numbers_of(description: Description) -> tuple[Tunable, ...]:
    """Return the tunables of another controller that a robot's TOML names in `[numbers]`.

    Raises:
        InputError: one has the name of a number of this project's controller.
    """
    for name, _ in description.numbers:
        if is_ours(name):
            text = "is a number of this project's controller: give yours another name"
            raise InputError(f"{description.path}: numbers: {name} {text}")
    return tuple(
        Tunable(x.used_by, x.low, x.high, log=x.scale == "log", name=name)
        for name, x in description.numbers
    )


def is_ours(name: str) -> bool:
    """Return whether a name in `Weights.others` is of this project's controller."""
    return name in TUNABLES or name.startswith(COST)


def without_numbers(weights: Weights) -> Weights:
    """Return weights without the numbers of another controller, of which this one is the twin."""
    return weights._replace(others={n: x for n, x in weights.others.items() if is_ours(n)})


def own_names(weights: Weights) -> list[str]:
    """Return the names of the numbers of another controller, in order."""
    return sorted(name for name in weights.others if not is_ours(name))


def nudged(
    weights: Weights, others: Sequence[Other], at: Sequence[int], size: float
) -> tuple[Weights, float]:
    """Return weights with some coordinates moved by one step within their boxes, and that step.

    The step is of this size, the other way if there is no room, see `stepped`.

    Args:
        weights, others: see `stepped`.
        at: indices of the coordinates.
        size: of the step.
    """
    low, high = (np.asarray(edge)[list(at)] for edge in step_bounds(weights, others))
    step = max((float(np.clip(x, low.max(), high.min())) for x in (size, -size)), key=abs)
    steps = np.zeros(len(step_names(weights, others)))
    steps[list(at)] = step
    return jax.tree.map(np.asarray, stepped(weights, steps, others)), step


_FOOTSTEPS = ("footstep_feedback", "turn_lead")
_INTEGRAL = ("horizontal_gain", "height_gain", "tilt_gain", "yaw_gain")
GROUPS: dict[str, tuple[str, ...]] = {
    "weights": (),
    "footsteps": _FOOTSTEPS,
    "integral": _INTEGRAL,
    "all": (*_FOOTSTEPS, "effort_reference", *_INTEGRAL),
}
"""Groups of numbers that are tuned together. Friction and step width are in none of them: the
tuner's model knows neither the friction of the ground nor collisions of the legs. Those of the legs
are in none either: the model has no legs, and a weights file sets them."""


def tunables(names: Iterable[str]) -> tuple[str, ...]:
    """Return tunable names with the names of `GROUPS` expanded, without duplicates.

    >>> tunables(["footsteps", "turn_lead"])
    ('footstep_feedback', 'turn_lead')
    """
    return tuple(dict.fromkeys(member for name in names for member in GROUPS.get(name, (name,))))


def out_of_box(other: Other, start: Any) -> str:
    """Return why a tuning of a number cannot start at a value; empty if it can."""
    box = Range(tunable(other).lower, tunable(other).upper)
    if all(number in box for number in np.ravel(start).tolist()):
        return ""
    return f"{name_of(other)} starts at {start}, expected {box}"


def bounds(others: Iterable[Other] = (), like: Weights | None = None) -> tuple[Weights, Weights]:
    """Return the lower and upper bounds Theta of feasible weights and of `others`.

    The weights have the shapes of `like`, by default HECTOR's.

    >>> lower, upper = bounds(["turn_lead"])
    >>> lower.Q.euler.tolist(), upper.others
    ([0.01, 0.01, 0.01], {'turn_lead': 2.0})
    """
    like, others = like or nominal(), tuple(others)

    def bound(side: str) -> Weights:
        return Weights(
            jax.tree.map(lambda w: np.full(np.shape(w), getattr(Q, side)), like.Q),
            jax.tree.map(lambda w: np.full(np.shape(w), getattr(R, side)), like.R),
            {name_of(other): getattr(tunable(other), side) for other in others},
        )

    return bound("lower"), bound("upper")


def step_names(like: Weights, others: Iterable[Other] = ()) -> tuple[str, ...]:
    """Return the names of the coordinates in which weights are stepped, see `stepped`."""
    return (*direction_names(like), *map(name_of, others))


def stepped(
    start: Weights, steps: Float[Array | np.ndarray, " n"], others: Sequence[Other] = ()
) -> Weights:
    """Return weights after steps from a start.

    Args:
        start: with all feet sharing one R.
        steps: log-steps in the `weights.directions`, then of each of `others`, entry by entry, as
            shares of their boxes; or log-steps, see `Tunable.log`.
        others: numbers in `start.others`.

    >>> start = nominal()._replace(others={"turn_lead": 0.5})
    >>> float(stepped(start, np.full(19, 0.1), ["turn_lead"]).others["turn_lead"])
    0.7
    """
    of_weights, rest = jnp.split(jnp.asarray(steps), [len(direction_names(start))])
    moved = dict(start.others)
    for other in others:
        name, of = name_of(other), tunable(other)
        part, rest = jnp.split(rest, [np.size(moved[name])])
        part = part.reshape(np.shape(moved[name]))
        logs = moved[name] * jnp.exp(part)
        moved[name] = logs if of.log else moved[name] + part * of.width
    return scale_weights(start, of_weights)._replace(others=moved)


def steps_between(
    start: Weights, weights: Weights, others: Sequence[Other] = ()
) -> Float[Array, " n"]:
    """Return the steps from a start to weights: the inverse of `stepped`."""
    first_foot = directions(start).argmax(axis=1)  # index of each direction's first weight
    logs = jnp.log(weights_to_vector(weights) / weights_to_vector(start))[first_foot]

    def away_of(other: Other) -> Any:
        of = tunable(other)
        at, before = (x.others[name_of(other)] for x in (weights, start))
        return jnp.log(at / before) if of.log else (at - before) / of.width

    away = [jnp.asarray(away_of(other)) for other in others]
    return jnp.concatenate([logs, *map(jnp.ravel, away)])


def step_bounds(
    start: Weights, others: Sequence[Other] = ()
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return the lower and upper bounds of the steps that stay in the box, see `stepped`."""
    lower, upper = (steps_between(start, edge, others) for edge in bounds(others, start))
    return lower, upper


def check_in_box(start: Weights, others: Sequence[Other] = ()) -> None:
    """Raise an InputError unless a tuning can start from weights: all numbers are in their box."""
    trees = (start, *bounds(like=start))
    at, low, high = (np.asarray(weights_to_vector(w), float) for w in trees)
    for name, value, least, most in zip(weight_names(start), at, low, high, strict=True):
        if not least <= value <= most:
            text = f"a tuning starts from weights of {least:g} to {most:g}"
            raise InputError(f"{name} is {value:g}; {text}")
    for other in others:
        if reason := out_of_box(other, start.others[name_of(other)]):
            raise InputError(reason)


def weights_after(
    start: Weights, steps: Float[Array | np.ndarray, " n"], others: Sequence[Other] = ()
) -> Weights:
    """Return the weights of `stepped`, clipped to the box against rounding of the logarithm."""
    lower, upper = bounds(others, start)
    after = stepped(start, steps, others)
    moved = after._replace(others={name: after.others[name] for name in lower.others})
    clipped = jax.tree.map(jnp.clip, moved, lower, upper)
    return clipped._replace(others={**after.others, **clipped.others})


def gradient_by_steps(
    weights: Weights, gradient: Weights, others: Sequence[Other] = ()
) -> Float[Array, " n"]:
    """Return the gradient by the steps of `stepped` from that by the weights."""
    none = jnp.zeros_like(steps_between(weights, weights, others))
    return jax.vjp(lambda steps: stepped(weights, steps, others), none)[1](gradient)[0]


def gradient_by_weights(
    weights: Weights, gradient: Float[Array, " n"], others: Sequence[Other] = ()
) -> Weights:
    """Return the gradient by the weights of which `gradient_by_steps` is this one.

    Feet have equal shares; numbers that are not stepped have zero.
    """
    none = jnp.zeros_like(gradient)

    def change(steps: Float[Array, " n"]) -> Weights:
        return jax.jvp(lambda steps: stepped(weights, steps, others), (none,), (steps,))[1]

    squares = gradient_by_steps(weights, change(jnp.ones_like(gradient)), others)
    return change(gradient / squares)
