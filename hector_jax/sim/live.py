"""A walk in MuJoCo C that goes on until it falls, while its numbers change.

Untouched it is that of `sim.walk`, to the bit. Weights change between two plans. A new command
starts at the reference of the old one, so that the robot is asked for no jump. Estimator noise
repeats itself after some seconds.
"""

from collections import deque
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.controller import Plan, WalkConfig
from hector_jax.control.reference import Anchor, Command, reference_at, with_pieces
from hector_jax.control.weights import Weights
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
_NOISE = 20_000  # [ms] after which the estimator's noise repeats itself
_RECORD = round((BEFORE_FALL + 1.0) / TIME_STEP)  # [ms] before a fall that its cause is found from

_UNITS = np.array([100.0] * 3 + [np.degrees(1.0)] * 3)  # of errors, by metre and radian

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
