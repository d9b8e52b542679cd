"""The process in which one or two robots walk for a page.

The page sends a `Call`, a method of `Session` with its arguments; what that returns is sent back.
Frames are sent when the page asks, so that a late page slows nothing down. Weights, commands and
plants are numbers of compiled programs: after `warm_up` nothing compiles.
"""

import time
from collections import deque
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.control.controller import walk_config
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import weights_tree
from hector_jax.robot.model import Robot
from hector_jax.sim.live import LiveWalk, Now, Walked
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import BLOCK
from hector_jax.sim.world import Imperfections

LATE = 0.1  # [s] that is never caught up
_TIMED = 200  # ticks that the real-time factor is of

Call = tuple[str, tuple[Any, ...]]
"""Name of a method of `Session`, and its arguments."""


class Frame(NamedTuple):
    """What the page shows."""

    walks: list[Now]
    starts: list[Float[np.ndarray, "6"] | None]  # errors before the weights of the start changed
    factor: float  # simulated by real time
    wanted: float  # the same, as the page wants it


class Session:
    """One or two robots on the same plant, under the same command and pushes."""

    def __init__(self, robot: Robot, jobs: Sequence[Job]) -> None:
        """Let a robot stand for each job; they differ in their weights alone."""
        self.config, self._robot = walk_config(robot), robot
        self._first, self.speed, self._payload = [job.weights for job in jobs], 1.0, 0.0
        self._marks = deque[float](maxlen=_TIMED)  # when the last ticks were
        self._stand(jobs)

    def warm_up(self) -> None:
        """Compile all that a walk can need, on a walk that is thrown away."""
        job = self.walks[0].job
        walk = LiveWalk(self.config, self._robot, job)
        for pending in range(1, BLOCK + 1):  # each number of ticks is a shape of its own
            for _ in range(pending):
                walk.tick()
                walk.now()
            walk.set_command(job.command)

    def tick(self) -> None:
        """Walk to the next plan."""
        for walk in self.walks:
            walk.tick()
        self._marks.append(time.monotonic())

    # Calls of the page

    def frame(self) -> Frame:
        """Return where the robots are."""
        ticks, factor = len(self._marks) - 1, self.speed
        if ticks > _TIMED // 10:
            factor = ticks * self.config.gait.tick / (self._marks[-1] - self._marks[0])
        return Frame([walk.now() for walk in self.walks], list(self._starts), factor, self.speed)

    def reset(self) -> None:
        """Stand at the start again."""
        self._stand([walk.job for walk in self.walks])

    def set_speed(self, speed: float) -> None:
        """Walk so many times as fast as in real time; 0 stops the time."""
        self.speed = speed
        self._marks.clear()

    def set_weights(self, i: int, weights: Weights) -> None:
        """Give set `i` other weights."""
        walk, now = self.walks[i], self.walks[i].now()
        untouched = weights_tree(walk.job.weights) == weights_tree(self._first[i])
        if untouched and now.seconds > 0.0 and not now.fall:
            self._starts[i] = now.errors
        walk.set_job(walk.job._replace(weights=weights))

    def set_velocity(self, ahead: float, aside: float, yaw_rate: float) -> None:
        """Command a velocity [m/s] and a yaw rate [rad/s]."""
        command = Command(np.full(2, 2.0), np.full((2, 2), [ahead, aside]), np.full(2, yaw_rate))
        for walk in self.walks:
            walk.set_command(command)
        self._forget_starts()

    def set_numbers(self, plant: Imperfections, payload: float) -> None:
        """Change numbers of the plant, see `LiveWalk.set_plant`."""
        self._payload = payload
        for walk in self.walks:
            walk.set_plant(plant, payload)
        self._forget_starts()

    def set_world(self, plant: Imperfections, seed: int) -> None:
        """Stand at the start on another plant, with the noise of a seed."""
        self._stand([walk.job._replace(imperfections=plant, seed=seed) for walk in self.walks])

    def push(self, force: Float[np.ndarray, "3"]) -> None:
        """Push the trunks [N], as the robots face."""
        for walk in self.walks:
            walk.push(force)

    def log(self, i: int) -> Walked | str:
        """Return the last seconds of a walk, or why a tuning cannot step from them."""
        return self.walks[i].log()

    def _stand(self, jobs: Sequence[Job]) -> None:
        self.walks = [LiveWalk(self.config, self._robot, job, self._payload) for job in jobs]
        self._forget_starts()

    def _forget_starts(self) -> None:
        self._starts: list[Float[np.ndarray, 6] | None] = [None for _ in self.walks]


def simulate(connection: Connection, robot: Robot, jobs: Sequence[Job]) -> None:
    """Walk in real time, until the page is gone: the work of the process."""
    session = Session(robot, jobs)
    session.warm_up()
    tick, last, lag = session.config.gait.tick, time.monotonic(), 0.0
    while True:
        while connection.poll(max(tick - lag, 0.0)):
            name, values = connection.recv()
            if (answer := getattr(session, name)(*values)) is not None:
                connection.send(answer)
        now = time.monotonic()
        lag, last = min(lag + (now - last) * session.speed, LATE), now
        if lag >= tick:
            session.tick()
            lag -= tick
