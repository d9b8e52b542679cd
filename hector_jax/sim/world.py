"""The MuJoCo worlds: a robot's MJCF with the imperfections of a plant's joints, ground and masses.

Imperfections are numbers, so that a world is data: `ideal`, `hfs` (the high-fidelity simulator) and
plants drawn around the hfs. They are those of HECTOR; another robot's description has their scale
(`PlantSizes`), and a robot without a linkage has no such term. The numbers are defined here;
the motors' (delay, lag, gain, linkage) act in sim.actuators, the estimator's in sim.sensing, the
others become fields of the MuJoCo model. Backlash is a second hinge on the axis of each joint, free
within +-b between motor and link; the encoder sits on the motor's side. All parts are looked up by
name, so that nothing depends on the number of joints.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hector_jax.core.arrays import Array
from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError, read_text, unknown
from hector_jax.robot.description import HECTOR, Description
from hector_jax.robot.mjcf import MOST_BYTES, TIME_STEP
from hector_jax.robot.model import build_model, quiet_mujoco

LINE_SEARCH = 50  # of the solver, steps; with 10 the hfs is off by 0.02 rad/s in 1 of 400 steps
MAX_DELAY = 0.008  # [s] that the motors' memory can hold
MOTOR_DELAY, MOTOR_LAG = (0.001, 0.005), (0.002, 0.006)  # [s] of the motors that robots have
SLACK = "_backlash"  # suffix of the names of backlash joints
SLACK_DAMPING = 0.01  # [N m s/rad] of a backlash joint
_SENSED = ("FOUND", "FORCE", "TORQUE", "POS")  # of a contact sensor
_NET_FORCE = 3  # the way of a contact sensor to sum up contacts
STOP_TIME = 0.004  # [s] solref of the backlash's end stops: gear teeth are hard


class Estimator(NamedTuple):
    """Error of the state estimate: sigmas of white noise each millisecond, and a drift."""

    position: Float[Array, "*batch"]  # [m]
    velocity: Float[Array, "*batch"]  # [m/s]
    angle: Float[Array, "*batch"]  # [rad]
    ang_velocity: Float[Array, "*batch"]  # [rad/s]
    joint: Float[Array, "*batch"]  # [rad] encoders
    drift: Float[Array, "*batch"]  # [m] of a random walk, 4 s after t = 0, each horizontal axis
    drift_yaw: Float[Array, "*batch"]  # [rad] of a random walk, 4 s after t = 0


class Push(NamedTuple):
    """External forces on the trunk at its centre of mass; any number n of them."""

    force: Float[Array, "*batch n 3"]  # [N] world frame
    start: Float[Array, "*batch n"]  # [s] after t = 0
    duration: Float[Array, "*batch n"]  # [s]


NO_PUSH = Push(np.zeros((0, 3)), np.zeros(0), np.zeros(0))


class Imperfections(NamedTuple):
    """Properties of a plant that are unknown to the controller."""

    joint_friction: Float[Array, "*batch"]  # [N m] dry, each joint
    joint_damping: Float[Array, "*batch"]  # [N m s/rad]
    armature: Float[Array, "*batch"]  # times that of the MJCF
    backlash: Float[Array, "*batch"]  # [rad] half width b
    delay: Float[Array, "*batch"]  # [s] of the torque command
    lag: Float[Array, "*batch"]  # [s] first order, of the torque
    torque_gain: Float[Array, "*batch joints"]
    linkage: Float[Array, "*batch"]  # share of the ankle torque that is added at the knee
    contact_time: Float[Array, "*batch"]  # [s] solref of the floor
    floor_friction: Float[Array, "*batch"]
    mass: Float[Array, "*batch"]  # times that of the MJCF, all links
    trunk_com: Float[Array, "*batch 3"]  # [m] shift of the trunk's centre of mass
    estimator: Estimator


def push_force(push: Push, step: Int[Array, ""]) -> Float[Array, "3"]:
    """Return the force on the trunk [N] in the millisecond that begins `step` ms after t = 0."""
    first = jnp.round(push.start / TIME_STEP)
    last = jnp.round((push.start + push.duration) / TIME_STEP)
    return jnp.where((first <= step) & (step < last), push.force.T, 0.0).sum(axis=1)


# Encoders of 14 bits; a gyroscope on a vibrating trunk; velocity and position follow from both over
# a leg of about 0.7 m.
ESTIMATE_NOISE = {
    "position": 0.001,  # [m]
    "velocity": 0.02,  # [m/s]
    "angle": 0.001,  # [rad]
    "ang_velocity": 0.02,  # [rad/s]
    "joint": 0.0004,  # [rad]
}
"""Standard deviations of the white noise of a real robot's estimate, by field of `Estimator`."""


