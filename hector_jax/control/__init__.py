"""The walking controller in pure JAX: from command and state to wrench and joint torques.

`reference` integrates the command, `gait` schedules the contacts, `footstep` places the feet, `mpc`
plans the wrench under the `contact` constraints, or as `twin` says of another controller, `legs`
converts it into torques, and `controller` calls them in turn. `parameters` holds their numbers in
one tree and lists which can be tuned.
"""

from hector_jax.control.contact import (
    LINE_FOOT,
    Contact,
    ContactModel,
    InputConstraint,
    InputCost,
    Rows,
    Squares,
    StateConstraint,
    StateCost,
    Step,
)
from hector_jax.control.controller import (
    Memory,
    Plan,
    WalkConfig,
    actuate,
    init_memory,
    plan,
    step_plan,
    walk_config,
)
from hector_jax.control.footstep import FootstepConfig
from hector_jax.control.gait import GaitConfig
from hector_jax.control.legs import LegConfig, Measurement
from hector_jax.control.mpc import Horizon, MpcConfig, MpcProblem, build_qp, solve_mpc
from hector_jax.control.parameters import Parameters, Tunable
from hector_jax.control.reference import (
    Anchor,
    Command,
    named_command,
    reference_at,
    standing_anchor,
)
from hector_jax.control.trajectories import NamedCommand, command_of
from hector_jax.control.twin import Linearisation, ReferenceRule, TwinConfig
from hector_jax.control.weights import Weights, expert, nominal

# fmt: off
__all__ = [
    "FootstepConfig", "GaitConfig", "LegConfig", "LINE_FOOT", "Anchor", "Command", "Contact",
    "ContactModel", "Horizon", "InputConstraint", "InputCost", "Measurement", "Memory",
    "MpcConfig", "MpcProblem", "NamedCommand", "Parameters", "Plan", "Rows", "Squares",
    "StateConstraint", "StateCost", "Step", "Tunable", "WalkConfig", "Weights", "actuate",
    "Linearisation", "ReferenceRule", "TwinConfig", "build_qp", "command_of", "expert",
    "init_memory", "named_command", "nominal", "plan",
    "reference_at", "solve_mpc", "standing_anchor", "step_plan", "walk_config",
]
