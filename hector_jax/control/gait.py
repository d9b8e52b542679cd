"""Who stands when: the contact schedule in integer ticks.

A tick is one plan interval. Before the gait starts all feet stand; from `first_tick` on a foot
stands in the first `stance` ticks of its own cycle, which is ahead of the gait's by the offset that
the pattern has for it. A switch tick belongs to the new stance. With no `swing` all feet stand.
"""

from dataclasses import dataclass, replace

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
"""Shares of a cycle by which the feet are ahead, in the order of `trajectory.FEET`."""

_DUTY = {"crawl": 0.75}  # share of the cycle in which a foot stands; of the others one half
STAND = "stand"
GAITS = (*PATTERNS, STAND)


@dataclass(frozen=True)
class GaitConfig:
    """Timing of the gait, in ticks."""

    tick: float = 0.01  # [s] plan interval
    stance: int = 20  # ticks a foot stands
    swing: int = 20  # ticks a foot swings; 0: all feet stand
    stand: int = 30  # ticks in which all feet stand before the gait starts (MuJoCo worlds)
    cycles: int = 2  # gait cycles in place before t = 0 (MuJoCo worlds)
    pattern: str | tuple[float, ...] = "walk"  # of PATTERNS; or an offset for each foot

    def __post_init__(self) -> None:
        rules = {"tick": POSITIVE, "stance": AT_LEAST_ONE, "swing": NOT_NEGATIVE}
        check(self, **rules, stand=NOT_NEGATIVE, cycles=NOT_NEGATIVE)
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
        """Share of the cycle by which each foot is ahead."""
        return PATTERNS[self.pattern] if isinstance(self.pattern, str) else self.pattern

    @property
    def _lead(self) -> Int[np.ndarray, " feet"]:
        """Ticks by which each foot is ahead."""
        return np.rint(self.cycle * np.array(self.offsets)).astype(int)

    @property
    def _stands(self) -> Bool[np.ndarray, "cycle feet"]:
        """Which feet stand at each tick of a cycle."""
        return (np.arange(self.cycle)[:, None] + self._lead) % self.cycle < self.stance

    @property
    def most_contacts(self) -> int:
        """Most feet that stand at once while it walks."""
        return int(self._stands.sum(axis=1).max())

    @property
    def cycle(self) -> int:
        """Ticks of a whole cycle."""
        return self.stance + self.swing

    @property
    def first_tick(self) -> int:
        """Tick at which the first foot lifts; all feet stand before."""
        return -self.cycles * self.cycle


def gait_named(config: GaitConfig, name: str) -> GaitConfig:
    """The gait of a name of GAITS at the pace of another: it swings as long.

    Raises:
        InputError: there is no such gait, or it is one of a robot with other feet.
    """
    if name == STAND:
        return replace(config, stance=config.cycle, swing=0)
    of_feet = [one for one in PATTERNS if len(PATTERNS[one]) == len(config.offsets)]
    if name not in of_feet:
        raise InputError(unknown("gait", name, [*of_feet, STAND]))
    duty = _DUTY.get(name, 0.5)
    return replace(config, pattern=name, stance=round(config.swing * duty / (1.0 - duty)))


def _feet_ticks(config: GaitConfig, tick: Int[Array, "*batch"]) -> Int[Array, "*batch feet"]:
    """Ticks of each foot's own clock, which is a multiple of the cycle at its touchdown."""
    after = jnp.maximum(tick, config.first_tick)
    return after[..., None] + jnp.asarray(config._lead)


def contact(config: GaitConfig, tick: Int[Array, "*batch"]) -> Bool[Array, "*batch feet"]:
    """Which feet stand in the interval that starts at `tick`.

    >>> contact(GaitConfig(), jnp.array([0, 19, 20, 40])).tolist()  # left, right
    [[True, False], [True, False], [False, True], [True, False]]
    """
    gait = _feet_ticks(config, tick) % config.cycle < config.stance
    return gait | (tick < config.first_tick)[..., None]


def swing_ticks(config: GaitConfig, tick: Int[Array, "*batch"]) -> Int[Array, "*batch feet"]:
    """Ticks since lift-off; zero for a foot that stands."""
    since = _feet_ticks(config, tick) % config.cycle - config.stance
    return jnp.where(contact(config, tick), 0, since)


def ticks_to_touchdown(config: GaitConfig, tick: Int[Array, "*batch"]) -> Int[Array, "*batch feet"]:
    """Ticks until each foot next touches down.

    >>> ticks_to_touchdown(GaitConfig(), jnp.asarray(5)).tolist()
    [35, 15]
    """
    wait = jnp.maximum(config.first_tick - tick, 0)[..., None]
    return wait + config.cycle - _feet_ticks(config, tick) % config.cycle


def touchdowns(
    config: GaitConfig, tick: Int[Array, ""], later: Int[Array, " N"]
) -> Int[Array, "N feet"]:
    """How often each foot touches down after `tick` and up to each of the ticks `later`."""
    if config.swing == 0:
        return jnp.zeros((len(later), len(config.offsets)), int)
    count = lambda t: _feet_ticks(config, t) // config.cycle  # noqa: E731
    return count(later) - count(tick)


def since_switch(config: GaitConfig, tick: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Time [s] since the last planned touchdown or lift-off."""
    clock = _feet_ticks(config, tick) % config.cycle
    return config.tick * jnp.min(
        jnp.where(clock < config.stance, clock, clock - config.stance), axis=-1
    )
