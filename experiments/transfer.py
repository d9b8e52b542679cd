"""Does the model's gradient point where the better simulator's does?

Cosine between the gradient of L in log-weights on the rigid body (with the command itself, a linear
map, the paper's GRFM-Net or the default one as phi) and central differences of L on the
high-fidelity simulator (hfs), at the nominal weights; with all entries and without those of sag and
float (Q_z, Q_vz, R_Fz). The feet share one R: 18 directions.

    python experiments/transfer.py [--data data] [--lead 0]
"""

import json
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import tyro

from hector_jax import pipeline
from hector_jax.control.reference import COMMANDS, named_command, standing_anchor
from hector_jax.control.walking import WalkConfig
from hector_jax.control.weights import (
    WEIGHT_NAMES,
    nominal,
    vector_to_weights,
    weights_to_vector,
)
from hector_jax.grfm.network import as_effect, linear_effect
from hector_jax.model.effect import last_command
from hector_jax.robot import load_robot
from hector_jax.runtime import setup_jax, workers
from hector_jax.sim.walk import Job, walk_many
from hector_jax.sim.world import hfs
from hector_jax.tuning.difftune import TuneConfig, tune_step
from hector_jax.tuning.loss import LossConfig, losses, total
from hector_jax.tuning.rollout import RolloutConfig

STEP = np.log(1.05)  # of the central differences, in log-weights
PHASES = (0, 20)  # gait ticks at which the command starts
SAG = ("Q_z", "Q_vz", "R_Fz_left")


@dataclass(frozen=True)
class Flags:
    """What to compare."""

    data: Path = Path("data")  # walks and net of `hector collect` and `hector train`
    lead: int = 0  # ticks that the model walks in place before t = 0
    processes: int = 2
    out: Path = Path("runs/transfer.json")


def directions() -> tuple[list[str], np.ndarray]:
    """Names and unit steps (18, 24) in log-weights: each weight of Q, each of R in both feet."""
    eye = np.eye(24)
    feet = [eye[k + axis] + eye[k + 3 + axis] for k in (12, 18) for axis in range(3)]
    names = [name for name in WEIGHT_NAMES if "right" not in name]
    return names, np.concatenate([eye[:12], feet])


def simulator_gradients(processes: int) -> dict[str, np.ndarray]:
    """Gradients of L on the hfs (phases, 18) by trajectory, from central differences."""
    robot, (_, steps) = load_robot(), directions()
    base = np.asarray(weights_to_vector(nominal()))
    loss = jax.jit(lambda walk: total(LossConfig(), losses(walk)))
    found = {}
    with workers(processes) as pool:
        for name in COMMANDS:
            jobs = [
                Job(
                    vector_to_weights(base * np.exp(side * STEP * step)),
                    command,
                    hfs(),
                    4.0,
                    0,
                    phase,
                )
                for command in [named_command(name)]
                for phase in PHASES
                for step in steps
                for side in (1, -1)
            ]
            walks = walk_many(pool, WalkConfig(), robot, jobs)
            values = np.array([float(loss(walk)) for walk in walks]).reshape(len(PHASES), -1, 2)
            found[name] = (values[..., 0] - values[..., 1]) / (2 * STEP)
    return found


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Of the angle between two gradients."""
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def main() -> None:
    """Print one line per trajectory and phi; keep all gradients as JSON."""
    flags = tyro.cli(Flags)
    setup_jax()
    robot, (names, steps) = load_robot(), directions()
    config = TuneConfig(rollout=RolloutConfig(lead=flags.lead))
    with workers(flags.processes) as pool:
        net, paper = (
            pipeline.ground(pool, config, robot, flags.data, variant) for variant in (None, "paper")
        )
    effects = {
        "command": last_command,
        "linear": linear_effect(net.linear),
        "paper": as_effect(paper.params),
        "net": as_effect(net.params),
    }
    kept = [i for i, name in enumerate(names) if name not in SAG]
    record = {}
    for name, truth in simulator_gradients(flags.processes).items():
        expected = truth.mean(axis=0)
        record[name] = {"hfs": dict(zip(names, expected.tolist(), strict=True))}
        for kind, effect in effects.items():
            rows = []
            for phase in PHASES:
                anchor = standing_anchor(robot, phase)
                found = tune_step(config, robot, nominal(), named_command(name), anchor, effect)
                logs = jax.tree.map(np.multiply, found.gradient, nominal())
                rows.append(steps @ np.asarray(weights_to_vector(logs)))
            gradient = np.mean(rows, axis=0)
            record[name][kind] = dict(zip(names, gradient.tolist(), strict=True))
            print(
                f"{name:9s} {kind:8s} cosine {cosine(gradient, expected):6.3f}   "
                f"without z and R_Fz {cosine(gradient[kept], expected[kept]):6.3f}",
                flush=True,
            )
    flags.out.parent.mkdir(parents=True, exist_ok=True)
    flags.out.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
