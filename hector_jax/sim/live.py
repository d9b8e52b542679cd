"""A walk in MuJoCo C that goes on until it falls, while its numbers change; its process.

Untouched it is that of `sim.walk`, to the bit. Weights change between two plans. A new command
starts at the reference of the old one, so that the robot is asked for no jump. Estimator noise
repeats itself after some seconds.

A page sends `Call`s to the process, which sends back what they return: frames when the page asks,
so that a late page slows nothing down. Weights, commands and plants are numbers of compiled
programs: after `warm_up` nothing compiles.
"""

import time
from collections import deque
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.controller import Plan, WalkConfig, walk_config
from hector_jax.control.reference import Anchor, Command, reference_at, with_pieces
from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.headless import mujoco
from hector_jax.core.trajectory import State, Trajectory
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot, quiet_mujoco
from hector_jax.sim import sensing
from hector_jax.sim.diagnosis import BEFORE_FALL, Recorder, likeliest_cause
from hector_jax.sim.loop import Job, Sample, as_trajectory, first_tick
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.walk import BLOCK, Stepper, joined
from hector_jax.sim.world import Imperfections, World, build_world

WINDOW = 4.0  # [s] that are remembered
PUSH_TIME = 0.2  # [s]
LATE = 0.1  # [s] that is never caught up
_NOISE = 20_000  # [ms] after which the estimator's noise repeats itself
_RECORD = round((BEFORE_FALL + 1.0) / TIME_STEP)  # [ms] before a fall that its cause is found from
_TIMED = 200  # ticks that the real-time factor is of
_UNITS = np.array([100.0] * 3 + [np.degrees(1.0)] * 3)  # of errors, by metre and radian

Call = tuple[str, tuple[Any, ...]]
"""Name of a method of `Session`, and its arguments."""

_feet = jax.jit(lambda robot, row: sensing.foot_points(robot, sensing.unpack_reading(row)))


class Now(NamedTuple):
    """What a walk is at, in the world frame."""

    time: float  # [s] after t = 0
    pose: Float[np.ndarray, " nq"]  # of a robot without backlash, as MuJoCo's qpos
    reference: Float[np.ndarray, "3"]  # of the centre of mass [m]
    feet: Float[np.ndarray, "feet 3"]  # foot points [m]
    planned: Float[np.ndarray, "feet 3"]  # force of the ground on each foot [N]
    measured: Float[np.ndarray, "feet 3"]  # over the last tick [N]
    residual: float  # of the QP, relative
    fall: str  # time and likeliest cause; empty while it walks
    seconds: float  # that the errors are of; 0 before t = 0
    errors: Float[np.ndarray, "6"]  # RMS: x, y, z [cm], roll, pitch, yaw [degrees]
    error: Float[np.ndarray, "6"]  # at the last sample


class Walked(NamedTuple):
    """The last seconds of a walk, for a step of a tuning."""

    walk: Trajectory
    weights: Weights
    command: Command
    anchor: Anchor
    start_tick: int  # gait tick of its first sample


