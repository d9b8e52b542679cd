"""Robots as others publish them: a small biped as MJCF, and compiled bodies as a URDF."""

import re
import struct
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from hector_jax.core.settings import as_toml
from hector_jax.importing.convert import to_standard
from hector_jax.importing.draft import draft_of
from hector_jax.importing.elements import read_file
from hector_jax.importing.propose import files_of, propose_robot


def replaced(text, *changes):
    """The text with some of it replaced, each pattern as often as it is there."""
    for old, new in changes:
        assert re.search(old, text), old
        text = re.sub(old, new, text)
    return text


LEG = """
<body name="{s}_hip" pos="0 {y} -0.1">
  <inertial pos="0 0 -0.02" mass="0.5" diaginertia="0.001 0.001 0.001"/>
  <joint name="{s}_roll" axis="1 0 0" range="-0.5 0.5"/>
  <body name="{s}_thigh" {thigh}>
    <inertial pos="0 0 -0.1" mass="1" diaginertia="0.01 0.01 0.002"/>
    <joint name="{s}_pitch" axis="0 1 0" range="-1 1"/>
    <geom type="cylinder" size="0.03 0.08" pos="0 0 -0.1"/>
    <geom class="visual" mesh="thigh"/>
    <body name="{s}_shin" pos="0 0 -0.2">
      {shin}
      <joint name="{s}_knee" axis="0 1 0" {knee}/>
      <body name="{s}_foot" pos="0 0 -0.2">
        <inertial pos="0.01 0 -0.02" mass="0.2" diaginertia="0.0002 0.0003 0.0002"/>
        <joint name="{s}_ankle" axis="0 1 0" range="-1 1" pos="0 0 0.01"/>
        <geom type="box" size="0.06 0.03 0.01" pos="0.01 0 -0.03"/>
        <body name="{s}_cap" pos="0.05 0 -0.03">
          <geom type="sphere" size="0.005" mass="0.01"/>
        </body>
      </body>
    </body>
  </body>
</body>
"""
SHIN = '<inertial pos="0 0 -0.1" mass="0.5" diaginertia="0.004 0.004 0.001"/>'
MOTOR = '<position joint="{0}" kp="100" forcerange="-30 30"/>'
BIPED = """<mujoco model="small">
<compiler angle="radian" autolimits="true" meshdir="../meshes"/>
<option cone="elliptic" timestep="0.002"/>
<asset><mesh name="thigh" file="thigh.stl"/><mesh name="arm" file="/etc/passwd"/></asset>
<default><geom density="0"/>
  <default class="visual"><geom type="mesh" contype="0" conaffinity="0" mass="0"/></default>
</default>
<worldbody>
  <body name="base" pos="0 0 1">{free}
    <inertial pos="0.01 0 0.05" mass="4" diaginertia="0.03 0.02 0.02"/>
    <geom type="box" size="0.05 0.08 0.1"/>
    {left}
    <body name="torso" pos="0 0 0.2" euler="0 0 0.1">
      <inertial pos="0 0 0.1" mass="3" diaginertia="0.03 0.02 0.01"/>
      <joint name="waist" axis="0 0 1" range="-1 1" pos="0.02 0 0"/>
      <body name="arm" pos="0 0.1 0.2">
        <inertial pos="0 0 -0.1" mass="0.7" diaginertia="0.003 0.003 0.001"/>
        <joint name="shoulder" axis="0 1 0" range="-3 3"/>
        {arm}
      </body>
    </body>
    {right}
  </body>
</worldbody>
{more}
<actuator>{motors}</actuator>
</mujoco>"""
JOINTS = [f"{s}_{j}" for s in ("left", "right") for j in ("roll", "pitch", "knee", "ankle")]
MOTORS = "".join(MOTOR.format(joint) for joint in JOINTS)
ANGLES = {"pitch": -0.3, "knee": 0.6, "ankle": -0.3}
SIDES, CONTACTS = ("left", "right"), ((0.07, 0.0, -0.04), (-0.05, 0.0, -0.04))
TEXTS = {"free": "<freejoint/>", "more": "", "arm": "", "shin": SHIN, "motors": MOTORS}
TEXTS |= {"knee": 'range="-0.1 2"', "thigh": 'pos="0.01 0 -0.02"'}


class Given(NamedTuple):
    """A model, and the table of a TOML that names its parts."""

    model: object
    table: dict

    def write(self):
        """The path of the TOML, written beside the model."""
        path = self.model.with_name("given.toml")
        path.write_text(as_toml({"model": self.model.name, **self.table}, []))
        return path


_FOLDER, _NUMBERS = TemporaryDirectory(), count()


def proposed(path):
    """What is found of a robot, converted into a folder that stays until the tests end."""
    return propose_robot(path, Path(_FOLDER.name) / str(next(_NUMBERS)))


def standard(given):
    """A robot in the standard form."""
    return to_standard(read_file(given.model), draft_of(given.model, given.table), "given")


def converted(path, out):
    """The TOML of a robot that was converted into a folder, as by `hector robot --out`."""
    proposal = propose_robot(path, out)
    assert proposal.error is None, proposal.error
    for name, content in files_of(proposal, path, []).items():
        (out / name).write_bytes(content)
    return out / "robot.toml"


