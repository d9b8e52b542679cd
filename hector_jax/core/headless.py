"""MuJoCo without OpenGL: importing it here works whatever MUJOCO_GL names and this machine lacks.

Only a film needs OpenGL. The process that draws one imports MuJoCo itself before this package.
"""

import os

_asked = os.environ.get("MUJOCO_GL")
os.environ["MUJOCO_GL"] = "disable"  # read once, when MuJoCo is imported
try:
    import mujoco
finally:
    del os.environ["MUJOCO_GL"]
    if _asked is not None:
        os.environ["MUJOCO_GL"] = _asked

__all__ = ["mujoco"]
