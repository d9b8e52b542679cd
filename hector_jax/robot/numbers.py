"""Numbers of a user's controller that a tuning may change: `[numbers.NAME]` in the robot's TOML.

They reach his programs with the weights. What uses a number tells how its slope is found: by calls
of the planner if only the plan does, else by whole walks (`walk_tuning.moved`).
"""

from dataclasses import dataclass

from hector_jax.core.inputs import InputError
from hector_jax.core.settings import check


@dataclass(frozen=True)
class Number:
    """A number of another controller."""

    start: float  # its value where a weights file has none
    low: float
    high: float
    scale: str = "linear"  # or "log", stepped in shares of the box or in logarithms
    used_by: str = "legs"  # or "plan", which then is all that it changes

    def __post_init__(self) -> None:
        check(self, scale=("linear", "log"), used_by=("legs", "plan"))
        if not self.low < self.high:
            raise InputError(f"low must be less than high, got {self.low:g} and {self.high:g}")
        if self.scale == "log" and self.low <= 0.0:
            raise InputError(f"low must be above 0 with the scale log, got {self.low:g}")
        if not self.low <= self.start <= self.high:
            box = f"from {self.low:g} to {self.high:g}"
            raise InputError(f"start must be {box}, got {self.start:g}")