def small(folder, ankle=-0.3, contacts=CONTACTS, **changes):
    """The small biped, of which some texts may be others."""
    texts = {name: changes.pop(name, text) for name, text in TEXTS.items()}
    legs = {s: LEG.format(s=s, y=y, **texts) for s, y in zip(SIDES, (0.1, -0.1), strict=True)}
    path = folder / "robot.xml"
    path.write_text(BIPED.format(**texts, **legs))
    angles = {f"{s}_{j}": a for s in SIDES for j, a in ANGLES.items()}
    angles |= {"waist": 0.4, "shoulder": 1.0, "left_ankle": ankle, "right_ankle": ankle}
    joints = changes.pop("joints", JOINTS)
    named = {"left": joints[:4], "right": joints[4:]} | {"weld": ["waist", "shoulder"]}
    named |= {"weld": list(changes.pop("weld"))} if "weld" in changes else {}
    bodies = changes.pop("feet", [f"{s}_foot" for s in SIDES])
    feet = {
        s: {"body": body, "contacts": [list(x) for x in contacts]}
        for s, body in zip(SIDES, bodies, strict=True)
    }
    return Given(path, {"standing": angles, "joints": named, "feet": feet, **changes})


def write_box(path, half):
    """A box of half these sides as a mesh's file: STL, OBJ, DAE or MuJoCo's MSH."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    if path.suffix == ".msh":
        path.write_bytes(struct.pack("<4i", 8, 0, 0, 0) + corners.astype("<f4").tobytes())
    elif path.suffix == ".dae":
        numbers = " ".join(map(str, 0.001 * corners.ravel()))  # scaled back by the scene's node
        path.write_text(
            '<COLLADA xmlns="c"><asset><unit meter="1"/></asset><library_geometries>'
            f'<geometry id="g"><mesh><source id="s"><float_array>{numbers}</float_array></source>'
            '<vertices><input semantic="POSITION" source="#s"/></vertices></mesh></geometry>'
            "</library_geometries><visual_scene><node><rotate>0 1 0 90</rotate><rotate>0 1 0 -90"
            '</rotate><scale>1000 1000 1000</scale><instance_geometry url="#g"/></node>'
            "</visual_scene></COLLADA>"
        )
    else:
        trimesh.Trimesh(corners, ConvexHull(corners).simplices).export(path)


def place(pos, quat):
    """A URDF's origin, of a place and a quaternion."""
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, quat)
    R = R.reshape(3, 3)
    rpy = np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0])
    write = lambda numbers: " ".join(f"{x:.17g}" for x in numbers)  # noqa: E731
    return f'<origin xyz="{write(pos)}" rpy="{write(rpy)}"/>'


LINK = '<link name="payload"><inertial><mass value="5"/></inertial></link>'
HOLD = '<joint name="{}" type="fixed"><parent link="{}"/><child link="{}"/></joint>'


def urdf_of(model, world=False):
    """The bodies of a compiled model as a URDF."""
    text = ['<robot name="r">']
    if world:
        text.append('<link name="world"/><joint name="fix" type="fixed"><parent link="world"/>')
        text.append(f'<child link="{model.body(1).name}"/></joint>')
    for b in range(1, model.nbody):
        body, parent = model.body(b), model.body(model.body_parentid[b])
        xx, yy, zz = (f"{x:.17g}" for x in body.inertia)
        text.append(
            f'<link name="{body.name}"><inertial>{place(body.ipos, body.iquat)}'
            f'<mass value="{body.mass[0]:.17g}"/><inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" '
            'ixz="0" iyz="0"/></inertial><visual><geometry><mesh filename="package://a/b.stl"/>'
            "</geometry></visual></link>"
        )
        if b == 1:
            continue
        joint = model.joint(body.jntadr[0])
        dof = joint.dofadr[0]
        limit = model.actuator(joint.name).ctrlrange[1]
        text.append(
            f'<joint name="{joint.name}" type="revolute"><parent link="{parent.name}"/>'
            f'<child link="{body.name}"/>{place(body.pos, body.quat)}'
            f'<axis xyz="{joint.axis[0]} {joint.axis[1]} {joint.axis[2]}"/>'
            f'<limit lower="{joint.range[0]}" upper="{joint.range[1]}" velocity="9" '
            f'effort="{limit}"/>'
            f'<dynamics damping="{model.dof_damping[dof]}" friction="0"/></joint>'
        )
    return "\n".join([*text, "<gazebo><plugin/></gazebo></robot>"])


def by_numbers(folder, text):
    """Another file with HECTOR's joints, feet by places and standing by angles."""
    path = folder / "robot.urdf"
    path.write_text(text)
    bend = {"hip_pitch": np.pi / 4, "knee": -np.pi / 2, "ankle": np.pi / 4}
    angles = {f"{s}_{j}": float(a) for s in SIDES for j, a in bend.items()}
    names = "hip_yaw hip_roll hip_pitch knee ankle".split()
    joints = {s: [f"{s}_{x}" for x in names] for s in SIDES}
    point, sole = [0.0, 0.0, -0.04], [[0.09, 0.0, -0.04], [-0.06, 0.0, -0.04]]
    feet = {s: {"body": f"{s}_foot", "contacts": sole, "point": point} for s in SIDES}
    return Given(path, {"standing": angles, "joints": joints, "feet": feet})