def truth() -> Estimator:
    """Return an estimator without errors."""
    return Estimator(*(np.zeros(()) for _ in Estimator._fields))


def noisy() -> Estimator:
    """Return an estimator with the white noise of a real robot's, `ESTIMATE_NOISE`."""
    return truth()._replace(**{name: np.asarray(sigma) for name, sigma in ESTIMATE_NOISE.items()})


def ideal(description: Description = HECTOR) -> Imperfections:
    """Return an ideal plant to check the controller: firm ground, joint damping 0.1, nothing else.

    Args:
        description: of the robot, HECTOR by default.
    """
    values = dict(
        joint_friction=0.0,
        joint_damping=0.1 * description.plants.joint_damping,
        armature=1.0,
        backlash=0.0,
        delay=0.0,
        lag=0.0,
        torque_gain=np.ones(len(description.joints)),
        linkage=0.0,
        contact_time=0.01,
        floor_friction=0.8,
        mass=1.0,
        trunk_com=np.zeros(3),
    )
    arrays = {name: np.asarray(value, float) for name, value in values.items()}
    return Imperfections(**arrays, estimator=truth())


def hfs(description: Description = HECTOR) -> Imperfections:
    """Return the high-fidelity simulator's plant: friction, backlash, motors as in the paper's."""
    sizes = description.plants
    return ideal(description)._replace(
        joint_friction=np.asarray(0.3 * sizes.joint_friction),
        joint_damping=np.asarray(0.3 * sizes.joint_damping),
        backlash=np.asarray(0.005),
        delay=np.asarray(0.002),
        lag=np.asarray(0.004),
        linkage=np.asarray(0.5 if description.linkage else 0.0),
    )


def hfs_drawn(seed: int, share: float = 0.2, description: Description = HECTOR) -> Imperfections:
    """Draw a plant around the hfs, each number uniformly within +-`share` of the hfs's.

    Mass, which is known better, varies by a tenth of the share; the trunk's centre of mass moves by
    up to 2.5 cm times the share, for another robot times its size. The floor keeps a friction of at
    least 0.6 (that with which the MPC plans), and no motor exceeds its command: a gain is below 1
    by up to a quarter of the share.

    Args:
        seed: number of the plant.
        share: 0.4 for `hfs-varied`.
        description: of the robot, HECTOR by default.
    """
    base, rng = hfs(description), np.random.default_rng([0x4F5, round(1000 * share), seed])
    vary = lambda value, part: np.asarray(value * rng.uniform(1 - part, 1 + part))  # noqa: E731
    special = ("torque_gain", "mass", "trunk_com", "estimator")  # drawn after the others
    names = [name for name in base._fields if name not in special]
    drawn = base._replace(**{name: vary(getattr(base, name), share) for name in names})
    return drawn._replace(
        floor_friction=np.maximum(drawn.floor_friction, 0.6),
        torque_gain=rng.uniform(1 - share / 4, 1.0, len(description.joints)),
        mass=vary(base.mass, share / 10),
        trunk_com=rng.uniform(-1.0, 1.0, 3) * share * 0.025 * description.plants.trunk_com,
    )


def hfs_varied(seed: int, description: Description = HECTOR) -> Imperfections:
    """Draw one of the plants around the hfs on which our variants are compared."""
    return hfs_drawn(seed, 0.4, description)


def hfs_with_motors(
    seed: int, share: float = 0.2, description: Description = HECTOR
) -> Imperfections:
    """Draw a plant around the hfs with any of the motors that robots have, fast or slow.

    Delay and lag are uniform in MOTOR_DELAY and MOTOR_LAG: a limit cycle of trunk and legs starts
    at some delay, and nothing that was made on faster motors keeps away from it.

    Args:
        seed, share, description: of the other numbers, as for `hfs_drawn`; 0.2 for collection, 0.4
            for choices.
    """
    rng = np.random.default_rng([0x4F6, round(1000 * share), seed])
    delay, lag = (np.asarray(rng.uniform(a, b)) for a, b in (MOTOR_DELAY, MOTOR_LAG))
    return hfs_drawn(seed, share, description)._replace(delay=delay, lag=lag)


