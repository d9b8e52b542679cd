"""Call an exported controller from Python along its recorded walk: python check.py FOLDER.

FOLDER is the one that `hector export` wrote. It needs NumPy and a C compiler (cc).
"""

import ctypes
import re
import subprocess
import sys
from pathlib import Path

import numpy as np


def main(folder: Path) -> None:
    """Compile the controller, call it along the record and compare the torques."""
    library, walk = folder.resolve() / "controller.so", np.load(folder / "check.npz")
    words = ["cc", "-std=c99", "-O2", "-fPIC", "-shared", folder / "controller.c", "-lm"]
    subprocess.run([*words, "-o", library], check=True)
    call = ctypes.CDLL(str(library))
    memory = ctypes.create_string_buffer(ctypes.c_size_t.in_dll(call, "controller_size").value)
    call.controller_init(memory)

    # the structures of controller.h are numbers of eight bytes, one after the other
    def whole(number):
        return np.array([number]).view(float)

    names = ("euler", "position", "ang_velocity", "velocity", "joints", "joint_rates")
    estimates = np.hstack([walk[f"measured.{name}"] for name in names])
    pieces = int(re.search(r"_PIECES (\d+)", (folder / "controller.h").read_text())[1])
    parts = [walk[f"command.{name}"] for name in ("duration", "velocity", "yaw_rate")]
    padded = [np.resize(x, (pieces, *x.shape[1:])).ravel() for x in parts]
    command = np.concatenate([whole(len(parts[0])), *padded])
    expected, output, worst, unsolved = walk["out.torque"], np.zeros(1000), 0.0, 0
    begin = len(expected) - len(walk["out.force"])
    for ms, estimate in enumerate(estimates):
        at = "standing" if ms < begin else "anchor"
        tick = whole(int(walk[f"{at}.tick"]))
        anchor = np.concatenate([walk[f"{at}.position"], [walk[f"{at}.yaw"]], tick])
        inputs = [ctypes.c_void_p(x.ctypes.data) for x in (estimate, command, anchor, output)]
        unsolved += call.controller_step_at(memory, ctypes.c_int64(ms), *inputs) not in (0, 5)
        worst = np.maximum(worst, np.abs(output[: expected.shape[1]] - expected[ms]).max())
    print(f"{len(expected)} calls, largest difference {worst:.1e} N m; not solved: {unsolved}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
