"""The contact schedule of the feet in integer ticks.

A tick is one plan interval. Before the gait starts all feet stand; from `first_tick` on a foot
stands in the first `stance` ticks of its own cycle, which leads the gait's cycle by the offset of
this foot in the pattern. A switch tick belongs to the new stance. With zero `swing` all feet stand.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError, short_repr, unknown
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, check, choose
from hector_jax.core.trajectory import FEET

PATTERNS = {
    "walk": (0.0, 0.5),
    "trot": (0.0, 0.5, 0.5, 0.0),
    "pace": (0.0, 0.5, 0.0, 0.5),
    "crawl": (0.0, 0.5, 0.25, 0.75),
}
"""Phase lead of each foot as a share of the cycle, in the order of `trajectory.FEET`."""

_DUTY = {"crawl": 0.75}  # share of the cycle in stance; 0.5 for the other patterns
STAND = "stand"
GAITS = (*PATTERNS, STAND)


@dataclass(frozen=True)
class GaitConfig:
    """Timing of the gait, in ticks."""

    tick: Annotated[float, POSITIVE] = 0.01  # [s] plan interval
    stance: Annotated[int, AT_LEAST_ONE] = 20  # ticks of a stance
    swing: Annotated[int, NOT_NEGATIVE] = 20  # ticks of a swing; 0: all feet stand
    # ticks with all feet in stance before the gait starts (MuJoCo worlds)
    stand: Annotated[int, NOT_NEGATIVE] = 30
    cycles: Annotated[int, NOT_NEGATIVE] = 2  # gait cycles in place before t = 0 (MuJoCo worlds)
    pattern: str | tuple[float, ...] = "walk"  # name in PATTERNS, or an offset for each foot

    def __post_init__(self) -> None:
        check(self)
        if isinstance(self.pattern, str):
            choose("GaitConfig.pattern", self.pattern, PATTERNS)
        if not all(0.0 <= share < 1.0 for share in self.offsets) or len(self.offsets) not in FEET:
            raise InputError(
                "GaitConfig.pattern must be numbers in [0, 1), one for each of 2 or 4 feet, "
                f"got {short_repr(self.pattern)}"
            )
        times = f"stance {self.stance}, swing {self.swing}"
        if np.any(np.abs(self._lead - self.cycle * np.array(self.offsets)) > 1e-6):
            raise InputError(
                "GaitConfig.stance must make a cycle with swing of which each offset "
                f"{list(self.offsets)} is a whole number of ticks, got {times}"
            )
        if not self._stands.any(axis=1).all():
            raise InputError(
                "GaitConfig.stance must be at least swing with two feet: one has to stand at each "
                f"tick, got {times}"
            )

    @property
    def offsets(self) -> tuple[float, ...]:
        """Phase lead of each foot as a share of the cycle."""
        return PATTERNS[self.pattern] if isinstance(self.pattern, str) else self.pattern

    @property
    def _lead(self) -> Int[np.ndarray, " feet"]:
        """Phase lead of each foot in ticks."""
        return np.rint(self.cycle * np.array(self.offsets)).astype(int)

    @property
    def _stands(self) -> Bool[np.ndarray, "cycle feet"]:
        """Stance feet at each tick of a cycle."""
        return (np.arange(self.cycle)[:, None] + self._lead) % self.cycle < self.stance

    @property
    def most_contacts(self) -> int:
        """Largest number of feet in stance at once during the gait."""
        return int(self._stands.sum(axis=1).max())

    @property
    def cycle(self) -> int:
        """Number of ticks of a cycle."""
        return self.stance + self.swing

    @property
    def first_tick(self) -> int:
        """Tick at which the gait starts; all feet stand before."""
        return -self.cycles * self.cycle


def gait_named(config: GaitConfig, name: str) -> GaitConfig:
    """Return the gait of a name in GAITS with the swing time of a given gait.

    Raises:
        InputError: the gait is unknown or has another number of feet.
    """
    if name == STAND:
        return replace(config, stance=config.cycle, swing=0)
    gaits = [gait for gait, leads in PATTERNS.items() if len(leads) == len(config.offsets)]
    if name in PATTERNS and name not in gaits:
        raise InputError(f"{name} is for {len(PATTERNS[name])} legs, not {len(config.offsets)}")
    if name not in gaits:
        raise InputError(unknown("gait", name, [*gaits, STAND]))
    duty = _DUTY.get(name, 0.5)
    return replace(config, pattern=name, stance=round(config.swing * duty / (1.0 - duty)))


def _feet_ticks(config: GaitConfig, tick: Int[Array, "*batch"]) -> Int[Array, "*batch feet"]:
    """Return the clock of each foot in ticks, a multiple of the cycle at its touchdown."""
    return jnp.maximum(tick, config.first_tick)[..., None] + jnp.asarray(config._lead)


def contact(config: GaitConfig, tick: Int[Array, "*batch"]) -> Bool[Array, "*batch feet"]:
    """Return the feet that stand in the interval that starts at `tick`.

    >>> contact(GaitConfig(), jnp.array([0, 19, 20, 40])).tolist()  # left, right
    [[True, False], [True, False], [False, True], [True, False]]
    """
    stance = _feet_ticks(config, tick) % config.cycle < config.stance
    return stance | (tick < config.first_tick)[..., None]


def swing_ticks(config: GaitConfig, tick: Int[Array, "*batch"]) -> Int[Array, "*batch feet"]:
    """Return the ticks since lift-off; zero for a foot in stance."""
    since = _feet_ticks(config, tick) % config.cycle - config.stance
    return jnp.where(contact(config, tick), 0, since)


def since_touchdown(config: GaitConfig, tick: Int[Array, "*batch"]) -> Int[Array, "*batch feet"]:
    """Return the ticks since the last touchdown of each foot, or since the gait's start."""
    clock = _feet_ticks(config, tick)
    return jnp.minimum(clock % config.cycle, clock - config._lead - config.first_tick)


def ticks_to_touchdown(config: GaitConfig, tick: Int[Array, "*batch"]) -> Int[Array, "*batch feet"]:
    """Return the ticks until the next touchdown of each foot.

    >>> ticks_to_touchdown(GaitConfig(), jnp.asarray(5)).tolist()
    [35, 15]
    """
    wait = jnp.maximum(config.first_tick - tick, 0)[..., None]
    return wait + config.cycle - _feet_ticks(config, tick) % config.cycle


def touchdowns(
    config: GaitConfig, tick: Int[Array, ""], later: Int[Array, " N"]
) -> Int[Array, "N feet"]:
    """Count the touchdowns of each foot after `tick` and up to each of the ticks `later`."""
    if config.swing == 0:
        return jnp.zeros((len(later), len(config.offsets)), int)
    count = lambda t: _feet_ticks(config, t) // config.cycle  # noqa: E731
    return count(later) - count(tick)


def since_switch(config: GaitConfig, tick: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the time [s] since the last planned touchdown or lift-off."""
    clock = _feet_ticks(config, tick) % config.cycle
    since = jnp.where(clock < config.stance, clock, clock - config.stance)
    return config.tick * jnp.min(since, axis=-1)