class LiveWalk:
    """A walk of one weight set."""

    @quiet_mujoco()
    def __init__(self, config: WalkConfig, robot: Robot, job: Job, payload: float = 0.0) -> None:
        """Walk the first tick from standing; a `payload` [kg] sits in the trunk's centre."""
        self._config, self._robot, self.job, self.fall = config, robot, job, ""
        length = round(BLOCK * config.gait.tick / TIME_STEP)
        self._plant = MujocoPlant(job, robot, 0, length, on_step=self._log_step)
        self._states, self._forces = deque(maxlen=_RECORD // 10), deque(maxlen=_RECORD)
        self._stepper = Stepper(config, robot, job, self._plant)
        self.set_plant(job.imperfections, payload)
        self._ticks = round(WINDOW / config.gait.tick)
        self._blocks: deque[tuple[Plan, Sample]] = deque()  # at least WINDOW and a tick
        self._away = np.full((1, 6), np.nan)  # errors of the last samples from t = 0 on
        self._lead = (job.start_tick - first_tick(config)) * self._stepper.count
        joints, noise = len(robot.joint_lower), job.imperfections.estimator
        self._noise = sensing.draw_errors(noise, joints, job.seed, self._lead, _NOISE)
        self._push, self._pushed, self._pending = np.zeros(3), 0, 0
        self.tick()  # so that there is a plan

    def tick(self) -> None:
        """Walk to the next plan; nothing after a fall."""
        if self.fall:
            return
        count = self._stepper.count
        step = (self._stepper.clock - first_tick(self._config)) * count + np.arange(count)
        rows = np.where(step < self._lead, step, self._lead + (step - self._lead) % _NOISE)
        self._states.append(self._plant.state())
        push = np.tile(self._push * (self._pushed > 0), (count, 1))
        self._stepper.tick(self._noise[rows], push)
        self._pushed, self._pending = self._pushed - 1, self._pending + 1
        if self._pending == BLOCK or self._plant.broken:
            self._sample()

    def set_job(self, job: Job) -> None:
        """Go on with other weights, and the same command and plant."""
        integral = self._config.parameters(job.weights).mpc.integral
        if job.weights is not self.job.weights and not any(integral[:-1]):
            self._stepper.forget_disturbance()  # it would stay as other weights left it
        self.job, self._changed = job, self._stepper.clock
        self._stepper.set_job(job)

    def set_command(self, command: Command) -> None:
        """Go on with another command, which starts where the reference is now."""
        self._sample()
        if (clock := self._stepper.clock) > self.job.start_tick:
            at = self._reference()
            self._stepper.set_anchor(Anchor(at.position, at.euler[2], np.int32(clock)))
        self.set_job(self.job._replace(command=command))

    def set_plant(self, plant: Imperfections, payload: float) -> None:
        """Go on with other numbers of the plant, which keeps its noise and backlash."""
        world = build_world(plant, self._robot.description, sensors=True)
        world.model.body_mass[world.trunk] += payload
        mujoco.mj_setConst(world.model, mujoco.MjData(world.model))
        self._plant.world = world
        self.set_job(self.job._replace(imperfections=plant))

    def push(self, force: Float[np.ndarray, "3"]) -> None:
        """Push the trunk [N] for PUSH_TIME, as the robot faces: ahead, left, up."""
        yaw = 2.0 * np.arctan2(*self._stepper.reading[[6, 3]])
        c, s = np.cos(yaw), np.sin(yaw)
        self._push = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ force
        self._pushed = round(PUSH_TIME / self._config.gait.tick)

    def _sample(self) -> None:
        """Sample the ticks since the last sample; find the cause if it fell."""
        if not self._pending:
            return
        plans, samples = self._stepper.samples()
        self._pending = 0
        self._blocks.append((plans, samples))
        while sum(len(p.residual) for p, _ in list(self._blocks)[1:]) > self._ticks:
            self._blocks.popleft()
        since = self._stepper.clock - self.job.start_tick  # t = 0
        if samples.fallen.any() or self._plant.broken:
            self.fall = f"fell after {since * self._config.gait.tick:.1f} s: {self._cause()}"
        elif since > 0:
            walk = self.trajectory()
            away = np.hstack([walk.state.position, walk.state.euler])
            away -= np.hstack([walk.reference.position, walk.reference.euler])
            self._away = (away * _UNITS)[-since * self._stepper.count :]

    def _log_step(self, world: World, data: mujoco.MjData) -> None:
        self._forces.append((data.ctrl.copy(), data.xfrc_applied[world.trunk, :3].copy()))

    def _cause(self) -> str:
        """Find the likeliest cause of a fall: a record of every step would slow the walk down."""
        recorder = Recorder(self._robot, self._robot)
        count = self._stepper.count
        ticks = min(len(self._states), len(self._forces) // count)
        forces = list(self._forces)[-ticks * count :]
        self._plant.replay(self._states[-ticks], forces, recorder.note)
        return likeliest_cause(self._robot, recorder.record(self.trajectory()))

    def trajectory(self) -> Trajectory:
        """Return the last WINDOW seconds; fewer if there are fewer."""
        plans, samples = (joined(parts) for parts in zip(*self._blocks, strict=True))
        count, ticks = self._stepper.count, min(self._ticks, len(plans.residual) - 1)
        plans = jax.tree.map(lambda x: x[-ticks:], plans)
        samples = jax.tree.map(lambda x: x[-ticks * count - 1 :], samples)
        return as_trajectory(np.array(TIME_STEP), plans, samples, count)

    def log(self) -> Walked | str:
        """Return the last seconds, or why a tuning cannot step from them."""
        start = self._stepper.clock - self._pending - self._ticks
        missing = max(self._changed, self.job.start_tick) - start
        if self.fall:
            return "it fell: reset"
        if missing > 0:
            return f"{missing * self._config.gait.tick:.1f} s more with nothing moved"
        anchor = jax.device_get(self._stepper.anchor)
        return Walked(self.trajectory(), self.job.weights, self.job.command, anchor, start)

    def now(self) -> Now:
        """Return where the walk is."""
        stepper, tick = self._stepper, self._config.gait.tick
        reading = sensing.unpack_reading(stepper.reading)
        return Now(
            time=(stepper.clock - self.job.start_tick) * tick,
            pose=np.concatenate([reading.pose, reading.joints + reading.slack]),
            reference=self._reference().position,
            feet=np.asarray(_feet(self._robot, stepper.reading)),
            planned=stepper.last_plan.wrench.force,
            measured=self._plant.mean_force(stepper.count),
            residual=float(stepper.last_plan.residual),
            fall=self.fall,
            seconds=len(self._away) // stepper.count * tick,
            errors=np.sqrt(np.mean(self._away**2, axis=0)),
            error=self._away[-1],
        )

    def _reference(self) -> State:
        """Return the reference now."""
        command, clock = with_pieces(self.job.command), float(self._stepper.clock)
        tick = self._config.gait.tick
        return jax.device_get(reference_at(tick, command, self._stepper.anchor, clock))


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
