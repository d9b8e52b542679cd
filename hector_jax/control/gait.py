"""Who stands when: the contact schedule in integer ticks.

A tick is one plan interval. Before the gait starts both feet stand; from `first_tick` on the left
foot stands in the first `stance` ticks of a cycle and the right one half a cycle later. A switch
tick belongs to the new stance. With `stance` longer than half a cycle there is double support.
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, check


@dataclass(frozen=True)
class GaitConfig:
    """Timing of the gait, in ticks."""

    tick: float = 0.01  # [s] plan interval
    stance: int = 20  # ticks a foot stands
    swing: int = 20  # ticks a foot swings
    stand: int = 30  # ticks of double stance before the gait starts (MuJoCo worlds)
    cycles: int = 2  # gait cycles in place before t = 0 (MuJoCo worlds)

    def __post_init__(self) -> None:
        rules = {"tick": POSITIVE, "stance": AT_LEAST_ONE, "swing": AT_LEAST_ONE}
        check(self, **rules, stand=NOT_NEGATIVE, cycles=NOT_NEGATIVE)
        if self.stance < self.swing or (self.stance + self.swing) % 2:
            raise InputError(
                "GaitConfig.stance must be at least swing and make an even cycle with it, "
                f"got stance {self.stance}, swing {self.swing}"
            )

    @property
    def cycle(self) -> int:
        """Ticks of a whole cycle."""
        return self.stance + self.swing

    @property
    def first_tick(self) -> int:
        """Tick at which the first foot lifts; both feet stand before."""
        return -self.cycles * self.cycle

    @property
    def double_support(self) -> bool:
        """Whether both feet stand at some time of the cycle."""
        return self.stance > self.swing


def _feet_ticks(config: GaitConfig, tick: Int[Array, "*batch"]) -> Int[Array, "*batch 2"]:
    """Ticks of each foot's own clock, which is a multiple of the cycle at its touchdown."""
    after = jnp.maximum(tick, config.first_tick)
    return after[..., None] + jnp.array([0, config.cycle // 2])


def contact(config: GaitConfig, tick: Int[Array, "*batch"]) -> Bool[Array, "*batch 2"]:
    """Which feet stand in the interval that starts at `tick`.

    >>> contact(GaitConfig(), jnp.array([0, 19, 20, 40])).tolist()  # left, right
    [[True, False], [True, False], [False, True], [True, False]]
    """
    gait = _feet_ticks(config, tick) % config.cycle < config.stance
    return gait | (tick < config.first_tick)[..., None]


def swing_ticks(config: GaitConfig, tick: Int[Array, "*batch"]) -> Int[Array, "*batch 2"]:
    """Ticks since lift-off; zero for a foot that stands."""
    since = _feet_ticks(config, tick) % config.cycle - config.stance
    return jnp.where(contact(config, tick), 0, since)


def ticks_to_touchdown(config: GaitConfig, tick: Int[Array, "*batch"]) -> Int[Array, "*batch 2"]:
    """Ticks until each foot next touches down.

    >>> ticks_to_touchdown(GaitConfig(), jnp.asarray(5)).tolist()
    [35, 15]
    """
    wait = jnp.maximum(config.first_tick - tick, 0)[..., None]
    return wait + config.cycle - _feet_ticks(config, tick) % config.cycle


def touchdowns(
    config: GaitConfig, tick: Int[Array, ""], later: Int[Array, " N"]
) -> Int[Array, "N 2"]:
    """How often each foot touches down after `tick` and up to each of the ticks `later`."""
    count = lambda t: _feet_ticks(config, t) // config.cycle  # noqa: E731
    return count(later) - count(tick)


def since_switch(config: GaitConfig, tick: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Time [s] since the last planned touchdown or lift-off."""
    clock = _feet_ticks(config, tick) % config.cycle
    return config.tick * jnp.min(
        jnp.where(clock < config.stance, clock, clock - config.stance), axis=-1
    )
