"""Load and call the controller that `hector export` wrote, on a computer without hector_jax.

It needs jax, numpy and flatbuffers:

    python run_exported.py FOLDER

FOLDER is the one that `hector export` wrote. It contains a recorded walk. This program calls the
controller with each millisecond of it, as on the robot, and compares with the recorded answers.
"""

import hashlib
import json
import sys
import time
from pathlib import Path

import jax
import numpy as np
from jax import export


def load(folder: Path, card: dict):
    """The compiled controller and its first carry, zeros."""
    jax.config.update("jax_enable_x64", True)
    name = "controller-cpu.jaxexport"
    blob = (folder / name).read_bytes()
    if hashlib.sha256(blob).hexdigest() != card["sha256"][name]:
        sys.exit(f"{folder / name} does not have the sha256 that controller.json names")
    exported = export.deserialize(bytearray(blob))
    arguments, _ = jax.tree.unflatten(exported.in_tree, exported.in_avals)
    control = jax.jit(exported.call).lower(*arguments).compile()
    return control, jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), arguments[0])


def main(folder: Path) -> None:
    """Call the controller along the recorded walk, compare and time."""
    if not (folder / "controller.json").exists():
        sys.exit(f"{folder}: no controller.json; expected the folder that `hector export` wrote")
    card = json.loads((folder / "controller.json").read_text())
    control, carry = load(folder, card)
    with np.load(folder / "check.npz") as file:
        walk = {name: file[name] for name in file.files}

    def group(name: str) -> dict:
        return {n.split(".")[1]: value for n, value in walk.items() if n.split(".")[0] == name}

    measured, command, expected = group("measured"), group("command"), group("out")
    start = card["constants"]["millisecond_of_tick_0"]
    worst_torque = worst_force = 0.0
    spent = []
    for ms in range(len(expected["torque"])):
        now = {name: rows[ms] for name, rows in measured.items()}  # on the robot: its estimate
        anchor = group("standing") if ms < start else group("anchor")
        began = time.perf_counter()
        carry, out = control(carry, np.int32(ms), now, command, anchor)
        torque = np.asarray(out["torque"])  # on the robot: to its motors
        spent.append(1e3 * (time.perf_counter() - began))
        worst_torque = max(worst_torque, np.abs(torque - expected["torque"][ms]).max())
        if ms >= start:
            off = np.abs(out["force"] - expected["force"][ms - start]).max()
            worst_force = max(worst_force, float(off))
    p50, p99 = np.quantile(spent[1:], [0.5, 0.99])
    print(f"{len(spent)} calls, p50 {p50:.2f} ms, p99 {p99:.2f} ms")
    print(f"largest difference {worst_force:.1e} N, {worst_torque:.1e} N m at the joints")
    if not max(worst_force, worst_torque) <= 1e-6:
        sys.exit("the answers differ from the recorded ones by more than 1e-6")


if __name__ == "__main__":
    words = sys.argv[1:]
    if words in (["-h"], ["--help"]):
        print(__doc__)
    elif len(words) != 1:
        sys.exit("expected the FOLDER that `hector export` wrote, such as runs/s/TIME/export")
    else:
        main(Path(words[0]))
