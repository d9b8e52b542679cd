"""The controller's numbers as one tree, and which of them are tuned.

What is only a number is traced: a new value compiles nothing and has a derivative. What shapes a
program stays in `WalkConfig`, whose numbers are the defaults:

>>> from hector_jax.control.controller import WalkConfig
>>> from hector_jax.control.weights import expert
>>> parameters = WalkConfig().parameters(expert())
>>> FEEDBACK.read(parameters)
0.12
>>> FEEDBACK.write(parameters, 0.2).footstep.feedback
0.2
"""

from collections.abc import Sequence
from operator import attrgetter
from typing import Any, NamedTuple

from hector_jax.control.footstep import FootstepParameters
from hector_jax.control.legs import LegParameters
from hector_jax.control.mpc import MpcParameters
from hector_jax.core.inputs import InputError, unknown


class Parameters(NamedTuple):
    """All numbers of the controller."""

    mpc: MpcParameters
    footstep: FootstepParameters
    legs: LegParameters


class Tunable(NamedTuple):
    """A part of `Parameters` that is tuned, and its box."""

    path: str  # "mpc.weights.Q"
    lower: float
    upper: float

    def read(self, parameters: Parameters) -> Any:
        """The part: a number or a tree of them."""
        return attrgetter(self.path)(parameters)

    def write(self, parameters: Parameters, value: Any) -> Parameters:
        """The parameters with another value of the part."""

        def within(tree: Any, names: Sequence[str]) -> Any:
            first, *rest = names
            new = within(getattr(tree, first), rest) if rest else value
            return tree._replace(**{first: new})

        return within(parameters, self.path.split("."))


THETA = (Tunable("mpc.weights.Q", 1e-2, 1e4), Tunable("mpc.weights.R", 1e-7, 1.0))
"""What is tuned by default: the 24 weights."""

FEEDBACK = Tunable("footstep.feedback", 0.0, 0.5)
BY_NAME = {
    "footstep_feedback": FEEDBACK,
    "footstep_width": Tunable("footstep.width", 0.0, 0.2),
    "turn_lead": Tunable("footstep.turn", 0.0, 2.0),
    "effort_reference": Tunable("mpc.effort_reference", 0.0, 1.0),
    "friction": Tunable("mpc.friction", 0.1, 1.0),
    "gravity_compensation": Tunable("legs.gravity_compensation", 0.0, 1.0),
    "foot_height": Tunable("legs.height", 0.02, 0.2),
    "kp": Tunable("legs.kp", 1.0, 300.0),
    "kd": Tunable("legs.kd", 0.05, 10.0),
}
"""Others that can be asked for by name."""


def tunables(names: Sequence[str]) -> tuple[Tunable, ...]:
    """Those of these names, for a tuner that follows the gradient of the rigid-body model.

    Raises:
        InputError: a name is unknown, or the model does not feel it: its gradient is zero.
    """
    for name in names:
        if name not in BY_NAME:
            raise InputError(unknown("tunable", name, BY_NAME))
        if BY_NAME[name].path.startswith("legs."):
            raise InputError(
                f"{name} cannot be tuned by gradients: the rigid-body model has no joints, so its "
                "gradient is zero; a search on walks can"
            )
    return tuple(BY_NAME[name] for name in names)
