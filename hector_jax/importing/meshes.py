"""Read the meshes of a robot's feet, where their files are there: vertices for `soles`.

The model of a robot has no meshes (`elements` removes them unopened). For a foot without a
shape the meshes that its file names are looked for beside the file, in its folder of meshes and in
the package around it. STL and OBJ are read by trimesh, DAE and MuJoCo's MSH here. Meshes that
collide count; those that are only drawn count for a foot that has no other.
"""

import io
import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from copy import deepcopy
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.importing.elements import MESHES, compile_bare, parsed, repair_inertias
from hector_jax.importing.links import Pose, pose_of, subtree
from hector_jax.importing.published import read_whole
from hector_jax.importing.survey import Survey
from hector_jax.robot.poses import rotation_of

_LARGEST = 64_000_000  # [bytes] of a mesh
_PARENTS = 5  # folders above the model, of which one is the package's
_FILE_ERRORS = (ValueError, LookupError, ArithmeticError, AttributeError, TypeError, OSError)


class MeshGeom(NamedTuple):
    """A mesh on a body of the file."""

    body: str
    collides: bool
    file: str  # as the model names it
    folder: str  # of meshes, as the model names it
    pose: Pose  # of the mesh in the body
    scale: Float[np.ndarray, "3"]
    origin: Pose  # of the mesh's axes in those of its file

    def points(self, vertices: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return vertices of the file in the frame of the body [m]."""
        scaled = (vertices - self.origin.p) @ self.origin.R * self.scale
        return self.pose.p + scaled @ self.pose.R.T


class FootMeshes(NamedTuple):
    """The meshes of all feet."""

    points: tuple[Float[np.ndarray, "n 3"], ...]  # by leg, in the frame of data [m]; or empty
    files: tuple[str, ...]  # that were read
    missing: tuple[str, ...]  # that are not there, or cannot be read


def foot_meshes(survey: Survey, data: mujoco.MjData) -> FootMeshes:
    """Return the vertices of the meshes of each foot in a pose of the survey's model."""
    path, model = survey.file.path, survey.file.model
    urdf = survey.file.root.tag == "robot"
    geoms = list(_of_urdf(path) if urdf else _of_mjcf(path, deepcopy(survey.file.root)))
    points, files, missing = [], [], []
    for leg in survey.legs:
        bodies = {model.body(b).name: b for b in subtree(model, int(model.jnt_bodyid[leg[-1]]))}
        own = [geom for geom in geoms if geom.body in bodies]
        own = [geom for geom in own if geom.collides] or own
        of_leg = []
        for geom in own:
            file = _find(path, geom.file, geom.folder)
            vertices = None if file is None else _vertices(file)
            (missing if vertices is None else files).append(Path(geom.file.replace("\\", "/")).name)
            if vertices is not None:
                b = bodies[geom.body]
                R = data.xmat[b].reshape(3, 3)
                of_leg.append(data.xpos[b] + geom.points(vertices) @ R.T)
        points.append(np.concatenate(of_leg) if of_leg else np.zeros((0, 3)))
    return FootMeshes(tuple(points), tuple(dict.fromkeys(files)), tuple(dict.fromkeys(missing)))


def _of_urdf(path: Path) -> Iterator[MeshGeom]:
    for link in read_whole(path).findall("link"):
        for part in link:
            mesh, origin = part.find("geometry/mesh"), part.find("origin")
            if mesh is None or part.tag not in ("collision", "visual"):
                continue
            place = {} if origin is None else origin.attrib
            roll, pitch, yaw = _three(place.get("rpy", "0 0 0"))
            quat = np.zeros(4)
            mujoco.mju_euler2Quat(quat, [roll, pitch, yaw], "XYZ")
            yield MeshGeom(
                body=link.get("name", ""),
                collides=part.tag == "collision",
                file=mesh.get("filename", ""),
                folder="",
                pose=pose_of(np.array(_three(place.get("xyz", "0 0 0"))), quat),
                scale=np.array(_three(mesh.get("scale", "1 1 1"))),
                origin=Pose(),
            )


def _of_mjcf(path: Path, root: ElementTree.Element) -> Iterator[MeshGeom]:
    spec, _, _ = parsed(path, root)
    repair_inertias(path, spec)
    meshes = {mesh.name: mesh for mesh in spec.meshes}
    found = {}
    for i, geom in enumerate([x for x in spec.geoms if x.type in MESHES and x.meshname in meshes]):
        found[f"{i} of the meshes"] = meshes[geom.meshname]
        # MuJoCo gives its pose, by frames and angles of all kinds; of a mesh it would move it
        geom.name, geom.type = f"{i} of the meshes", mujoco.mjtGeom.mjGEOM_SPHERE
        geom.meshname, geom.size, geom.mass = "", [1e-3, 0.0, 0.0], 0.0
    for geom in [x for x in spec.geoms if x.type in MESHES]:
        spec.delete(geom)
    kept = {
        name: (x.file, x.scale.copy(), x.refpos.copy(), x.refquat.copy())
        for name, x in found.items()
    }
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for part in (*spec.meshes, *spec.hfields, *spec.skins, *spec.textures):
        spec.delete(part)
    model = compile_bare(path, root, spec)
    for name, (file, scale, refpos, refquat) in kept.items():
        geom = model.geom(name)
        yield MeshGeom(
            body=model.body(int(geom.bodyid[0])).name,
            collides=bool(geom.contype[0] | geom.conaffinity[0]),
            file=file,
            folder=spec.meshdir,
            pose=pose_of(geom.pos, geom.quat),
            scale=scale,
            origin=Pose(rotation_of(refquat), refpos),
        )


def resolved(path: Path) -> dict[str, bytes]:
    """Return a model that needs nothing outside its folder, and its meshes, by name there.

    What it includes is in it, and it names the meshes where they are to be, and those that are not
    found with the folder in which they are to be sought.

    Raises:
        InputError: it cannot be read.
    """
    root, meshes = read_whole(path), {}
    key = "filename" if root.tag == "robot" else "file"
    folders = ("meshdir", "assetdir")
    compilers = [x for x in root.iter("compiler") if {*folders} & {*x.attrib}]
    folder = next((x.get("meshdir") or x.get("assetdir", "") for x in compilers), "")
    for part in root.iter("mesh"):
        if not (named := part.get(key)):
            continue
        if file := _find(path, named, folder):
            content, name = file.read_bytes(), f"meshes/{file.name}"
            while meshes.get(name, content) != content:  # another file of the same name
                name = f"{name.removesuffix(file.suffix)}_{file.suffix}"
            meshes[name] = content
            if key == "file":
                part.set("name", part.get("name", file.stem))  # by default that of the file
            part.set(key, name)
        elif "://" not in named:
            part.set(key, (Path(folder) / named).as_posix())
    for part, name in product(compilers, folders):
        part.attrib.pop(name, None)
    return {path.name: ElementTree.tostring(root), **meshes}


def _three(text: str) -> list[float]:
    return [float(x) for x in text.split()][:3]


def _find(path: Path, file: str, folder: str) -> Path | None:
    """Return the file of a mesh that a model names; None if it is not there."""
    name = re.sub(r"^\$\(find ([^)]*)\)", r"package://\1", file.replace("\\", "/"))
    scheme, _, rest = name.rpartition("://")
    relative = Path(rest)
    if relative.is_absolute() or relative.suffix.lower() not in _READERS:
        return None
    places = [path.parent / folder / relative, path.parent / relative]
    for parent in list(path.absolute().parents)[:_PARENTS] if scheme else []:
        places += [parent / relative, parent / Path(*relative.parts[1:])]
    places += [x / "meshes" / relative.name for x in list(path.absolute().parents)[:2]]
    return next((x for x in places if x.is_file() and x.stat().st_size <= _LARGEST), None)


def _vertices(file: Path) -> Float[np.ndarray, "n 3"] | None:
    """Return the vertices of a mesh; None of a file that is broken."""
    try:
        vertices = _READERS[file.suffix.lower()](file)
    except (*_FILE_ERRORS, ElementTree.ParseError, struct.error):
        return None
    return vertices if len(vertices) and np.isfinite(vertices).all() else None


def _by_trimesh(file: Path) -> Float[np.ndarray, "n 3"]:
    content, kind = io.BytesIO(file.read_bytes()), file.suffix[1:].lower()
    mesh = trimesh.load(content, kind, force="mesh", process=False, skip_materials=True)
    return np.asarray(mesh.vertices, float)


def _of_msh(file: Path) -> Float[np.ndarray, "n 3"]:
    content = file.read_bytes()
    count = struct.unpack_from("<4i", content)[0]
    return np.frombuffer(content, "<f4", 3 * count, 16).reshape(-1, 3).astype(float)


def _of_dae(file: Path) -> Float[np.ndarray, "n 3"]:
    """Return the positions of a COLLADA file in metres, each geometry where the scene has it."""
    root = ElementTree.fromstring(re.sub(rb'\sxmlns="[^"]*"', b"", file.read_bytes(), count=1))
    unit = root.find("asset/unit")
    meter = 1.0 if unit is None else float(unit.get("meter", "1"))
    shapes = {}
    for geometry in root.iter("geometry"):
        sources = {x.get("id"): x.findtext("float_array") for x in geometry.iter("source")}
        texts = [
            sources[x.get("source", "")[1:]]
            for vertices in geometry.iter("vertices")
            for x in vertices.findall("input[@semantic='POSITION']")
        ]
        numbers = [np.array((text or "").split(), float).reshape(-1, 3) for text in texts]
        shapes[geometry.get("id")] = np.concatenate(numbers)
    placed = [x for scene in root.iter("visual_scene") for x in _of_nodes(scene, np.eye(4), shapes)]
    return meter * np.concatenate(placed or list(shapes.values()))


def _of_nodes(
    node: ElementTree.Element, above: Float[np.ndarray, "4 4"], shapes: dict
) -> Iterator[Float[np.ndarray, "n 3"]]:
    """Yield the geometries of a COLLADA node and of those below it, in the axes of the scene."""
    pose = above
    for part in node:
        numbers = np.array((part.text or "").split() if part.tag in _MOVES else [], float)
        if part.tag in _MOVES:
            pose = pose @ _MOVES[part.tag](numbers)
    for part in node.findall("instance_geometry"):
        yield shapes[part.get("url", "")[1:]] @ pose[:3, :3].T + pose[:3, 3]
    for child in node.findall("node"):
        yield from _of_nodes(child, pose, shapes)


def _turned(numbers: Sequence[float]) -> Float[np.ndarray, "4 4"]:
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, np.asarray(numbers[:3]), np.radians(numbers[3]))
    return _matrix(rotation_of(quat), np.zeros(3))


def _matrix(A: Float[np.ndarray, "3 3"], p: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    return np.block([[A, p[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


_MOVES = {
    "matrix": lambda x: x.reshape(4, 4),
    "translate": lambda x: _matrix(np.eye(3), x),
    "rotate": _turned,
    "scale": lambda x: _matrix(np.diag(x), np.zeros(3)),
}
_READERS = {".stl": _by_trimesh, ".obj": _by_trimesh, ".dae": _of_dae, ".msh": _of_msh}
