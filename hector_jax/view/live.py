"""The process in which one or two robots walk for a page, and what page and process send.

The page sends a `Call`, a method of `Session` with its arguments; the process sends a `Frame` at
most 30 times a second, and only after the page has taken the last one, so that a page that is late
slows nothing down. Weights, commands and plants are numbers of compiled programs: after `warm_up`
nothing compiles.
"""

import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.controller import WalkConfig, walk_config
from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.trajectory import Trajectory
from hector_jax.robot.model import Robot
from hector_jax.sim.live import WINDOW, LiveWalk, Now
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import BLOCK
from hector_jax.sim.world import Imperfections

FRAME = 1.0 / 30.0  # [s]
_LATE = 0.1  # [s] of simulated time that is never caught up
_COMPILED = "/jax/core/compile/backend_compile_duration"


class Frame(NamedTuple):
    """What the page shows."""

    walks: list[Now]
    starts: list[Float[np.ndarray, "6"] | None]  # errors with the weights of the start, see `Now`
    factor: float  # simulated by real time
    wanted: float  # the same, as the page wants it
    compilations: int  # since the start


class Walked(NamedTuple):
    """The last seconds of a walk, for a step of a tuning."""

    walk: Trajectory
    weights: Weights
    command: Command
    anchor: Anchor
    start_tick: int  # gait tick of its first sample


Call = tuple[str, tuple[Any, ...]]
"""Name of a method of `Session`, and its arguments."""


class Session:
    """One or two robots on the same plant, under the same command and pushes."""

    def __init__(self, robot: Robot, jobs: Sequence[Job]) -> None:
        """Let a robot stand for each job; they differ in their weights alone."""
        self.config: WalkConfig = walk_config(robot)
        self.robot, self.speed, self.running, self._payload = robot, 1.0, True, 0.0
        self._jobs = list(jobs)
        self._first = [job.weights for job in jobs]
        self._starts: list[Float[np.ndarray, 6] | None] = [None for _ in jobs]
        self._steady = [0 for _ in jobs]  # ticks since weights, command or plant changed
        self.walks: list[LiveWalk] = []
        self.reset()

    def warm_up(self) -> None:
        """Compile all that a walk can need, on a walk that is thrown away."""
        job = self._jobs[0]
        walk = LiveWalk(self.config, self.robot, job)
        while walk.clock < job.start_tick + BLOCK + 3 and not walk.fall:
            walk.tick()
            walk.now()
        for pending in range(1, BLOCK + 1):  # each number of ticks is a shape of its own
            for _ in range(pending):
                walk.tick()
            walk.set_command(job.command)
        walk.set_job(job)

    def tick(self) -> None:
        """Walk to the next plan."""
        for i, walk in enumerate(self.walks):
            walk.tick()
            self._steady[i] += 1

    def frame(self) -> tuple[list[Now], list[Float[np.ndarray, "6"] | None]]:
        """Return where the robots are, and their errors with the weights of the start."""
        found = [walk.now() for walk in self.walks]
        for i, now in enumerate(found):
            if self._jobs[i].weights is self._first[i] and now.seconds > 0.0 and not now.fall:
                self._starts[i] = now.errors
        return found, list(self._starts)

    # Calls of the page

    def reset(self) -> None:
        """Stand at the start again."""
        make, payload = LiveWalk, self._payload
        self.walks = [make(self.config, self.robot, job, payload) for job in self._jobs]
        self._changed()

    def run(self, running: bool) -> None:
        """Go on, or stop the time."""
        self.running = running

    def set_speed(self, speed: float) -> None:
        """Walk so many times as fast as in real time."""
        self.speed = speed

    def set_weights(self, i: int, weights: Weights) -> None:
        """Give set `i` other weights."""
        same = weights_tree(weights) == weights_tree(self._first[i])
        self._jobs[i] = self._jobs[i]._replace(weights=self._first[i] if same else weights)
        self.walks[i].set_job(self.walks[i].job._replace(weights=self._jobs[i].weights))
        self._steady[i] = 0

    def set_velocity(self, ahead: float, aside: float, yaw_rate: float) -> None:
        """Command a velocity [m/s] and a yaw rate [rad/s]."""
        command = Command(np.full(2, 2.0), np.full((2, 2), [ahead, aside]), np.full(2, yaw_rate))
        self._jobs = [job._replace(command=command) for job in self._jobs]
        for walk in self.walks:
            walk.set_command(command)
        self._changed()

    def set_plant(self, plant: Imperfections, payload: float) -> None:
        """Change the numbers of the plant, and what sits on its trunk [kg]."""
        # backlash has joints of its own, and the noise of a walk is drawn where it begins
        parts = lambda x: [bool(x.backlash > 0.0), *map(float, x.estimator)]  # noqa: E731
        old, self._payload = self._jobs[0].imperfections, payload
        self._jobs = [job._replace(imperfections=plant) for job in self._jobs]
        if parts(old) != parts(plant):
            return self.reset()
        for walk in self.walks:
            walk.set_plant(walk.job._replace(imperfections=plant), payload)
        return self._changed()

    def push(self, force: Float[np.ndarray, "3"]) -> None:
        """Push the trunks [N], as the robots face."""
        for walk in self.walks:
            walk.push(force)

    def log(self, i: int) -> Walked | str:
        """Return the last seconds of a walk, or why a tuning cannot step from them."""
        walk, tick = self.walks[i], self.config.gait.tick
        count = round(WINDOW / tick)
        ready = min(self._steady[i], walk.clock - walk.job.start_tick) // BLOCK * BLOCK
        if walk.fall or ready < count:
            more = (count - ready) * tick
            return "it fell: reset" if walk.fall else f"{more:.1f} s more with nothing moved"
        walked = walk.trajectory()
        weights, command = walk.job.weights, walk.job.command
        start = walk.sampled_to - count
        return Walked(walked, weights, command, jax.device_get(walk.anchor), start)

    def _changed(self) -> None:
        self._steady = [0 for _ in self._jobs]
        self._starts = [None for _ in self._jobs]


def count_compilations() -> Callable[[], int]:
    """Return a function that tells how many programs this process has compiled or loaded since."""
    found = []

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        if event == _COMPILED:
            found.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    return lambda: len(found)


def simulate(connection: Connection, robot: Robot, jobs: Sequence[Job]) -> None:
    """Walk in real time, until the page is gone: the work of the process."""
    session = Session(robot, jobs)
    session.warm_up()
    compilations, tick = count_compilations(), session.config.gait.tick
    last, due, taken, lag, marks = time.monotonic(), 0.0, True, 0.0, [(time.monotonic(), 0.0)]
    while True:
        while connection.poll(0.0 if session.running and lag >= tick else 0.002):
            name, values = connection.recv()
            if name == "close":
                return
            taken |= name == "taken"
            if name == "log":
                connection.send(session.log(*values))
            elif name != "taken":
                getattr(session, name)(*values)
        now = time.monotonic()
        lag = min(lag + (now - last) * session.speed * session.running, _LATE)
        last = now
        if lag >= tick and session.running:
            session.tick()
            lag -= tick
            marks.append((now, marks[-1][1] + tick))
        if taken and now >= due:
            due, taken = max(due + FRAME, now), False
            marks = [mark for mark in marks if now - mark[0] < 2.0] or marks[-1:]
            passed, walked = now - marks[0][0], marks[-1][1] - marks[0][1]
            factor = walked / passed if passed > 0.2 else session.speed
            wanted = session.speed * session.running
            connection.send(Frame(*session.frame(), factor, wanted, compilations()))
