"""Differences of the body and its ground from the controller's model, in a rollout.

Weights that are tuned over several drawn variations are robust to such differences.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hector_jax.control.controller import WalkConfig
from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.trajectory import State, Wrench
from hector_jax.grfm.effect import Effect
from hector_jax.robot import srbm
from hector_jax.robot.model import Robot
from hector_jax.sim.world import ESTIMATE_NOISE

_ESTIMATED = ("angle", "position", "ang_velocity", "velocity")  # names of the fields of a State
_SHARPNESS = 8  # of the edge of the friction pyramid
_MASS, _INERTIA = 0.1, 0.2  # half widths of the drawn factors
_COM = (0.024, 0.024, 0.048)  # half width of the drawn offset, as a share of the standing height
_FRICTION = (0.8, 1.6)  # of the ground, as a share of the plan's
_DELAY = 0.8  # ticks, the most


class Variation(NamedTuple):
    """Difference of the world from the controller's model; see `no_variation`."""

    mass: Float[Array, "*batch"]  # factor on the robot's mass
    inertia: Float[Array, "*batch"]  # factor on the whole inertia matrix
    com: Float[Array, "*batch 3"]  # true less modelled centre of mass, trunk axes [m]
    friction: Float[Array, "*batch"]  # of the ground: bound on (|F_x| + |F_y|) / F_z, as in plants
    delay: Float[Array, "*batch"]  # of the effects [s], at most a tick
    noise: State  # standard deviations of the estimated base state, white from tick to tick
    seed: Int[Array, "*batch"]  # of the noise


def no_variation() -> Variation:
    """Return the variation under which the world equals the controller's model."""
    one, zero, zeros = np.asarray(1.0), np.asarray(0.0), np.zeros(3)
    noise = State(zeros, zeros, zeros, zeros)
    return Variation(one, one, zeros, np.asarray(1e3), zero, noise, np.asarray(0))


def noise_and_delay(noise: float, delay: float) -> Variation:
    """Return the variation by the noise of the estimate and the delay of the effects alone.

    Args:
        noise: factor on the noise of a real robot's estimate.
        delay: [s], at most a tick.
    """
    sizes = (noise * ESTIMATE_NOISE[name] for name in _ESTIMATED)
    noises = State(*(np.full(3, size) for size in sizes))
    variation = no_variation()._replace(noise=noises, delay=np.asarray(delay))
    return jax.tree.map(jnp.asarray, variation)


def drawn_variation(config: WalkConfig, robot: Robot, seed: int) -> Variation:
    """Draw a variation as robots may differ, with the noise of a real robot's estimate.

    Args:
        config: its plan's friction and tick.
        robot: its height.
        seed: equal seeds give equal numbers, that of the noise too.
    """
    rng = np.random.default_rng([0x7A5, seed])
    noise = State(*(np.full(3, ESTIMATE_NOISE[name]) for name in _ESTIMATED))
    return Variation(
        mass=np.asarray(rng.uniform(1.0 - _MASS, 1.0 + _MASS)),
        inertia=np.asarray(rng.uniform(1.0 - _INERTIA, 1.0 + _INERTIA)),
        com=float(robot.standing_height) * np.array(_COM) * rng.uniform(-1.0, 1.0, 3),
        friction=np.asarray(config.mpc.friction * rng.uniform(*_FRICTION)),
        delay=np.asarray(config.gait.tick * rng.uniform(0.0, _DELAY)),
        noise=noise,
        seed=np.asarray(seed),
    )


def estimate_error(variation: Variation, state: State, tick: Int[Array, ""]) -> State:
    """Draw the error of the estimated base state."""
    key = jax.random.fold_in(jax.random.key(variation.seed), tick)
    draws = jax.random.normal(key, (4, 3), state.position.dtype)
    return State(*(sigma * draw for sigma, draw in zip(variation.noise, draws, strict=True)))


def within_friction(wrench: Wrench, friction: Float[Array, ""]) -> Wrench:
    """Scale the horizontal forces of feet smoothly into the friction pyramid."""
    horizontal = jnp.sum(jnp.abs(wrench.force[:, :2]), axis=-1)
    limit = friction * jnp.maximum(wrench.force[:, 2], 0.0)
    # below 1 / use, at four fifths of the limit 0.98 and at the limit 0.92
    use = horizontal / jnp.maximum(limit, 1e-3)
    share = (1.0 + use**_SHARPNESS) ** (-1.0 / _SHARPNESS)
    return wrench._replace(force=wrench.force.at[:, :2].multiply(share[:, None]))


def moved_by(
    variation: Variation,
    robot: Robot,
    state: State,
    *,
    dt: float,
    now: tuple[Effect, Float[Array, "feet 3"]],
    before: tuple[Effect, Float[Array, "feet 3"]],
) -> State:
    """Step the body with its variation; the delayed share acts at the last tick's feet.

    `now` and `before` are the effects of this and of the last tick, and the feet [m].
    """
    share = variation.delay / dt
    (response, feet), (response_before, feet_before) = now, before
    mixed = jax.tree.map(
        lambda new, old: (1.0 - share) * new + share * old, response, response_before
    )
    lever = share * jnp.cross(feet_before - feet, response_before.wrench.force)
    wrench = mixed.wrench._replace(moment=mixed.wrench.moment + lever)
    body = robot._replace(
        mass=variation.mass * robot.mass, inertia=variation.inertia * jnp.asarray(robot.inertia)
    )

    def shifted(state: State, offset: Float[Array, "3"]) -> State:
        arm = rotation_from_euler(state.euler) @ offset
        velocity = state.velocity + jnp.cross(state.ang_velocity, arm)
        return state._replace(position=state.position + arm, velocity=velocity)

    stepped = srbm.step(body, shifted(state, variation.com), wrench, feet, dt, load=mixed.legs)
    return shifted(stepped, -variation.com)