def hfs_even(seed: int, description: Description = HECTOR) -> Imperfections:
    """Draw a plant with any motors, a noisy estimate, and a mass evenly about the nominal one."""
    mass = np.random.default_rng([0x4F7, seed]).uniform(0.85, 1.15)
    plant = hfs_with_motors(seed, 0.4, description)
    return plant._replace(mass=np.asarray(mass), estimator=noisy())


WORLDS = ("ideal", "hfs", "hfs-varied", "hfs-even")


def named_world(name: str, seed: int = 0, description: Description = HECTOR) -> Imperfections:
    """Return the imperfections of a named world.

    Args:
        name: of WORLDS.
        seed: number of the plant, for a world with several.
        description: of the robot, HECTOR by default.

    Raises:
        InputError: the name is not in WORLDS.
    """
    if name not in WORLDS:
        raise InputError(unknown("world", name, WORLDS))
    drawn = {"hfs-varied": hfs_varied, "hfs-even": hfs_even}
    worlds = {"ideal": ideal, "hfs": hfs, **{n: partial(draw, seed) for n, draw in drawn.items()}}
    return worlds[name](description=description)


@dataclass(frozen=True, eq=False)
class World:
    """A MuJoCo model, whose motors are those of the joints, and indices of the robot's parts."""

    model: mujoco.MjModel
    joint_qpos: np.ndarray  # (joints,) motor side, leg by leg
    joint_dof: np.ndarray  # (joints,)
    slack: np.ndarray  # (joints,) backlash joints; empty without backlash
    foot_of_geom: np.ndarray  # (ngeom,) foot of each geom; -1: none
    floor: int  # geom
    trunk: int  # body


def _check(imperfections: Imperfections) -> None:
    flat = imperfections._asdict()
    flat |= flat.pop("estimator")._asdict()
    for name, value in flat.items():
        signed = name == "trunk_com"
        if not np.all(np.isfinite(value)) or (not signed and np.any(np.asarray(value) < 0.0)):
            raise InputError(f"Imperfections.{name} must be finite and >= 0, got {value}")
    for name in ("armature", "contact_time", "mass", "torque_gain"):
        if np.any(np.asarray(flat[name]) <= 0.0):
            raise InputError(f"Imperfections.{name} must be positive, got {flat[name]}")
    if imperfections.delay > MAX_DELAY:
        raise InputError(f"Imperfections.delay is at most {MAX_DELAY} s, got {imperfections.delay}")


def _add_contact_sensors(spec: mujoco.MjSpec, feet: Sequence[mujoco.MjsBody]) -> None:
    """Add the sensors that `sensing.sensed_ground` reads.

    For each foot the number of its contacts with the floor, their force, torque and centre; then
    the number of contacts of the floor, and of all.
    """
    kinds, names = mujoco.mjtObj, mujoco.mjtConDataField
    found, *wrench = (1 << int(getattr(names, f"mjCONDATA_{name}")) for name in _SENSED)
    for number, foot in enumerate(feet):
        foot.name = foot.name or f"foot {number}"
    load = [found + sum(wrench), _NET_FORCE, 1]
    pairs = [(foot.name, "world", load) for foot in feet]
    for body, other, data in (*pairs, ("world", "", [found, 0, 1]), ("", "", [found, 0, 1])):
        sensor = spec.add_sensor(type=mujoco.mjtSensor.mjSENS_CONTACT, intprm=data)
        sensor.objname, sensor.refname = body, other
        sensor.objtype, sensor.reftype = (
            kinds.mjOBJ_BODY if name else kinds.mjOBJ_UNKNOWN for name in (body, other)
        )


def _model(description: Description, slack: bool, sensors: bool) -> mujoco.MjModel:
    (spec, _), joints = build_model(description), description.joints
    # purely visual geoms, which give their body no mass, cost time and memory in every plant
    for geom in list(spec.geoms):
        if not geom.contype and not geom.conaffinity and geom.parent.explicitinertial:
            spec.delete(geom)
    if sensors:
        count = description.leg_joints
        _add_contact_sensors(spec, [spec.joint(name).parent for name in joints[count - 1 :: count]])
    if not slack:
        return spec.compile()
    for name in joints:
        motor = spec.joint(name)
        motor.parent.add_joint(
            name=name + SLACK,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=motor.axis,
            pos=motor.pos,
            limited=True,
            range=[-1.0, 1.0],  # set to the plant's backlash later
            solref_limit=[STOP_TIME, 1.0],
            armature=0.0,
            damping=[SLACK_DAMPING, 0.0, 0.0],
            frictionloss=0.0,
            stiffness=[0.0, 0.0, 0.0],
        )
    for key in list(spec.keys):  # their length no longer fits the joints
        spec.delete(key)
    return spec.compile()


