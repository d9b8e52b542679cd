"""Gradient tuning of a walking robot's model predictive controller in JAX (DiffTune, GRFM-Net).

The names below are the public surface; each package has its own. They are imported when they are
first used, so that `import hector_jax` costs nothing. core, qp, robot, control, sim, grfm and
tuning are the method; importing, own, store, verdict, walk_tuning, export, report, view and cli are
the application on it, which the method does not import. Words of this code:

- weights, theta: the diagonals of Q and R, with any further numbers that are tuned (`others`).
- phi, effect: phi maps the commanded ground wrench to its effect on the body; GRFM-Net is a phi.
- tick: 10 ms, the interval of gait, plan and rollout. An MPC step is some ticks, a sample 1 ms.
- srbm, ideal, hfs: single rigid body; MuJoCo without and with imperfections (the high-fidelity
  simulator, which the data of GRFM-Net are from). A plant is a robot with its imperfections.
- stand-in: plants in the place of hardware, for evaluation only.
"""

from importlib import import_module
from typing import Any

_MODULES = {
    "core.inputs": ("InputError",),
    "core.runtime": ("setup_jax",),
    "core.trajectory": ("State", "Trajectory", "Wrench"),
    "robot.model": ("Robot", "load_robot"),
    "qp": ("QP", "QpConfig", "solve_qp"),
    "control": ("Weights", "expert", "nominal", "named_command", "standing_anchor"),
    "control.controller": ("WalkConfig", "walk_config"),
    "sim.loop": ("Job",),
    "sim.walk": ("walk",),
    "sim.world": ("hfs", "ideal"),
    "grfm.effect": ("last_command",),
    "grfm.network": ("as_effect", "load_net"),
    "tuning.loss": ("PAPER_LOSS", "LossTerm"),
    "tuning.rollout": ("RolloutConfig", "Scenario", "rollout"),
    "tuning.difftune": ("TuneConfig", "tune"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
