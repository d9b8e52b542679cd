"""The controller as one function, called every millisecond, and as one file of `jax.export`.

The file is StableHLO with the robot, the configuration and the weights inside, so that one that was
checked cannot be run with other weights.

    carry, out = control(carry, millisecond, measured, command, anchor)

It takes and gives plain tuples and dictionaries of arrays, so that whoever loads it needs JAX and
nothing of this package. In the first millisecond of a tick it plans, in the others it holds the
plan; the torques are new every millisecond. The carry is opaque: zeros at millisecond 0, when the
robot stands, and then what came out. The gait's clock starts there, as walks in MuJoCo do.

What is exported is traced on the CPU: the guess by a GPU kernel (`qp`) has no stable custom call,
and the plain guess leads to the same minimiser.
"""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Int

from hector_jax.control.controller import Memory, Plan, WalkConfig, actuate, step_plan
from hector_jax.control.footstep import Feet
from hector_jax.control.legs import Measurement
from hector_jax.control.reference import Anchor, Command, standing_anchor
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import State
from hector_jax.qp import Status
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import first_tick, substeps

_STILL = Command(np.ones(2), np.zeros((2, 2)), np.zeros(2))


def _idle(config: WalkConfig, robot: Robot, weights: Weights) -> tuple[Memory, Plan]:
    """Memory and plan of zeros, with the shapes and dtypes of the real ones."""
    joints = np.zeros_like(robot.standing_joints)
    shapes = jax.eval_shape(
        partial(step_plan, config),
        robot,
        config.parameters(weights),
        command=_STILL,
        anchor=standing_anchor(robot),
        tick=np.int32(0),
        memory=Memory(Feet(np.zeros((2, 3)), np.zeros(2))),
        measurement=Measurement(State(*np.zeros((4, 3))), joints, joints),
    )
    return jax.tree.map(lambda shape: np.zeros(shape.shape, shape.dtype), shapes)


def controller(
    config: WalkConfig, robot: Robot, weights: Weights
) -> tuple[Callable[..., tuple], tuple]:
    """The controller as one function of plain arrays, and an example of its arguments.

    Args:
        config, robot, weights: what it is made for.

    Returns:
        `control(carry, millisecond, measured, command, anchor) -> (carry, out)`, as the module's
        docstring says, and arguments of a robot that stands at millisecond 0.
    """
    idle, structure = jax.tree.flatten(_idle(config, robot, weights))
    count, begin, moves = substeps(config), first_tick(config), config.gait.first_tick

    def control(
        carry: tuple[Array, ...],
        millisecond: Int[Array, ""],
        measured: dict[str, Array],
        command: dict[str, Array],
        anchor: dict[str, Array],
    ) -> tuple[tuple[Array, ...], dict[str, Array]]:
        tick, substep = begin + millisecond // count, millisecond % count
        base = dict(measured)
        joints, rates = base.pop("joints"), base.pop("joint_rates")
        measurement = Measurement(State(**base), joints, rates)
        memory, plan = jax.tree.unflatten(structure, carry)

        def planned(max_contacts: int) -> Callable[[], tuple[Memory, Plan]]:
            return lambda: step_plan(
                config,
                robot,
                config.parameters(weights),
                command=Command(**command),
                anchor=Anchor(**anchor),
                tick=tick,
                memory=memory,
                measurement=measurement,
                max_contacts=max_contacts,
            )

        both = (tick < moves) | config.gait.double_support
        branch = jnp.where(substep > 0, 0, jnp.where(both, 2, 1))
        memory, plan = lax.switch(branch, [lambda: (memory, plan), planned(1), planned(2)])
        legs = config.parameters(weights).legs
        now = {"substep": substep, "measurement": measurement}
        out = {
            "force": plan.wrench.force,
            "moment": plan.wrench.moment,
            "torque": actuate(config, robot, legs, plan=plan, memory=memory, **now),
            "contact": plan.contact,
            "status": plan.status,
            "residual": plan.residual,
        }
        return tuple(jax.tree.leaves((memory, plan))), out

    return control, (tuple(idle), np.int32(0), *_standing(robot))


