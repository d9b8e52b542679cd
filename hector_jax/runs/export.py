"""Export for the robot: the weights, and the controller as one compiled function.

A recorded walk lies beside it, with the outputs of the live controller; nothing is written unless
the file gives the same outputs (`TOLERANCE`).
"""

import hashlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import save_weights, weights_tree
from hector_jax.core.console import Broken
from hector_jax.core.environment import versions
from hector_jax.core.files import make_folder, write_file, write_json
from hector_jax.core.inputs import InputError, plural, unknown
from hector_jax.core.settings import from_table, read_json, to_table
from hector_jax.core.tree_file import tree_hash
from hector_jax.robot.model import Robot
from hector_jax.runs.export_check import Check, as_arrays, check, record
from hector_jax.runs.export_controller import (
    controller,
    export_controller,
    load_controller,
    signature,
)
from hector_jax.runs.export_weights import weights_cpp, weights_schema
from hector_jax.runs.folder import CONFIG
from hector_jax.sim.loop import substeps

SCHEMA = "weights.schema.json"
PLATFORMS = ("cpu", "cuda")
TOLERANCE = 1e-6
"""Largest difference [N, N m] from the live controller."""


def find_weights(run: Path, name: str) -> tuple[Path, WalkConfig | None]:
    """A weight set's file, and the controller that it was tuned for.

    Args:
        run: folder of a run, or a weights file.
        name: of the set in the folder.

    Returns:
        The file, and the controller; None where a file does not say it.

    Raises:
        InputError: one line with what is missing or odd, and what there is.
    """
    if not run.is_dir():
        return run, None
    sets = sorted(path.stem for path in (run / "weights").glob("*.json"))
    if name not in sets:
        raise InputError(f"{run}: {unknown('weight set', name, sets)}")
    path = run / CONFIG
    config = read_json(path, "the settings of a run")
    try:
        table = config["tune"]["rollout"]["walk"]
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not the settings of a walking controller: {error!r}") from error
    # a setting that this version does not know is refused: the file goes to a robot
    walk_config = from_table(f"{path}: tune.rollout.walk", WalkConfig, table)
    return run / "weights" / f"{name}.json", walk_config


def _constants(config: WalkConfig, robot: Robot, lead: int) -> dict[str, Any]:
    """Numbers that the robot's own code needs."""
    return {
        "milliseconds_per_plan": substeps(config),
        "millisecond_of_tick_0": lead,
        "joint_names": list(robot.description.joints),
        "standing_joints": robot.standing_joints.tolist(),
        "standing_height": float(robot.standing_height),
        "com_offset": robot.com_offset.tolist(),
        "torque_limit": robot.torque_limit.tolist(),
    }


def _require_same(result: Check) -> None:
    if not max(result.force, result.moment, result.torque) <= TOLERANCE:
        raise Broken(
            f"the exported controller differs from the live one by {result.force:.1e} N, "
            f"{result.moment:.1e} N m and {result.torque:.1e} N m at the joints, at most "
            f"{TOLERANCE:g} was expected; nothing was written"
        )
    if result.unsolved:
        what = plural(result.unsolved, "QP") + (" was" if result.unsolved == 1 else " were")
        raise Broken(f"{what} not solved on the walk of the check; nothing was written")


def export(
    config: WalkConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    folder: Path,
    *,
    name: str,
    seconds: float = 1.0,
) -> dict[str, Any]:
    """Write everything that goes to the robot; files that are there already are replaced.

    Args:
        config, robot, weights: the controller, its body and the weights to export.
        command, seconds: to walk for the check; from t = 0 on.
        folder: where to.
        name: of the weights, for the files.

    Returns:
        The card, also in `controller.json`: sha256 of the files, signature, constants, weights,
        settings and the check.

    Raises:
        InputError: as `record` and `export_controller`; or the folder cannot be written.
        Broken: it differs from the live controller by more than TOLERANCE; nothing is written.
    """
    make_folder(folder)
    blobs = {
        place: export_controller(config, robot, weights, platform=place) for place in PLATFORMS
    }
    recorded = record(config, robot, weights, command=command, seconds=seconds)
    _, example = controller(config, robot, weights)
    result = check(config, load_controller(blobs["cpu"]), example, recorded)
    _require_same(result)
    # the card vouches for the others: it goes first and comes last
    (folder / "controller.json").unlink(missing_ok=True)
    save_weights(folder / "weights.json", weights, SCHEMA)
    write_json(folder / SCHEMA, weights_schema(robot))
    np.savez(rows := io.BytesIO(), **as_arrays(recorded))
    contents = {f"controller-{place}.jaxexport": blob for place, blob in blobs.items()}
    contents["weights.cpp"] = weights_cpp(weights, config, robot, name=name).encode()
    contents["check.npz"] = rows.getvalue()
    for file, content in contents.items():
        write_file(folder / file, content)
    files = (*contents, "weights.json", SCHEMA)
    card = {
        "name": name,
        "sha256": {one: hashlib.sha256((folder / one).read_bytes()).hexdigest() for one in files},
        "signature": signature(example),
        "constants": _constants(config, robot, recorded.lead),
        "weights": weights_tree(weights),
        "controller": to_table(config),
        "robot": tree_hash(robot),
        "versions": versions(),
        "check": {"milliseconds": len(recorded.torque), **result._asdict()},
    }
    write_json(folder / "controller.json", card)
    return card
