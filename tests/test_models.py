"""The example robots as MuJoCo compiles them: their masses, that they stand and are mirrored."""

import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
HUMANOID = ROOT / "examples" / "humanoid" / "robot.toml"
V2 = ROOT / "examples" / "hector-v2" / "robot.toml"
V2_ARMS = ROOT / "examples" / "hector-v2" / "arms.toml"
NAMES = ["humanoid", "v2", "v2-arms"]
ALL = pytest.mark.parametrize("path", [HUMANOID, V2, V2_ARMS], ids=NAMES)

MIRROR = np.diag([1.0, -1.0, 1.0])


def table(path):
    return tomllib.loads(path.read_text())


def standing(path):
    """Model and data of a description in its standing pose."""
    model = mujoco.MjModel.from_xml_path(str(path.with_name(table(path)["model"])))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(table(path)["standing"]).id)
    mujoco.mj_forward(model, data)
    return model, data


def soles(path, data):
    """World places of the contacts of the TOML, (feet, contacts, 3)."""
    feet = table(path)["feet"]
    bodies = [data.body(feet[side]["body"]) for side in ("left", "right")]
    return np.array(
        [
            body.xpos + np.array(feet[side]["contacts"]) @ body.xmat.reshape(3, 3).T
            for side, body in zip(("left", "right"), bodies, strict=True)
        ]
    )


@pytest.mark.parametrize(
    ("path", "mass", "com_height"),
    [(HUMANOID, 35.0, 0.647), (V2, 11.468, 0.417), (V2_ARMS, 14.848, 0.478)],
    ids=NAMES,
)
def test_a_model_weighs_what_its_source_says(path, mass, com_height):
    model, data = standing(path)
    assert model.body_mass.sum() == pytest.approx(mass, abs=1e-3)
    assert data.subtree_com[1][2] == pytest.approx(com_height, abs=1e-3)


@ALL
def test_a_model_is_its_own_mirror_image(path):
    model, _ = standing(path)
    for index in range(1, model.nbody):
        left = model.body(index)
        if not left.name.startswith("left"):
            continue
        right = model.body(left.name.replace("left", "right"))
        for one in ("pos", "ipos"):
            np.testing.assert_allclose(getattr(right, one), MIRROR @ getattr(left, one), atol=1e-9)
        assert right.mass == left.mass
        own = []
        for body in (left, right):
            R = np.zeros(9)
            mujoco.mju_quat2Mat(R, body.iquat)
            own.append(R.reshape(3, 3) @ np.diag(body.inertia) @ R.reshape(3, 3).T)
        np.testing.assert_allclose(own[1], MIRROR @ own[0] @ MIRROR, atol=1e-9)
    count = (model.njnt - 1) // 2
    for index in range(1, 1 + count):
        left, right = model.joint(index), model.joint(index + count)
        np.testing.assert_array_equal(left.axis, right.axis)
        turned = left.range if left.axis[1] else -left.range[::-1]  # about y: the same in both
        np.testing.assert_allclose(right.range, turned)
        assert model.dof_armature[left.dofadr] == model.dof_armature[right.dofadr]
        limits = model.actuator_ctrlrange[[index - 1, index - 1 + count], 1]
        assert limits[0] == limits[1]
    corners = soles(path, standing(path)[1])
    mirrored = corners[0] @ MIRROR
    assert {tuple(x) for x in mirrored.round(6)} == {tuple(x) for x in corners[1].round(6)}