def _standing(robot: Robot) -> tuple[dict[str, Any], ...]:
    """Measurement, command and anchor of a robot that stands."""
    position = np.append(robot.com_offset[:2], robot.standing_height)
    still = State(np.zeros(3), position, np.zeros(3), np.zeros(3))
    measured = still._asdict() | {
        "joints": robot.standing_joints,
        "joint_rates": np.zeros_like(robot.standing_joints),
    }
    anchor = jax.tree.map(np.asarray, standing_anchor(robot))
    return measured, _STILL._asdict(), anchor._asdict()


_SIGNATURE = {
    "carry": "opaque: zeros at millisecond 0, then the carry that came out",
    "millisecond": "since the start; the robot stands on both feet then",
    "measured": {
        "euler": "roll, pitch, yaw of the trunk [rad], R = Rz Ry Rx; yaw continuous, not wrapped",
        "position": "centre of mass [m], world: trunk origin + R com_offset; the floor is z = 0",
        "ang_velocity": "of the trunk, world frame [rad/s]",
        "velocity": "of the centre of mass, world frame [m/s]",
        "joints": "[rad], order of joint_names",
        "joint_rates": "[rad/s]",
    },
    "command": {
        "duration": "of each piece [s]; repeated after the last",
        "velocity": "ahead and to the left [m/s]",
        "yaw_rate": "[rad/s]",
    },
    "anchor": {
        "position": "where the reference starts [m]; z is standing_height",
        "yaw": "[rad]",
        "tick": "when: gait tick from which on the command is walked; before, it steps in place",
    },
    "out": {
        "force": "of the ground on each foot as commanded, left then right, world frame [N]",
        "moment": "the same, at the foot point [N m]",
        "torque": "of the joints [N m], within the limits: this goes to the motors",
        "contact": "planned stance",
        "status": "of the QP: "
        + ", ".join(f"{code.value} {code.name.lower().replace('_', ' ')}" for code in Status),
        "residual": "worst relative residual of the QP",
    },
}


def export_controller(
    config: WalkConfig, robot: Robot, weights: Weights, *, platform: str = "cpu"
) -> bytes:
    """The controller as a file's content for `jax.export.deserialize`, of 64-bit numbers.

    Args:
        config, robot, weights: baked in.
        platform: cpu or cuda, which need not be here.

    Raises:
        InputError: flatbuffers is not installed, or JAX runs with 32 bits or not on the CPU.
    """
    if find_spec("flatbuffers") is None:
        raise InputError("exporting needs flatbuffers: pip install 'hector-jax[export]'")
    if jax.default_backend() != "cpu" or not jax.config.read("jax_enable_x64"):
        raise InputError("exporting needs JAX on the CPU (JAX_PLATFORMS=cpu) and with 64 bits")
    control, example = controller(config, robot, weights)
    return bytes(jax.export.export(jax.jit(control), platforms=[platform])(*example).serialize())


def load_controller(content: bytes) -> Callable[..., tuple]:
    """The function in a file's content, compiled here and now; a call never compiles again."""
    exported = jax.export.deserialize(bytearray(content))
    arguments, _ = jax.tree.unflatten(exported.in_tree, exported.in_avals)
    return jax.jit(exported.call).lower(*arguments).compile()


def _with_shapes(texts: Any, values: Any) -> Any:
    """The texts beside the shapes of the values; where there are no values, as for `out`, alone."""
    if values is None:
        return texts
    if isinstance(texts, dict):
        return {name: _with_shapes(text, values.get(name)) for name, text in texts.items()}
    arrays = [{"shape": list(x.shape), "dtype": str(x.dtype)} for x in jax.tree.leaves(values)]
    return {"is": texts, **(arrays[0] if len(arrays) == 1 else {"arrays": arrays})}


def signature(example: tuple) -> dict[str, Any]:
    """What the controller takes and gives: each part in words, with shape and dtype."""
    return _with_shapes(_SIGNATURE, dict(zip(_SIGNATURE, example, strict=False)))