@lru_cache(maxsize=8)  # it takes a twentieth of a walk of some seconds
def _compile(description: Description, slack: bool, sensors: bool, content: str) -> World:
    """Compile the model of a description; `content` is that of its file, which may change."""
    model, names = _model(description, slack, sensors), description.joints
    floors = [g for g in range(model.ngeom) if model.geom_bodyid[g] == 0 and model.geom_contype[g]]
    joints = [model.joint(name) for name in names]
    slacks = [model.joint(name + SLACK) for name in names] if slack else []
    count = description.leg_joints
    feet = [joint.bodyid[0] for joint in joints[count - 1 :: count]]
    return World(
        model=model,
        joint_qpos=np.array([joint.qposadr[0] for joint in joints]),
        joint_dof=np.array([joint.dofadr[0] for joint in joints]),
        slack=np.array([joint.id for joint in slacks], int),
        foot_of_geom=np.array([feet.index(b) if b in feet else -1 for b in model.geom_bodyid]),
        floor=floors[0],
        trunk=int(model.jnt_bodyid[0]),
    )


def _with_numbers(world: World, imperfections: Imperfections) -> World:
    model, dof = copy(world.model), world.joint_dof
    model.opt.timestep = TIME_STEP
    model.opt.ls_iterations = LINE_SEARCH
    # A diverged state must stay so: a reset to the initial pose would look like a new start.
    # The robot is one tree: a search for separate islands of constraints finds one.
    flags = mujoco.mjtDisableBit
    model.opt.disableflags |= flags.mjDSBL_AUTORESET | flags.mjDSBL_ISLAND
    model.dof_frictionloss[dof] = imperfections.joint_friction
    model.dof_damping[dof] = imperfections.joint_damping
    model.dof_armature[dof] *= imperfections.armature
    model.jnt_range[world.slack] = imperfections.backlash * np.array([-1.0, 1.0])
    # The floor's values alone count: in the MJCF the robot's geoms have less friction and no
    # weight in the mix.
    model.geom_friction[world.floor, 0] = imperfections.floor_friction
    model.geom_solref[world.floor] = imperfections.contact_time, 1.0
    model.body_mass *= imperfections.mass
    model.body_inertia *= imperfections.mass
    model.body_ipos[model.jnt_bodyid[0]] += imperfections.trunk_com
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(world, model=model)


@quiet_mujoco()
def build_worlds(
    imperfections: Sequence[Imperfections],
    description: Description | None = None,
    *,
    sensors: bool = False,
) -> list[World]:
    """Build the MuJoCo models of several plants.

    Args:
        imperfections: of each plant; `backlash` above zero adds a hinge for each joint.
        description: of the robot, HECTOR by default.
        sensors: with sensors of contact, which MJX does not have.

    Raises:
        InputError: the file is not the robot, or a number is out of its range.
    """
    for plant in imperfections:
        _check(plant)
    description = description or HECTOR
    content = read_text(description.model, "the robot description", MOST_BYTES)
    slack = [bool(plant.backlash > 0.0) for plant in imperfections]
    worlds = (_compile(description, value, sensors, content) for value in slack)
    return [_with_numbers(w, p) for w, p in zip(worlds, imperfections, strict=True)]


def build_world(
    imperfections: Imperfections, description: Description | None = None, *, sensors: bool = False
) -> World:
    """Build the MuJoCo model of one plant; see `build_worlds`."""
    return build_worlds([imperfections], description, sensors=sensors)[0]


def standing_qpos(
    world: World, joints: Float[np.ndarray, " joints"], height: float
) -> Float[np.ndarray, " nq"]:
    """Return coordinates of a robot standing at the origin: trunk `height` [m], `joints` [rad]."""
    qpos = np.zeros(world.model.nq)
    qpos[2], qpos[3] = height, 1.0
    qpos[world.joint_qpos] = joints
    return qpos
