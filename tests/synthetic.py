"""Walks that no simulator made: a command with switches, and a ground that answers late and wrong.

In the yaw frame the effect is a lagged, biased and saturated function of the commands, with noise
that nothing can predict.
"""

import jax
import numpy as np
from pretend import still_walk

from hector_jax.core.trajectory import State, Trajectory, Wrench

CYCLE, SUBSTEPS = 40, 10


def turns(yaw) -> np.ndarray:
    """Rotations about z; NumPy, which has no program to compile for each number of samples."""
    c, s, one = np.cos(yaw), np.sin(yaw), np.ones_like(yaw)
    rows = [[c, -s, 0 * one], [s, c, 0 * one], [0 * one, 0 * one, one]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def synthetic_walk(seed: int, ticks: int = 400, noise: float = 1.0) -> Trajectory:
    """One walk at 1 kHz that turns slowly; numpy arrays."""
    rng = np.random.default_rng(seed)
    tick = np.arange(ticks)
    stands = np.stack([tick % CYCLE < CYCLE // 2, tick % CYCLE >= CYCLE // 2], axis=1)
    drift = np.cumsum(rng.normal(size=(ticks, 2, 6)), axis=0)
    drift -= 0.9 * np.concatenate([np.zeros((1, 2, 6)), drift[:-1]])  # nearly white, some memory
    spread = np.array([8.0, 15.0, 8.0, 0.0, 1.5, 0.8])
    command = np.array([0.0, 0.0, 118.0, 0.0, 0.0, 0.0]) + spread * drift * 0.4
    command *= stands[..., None]
    before = np.concatenate([command[:1], command[:-1]])
    mixed = 0.7 * command + 0.3 * before
    limit = np.array([10.0, 15.0, 400.0, 1.0, 0.5, 0.3])
    effect = mixed / (1.0 + np.abs(mixed / limit)) + np.array([3.0, -2.0, 20.0, 0.05, 0.3, -0.1])
    effect[..., 2] -= 0.15 * (mixed[..., 2] - 60.0) ** 2 / 60.0 + 2.0 * np.abs(mixed[..., 1])
    effect += noise * np.array([2.0, 2.0, 5.0, 0.05, 0.2, 0.1]) * rng.normal(size=effect.shape)
    yaw = 0.3 * np.sin(np.arange(ticks * SUBSTEPS + 1) / 1000) + rng.uniform(-1, 1)

    def to_world(w: np.ndarray, angle: np.ndarray) -> np.ndarray:
        return np.einsum("tij,tfj->tfi", turns(angle), w)

    held = np.repeat(yaw[:-1:SUBSTEPS], SUBSTEPS)
    fine = lambda w: to_world(np.repeat(w, SUBSTEPS, axis=0), held)  # noqa: E731
    samples = ticks * SUBSTEPS
    # ripples inside a tick, which the mean over the tick must not see
    ripple = np.tile(np.linspace(-1, 1, SUBSTEPS), ticks)[:, None, None]
    euler = np.zeros((samples + 1, 3))
    euler[:, 2] = yaw
    motion = rng.normal(size=(3, samples + 1, 3))
    states = State(euler, *motion)
    states, initial = jax.tree.map(lambda s: s[1:], states), jax.tree.map(lambda s: s[0], states)
    effect = Wrench(fine(effect[..., :3]) + ripple, fine(effect[..., 3:]) + 0.1 * ripple)
    parts = {"command": Wrench(fine(command[..., :3]), fine(command[..., 3:])), "effect": effect}
    parts |= {"contact": np.repeat(stands, SUBSTEPS, axis=0), "initial": initial}
    parts |= {"feet": rng.normal(size=(samples, 2, 3)), "joints": rng.normal(size=(samples, 10))}
    return still_walk(samples, period=np.array(0.001), state=states, reference=states, **parts)
