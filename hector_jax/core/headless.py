"""Import MuJoCo without OpenGL, whatever MUJOCO_GL says and this machine lacks.

Only videos need OpenGL. A process that renders one imports MuJoCo itself before this package.
"""

import os

_original = os.environ.get("MUJOCO_GL")
os.environ["MUJOCO_GL"] = "disable"  # read once, when MuJoCo is imported
try:
    import mujoco
finally:
    del os.environ["MUJOCO_GL"]
    if _original is not None:
        os.environ["MUJOCO_GL"] = _original

__all__ = ["mujoco"]
