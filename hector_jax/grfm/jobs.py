"""Draws the walks from which phi is learned, around the weights and commands of tuning."""

from collections.abc import Sequence

import jax
import numpy as np

from hector_jax.control.reference import COMMANDS, PIECES, Command, named_command, with_pieces
from hector_jax.control.weights import Weights, between, expert, nominal
from hector_jax.robot.description import HECTOR
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import Job
from hector_jax.sim.world import Push, hfs_with_motors

KINDS = (*COMMANDS, "random")  # of commands; job i is of kind i modulo their number
SPREAD = 3.0  # weights are drawn log-uniformly within x/SPREAD of their centre
PUSHES = 2  # of every walk, so that jobs can be stacked; most have zero force
PUSH_TIME = 0.1  # [s]


def draw_jobs(
    seed: int,
    count: int,
    paths: Sequence[Weights] = (),
    *,
    seconds: float = 4.0,
    robot: Robot | None = None,
) -> list[Job]:
    """Draw walks around the nominal and expert weights, and along tuning paths.

    Trajectories take turns: straight, c, s, random velocities. Weights take turns too: each of the
    24 log-uniform around nominal, around expert and, if tuning paths are given, a point of a path.
    Each walk has a plant of its own, drawn around the hfs. A random third of the walks is pushed
    once or twice: 10 to 30 N (times the robot's size) for 0.1 s, from any side. Job i depends on
    the seed and on i alone, so a longer list begins with the shorter one.

    Args:
        seed: of all random draws.
        count: number of walks.
        paths: weights along tunings, each path stacked along a first axis; points are drawn on the
            log-lines between them.
        seconds: length of each walk.
        robot: robot of the weights and plants; HECTOR by default.

    Raises:
        ValueError: fewer than one walk.
    """
    if count < 1:
        raise ValueError(f"the number of walks must be at least 1, got {count}")
    centres = nominal(robot), expert(robot)
    description = HECTOR if robot is None else robot.description

    def draw(i: int) -> Job:
        rng = np.random.default_rng([seed, i])
        kind = KINDS[i % len(KINDS)]
        command = _random_command(rng) if kind == "random" else with_pieces(named_command(kind))
        centre = (i // len(KINDS)) % (3 if paths else 2)
        if centre == 2:
            path = paths[int(rng.integers(len(paths)))]
            weights = _along(path, rng.uniform(0.0, len(path.Q.euler) - 1))
        else:
            draw_one = lambda w: w * SPREAD ** rng.uniform(-1.0, 1.0, w.shape)  # noqa: E731
            weights = jax.tree.map(draw_one, centres[centre])
        plant = hfs_with_motors(int(rng.integers(2**31)), description=description)
        push = _draw_push(rng, seconds, description.plants.push)
        return Job(weights, command, plant, seconds, seed=i, push=push)

    return [draw(i) for i in range(count)]


def _along(path: Weights, position: float) -> Weights:
    """Return weights on the line between two points of a path, counted from 0."""
    index, next_ = int(position), min(int(position) + 1, len(path.Q.euler) - 1)
    first, second = (jax.tree.map(lambda w, i=i: np.asarray(w)[i], path) for i in (index, next_))
    return between(first, second, position - index)


def _draw_push(rng: np.random.Generator, seconds: float, scale: float) -> Push:
    count = rng.integers(1, PUSHES + 1) if rng.random() < 1.0 / 3.0 else 0
    size = scale * rng.uniform(10.0, 30.0, PUSHES) * (np.arange(PUSHES) < count)
    angle = rng.uniform(-np.pi, np.pi, PUSHES)
    force = size[:, None] * np.stack([np.cos(angle), np.sin(angle), np.zeros(PUSHES)], axis=1)
    start = rng.uniform(0.0, max(seconds - PUSH_TIME, 0.0), PUSHES)
    return Push(force, start, np.full(PUSHES, PUSH_TIME))


def _random_command(rng: np.random.Generator) -> Command:
    return Command(
        duration=rng.uniform(0.5, 1.5, PIECES),
        velocity=rng.uniform([-0.2, -0.2], [0.6, 0.2], (PIECES, 2)),
        yaw_rate=rng.uniform(-0.5 * np.pi, 0.5 * np.pi, PIECES),
    )
