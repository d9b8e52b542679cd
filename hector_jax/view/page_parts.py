"""Parts of the pages in the browser: floor, bodies of a robot, plots."""

from collections.abc import Mapping
from itertools import cycle
from typing import Any

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.report.plots.style import rgb_of

# Lengths in the scene, as shares of the robot's standing height.
DISTANCE = 1.9  # between two robots
WEIGHT = 5 / 6  # length of an arrow for the robot's weight
_HEAD = 0.083  # of an arrow
_DASHES = ([6, 4], [], [2, 3], [10, 3, 2, 3])  # of lines in plots: before, after, further sets


def add_floor(scene: Any) -> tuple[Any, Any]:
    """Add the frame of all that moves with the world under the camera, and the floor in it."""
    world = scene.add_frame("/world", show_axes=False)
    colours = {"cell_color": (224, 228, 233), "section_color": (196, 203, 211)}
    colours |= {"plane_color": (241, 243, 246), "plane_opacity": 1.0}
    return world, scene.add_grid("/world/floor", 30.0, 30.0, **colours)


def lay_out(server: Any, height: float, heading: float = 0.0) -> None:
    """Lay out the page, which looks at robots of this height [m] that walk along `heading`."""
    server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.scene.set_up_direction("+z")
    camera, side = server.initial_camera, heading - np.deg2rad(50.0)
    camera.look_at = (0.0, 0.0, 0.76 * height)
    camera.position = tuple(height * np.array([3.8 * np.cos(side), 3.8 * np.sin(side), 1.8]))


def add_label(scene: Any, name: str, text: str) -> Any:
    """Add a label that stands on its position."""
    return scene.add_label(name, text, anchor="bottom-center", font_screen_scale=1.4)


def add_arrows(
    scene: Any, name: str, colour: tuple[int, int, int], height: float, radius: float = 0.019
) -> Any:
    """Add arrows for a robot of this height [m]; the radius of the shafts is a share of it."""
    size = {"shaft_radius": radius * height, "head_radius": 2.3 * radius * height}
    points = np.zeros((1, 2, 3), np.float32)
    return scene.add_arrows(name, points, colour, head_length=_HEAD * height, **size)


def plot(gui: Any, title: str, x_name: str, x: np.ndarray, lines: Mapping[str, np.ndarray]) -> Any:
    """Add a plot to the panel."""
    axes = {"scales": {"x": {"time": False}}, "axes": ({"label": x_name}, {}), "aspect": 2.0}
    return gui.add_uplot((x, *lines.values()), series(x_name, lines), title=title, **axes)


def series(x_name: str, names: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:
    """Return the looks of the lines of a plot, by the names of their sets."""
    looks = zip(names, rgb_of(names), cycle(_DASHES), strict=False)
    lines = ({"label": n, "stroke": f"rgb{c}", "dash": d, "width": 2} for n, c, d in looks)
    return ({"label": x_name}, *lines)


class Bodies:
    """The bodies of a robot in the scene."""

    def __init__(
        self, scene: Any, root: str, model: mujoco.MjModel, accent: tuple[int, int, int]
    ) -> None:
        """Add them below the frame `root`; see `_body_meshes`."""
        self._model, self._data = model, mujoco.MjData(model)
        meshes = _body_meshes(model, accent).items()
        self._handles = {b: scene.add_mesh_trimesh(f"{root}/body{b}", mesh) for b, mesh in meshes}

    def move(self, pose: Float[np.ndarray, " nq"]) -> None:
        """Take a pose, MuJoCo's qpos."""
        self._data.qpos[:] = pose
        mujoco.mj_kinematics(self._model, self._data)
        for body, handle in self._handles.items():
            handle.position = self._data.xpos[body].copy()
            handle.wxyz = self._data.xquat[body].copy()


def _body_meshes(model: mujoco.MjModel, accent: tuple[int, int, int]) -> dict[int, Any]:
    """Make a mesh of the visible geoms of each body (geom groups 0 to 2).

    Args:
        model: model of the robot.
        accent: colour for the material named "accent".
    """
    import trimesh
    from trimesh.creation import box, capsule, cylinder, icosphere

    kinds = mujoco.mjtGeom
    solids = {  # from MuJoCo's sizes
        kinds.mjGEOM_BOX: lambda size: box(extents=2.0 * size),
        kinds.mjGEOM_CYLINDER: lambda size: cylinder(radius=size[0], height=2.0 * size[1]),
        kinds.mjGEOM_CAPSULE: lambda size: capsule(radius=size[0], height=2.0 * size[1]),
        kinds.mjGEOM_SPHERE: lambda size: icosphere(subdivisions=2, radius=size[0]),
        kinds.mjGEOM_ELLIPSOID: lambda size: icosphere(subdivisions=2).apply_scale(size),
    }
    meshes: dict[int, list[Any]] = {}
    for geom in map(model.geom, range(model.ngeom)):
        body, kind, material = geom.bodyid[0], kinds(geom.type[0]), geom.matid[0]
        if body == 0 or geom.group[0] > 2 or kind not in solids:
            continue
        mesh = solids[kind](geom.size)
        if kind in (kinds.mjGEOM_BOX, kinds.mjGEOM_CYLINDER):
            mesh.unmerge_vertices()  # draws sharp edges
        rgba = model.mat_rgba[material] if material >= 0 else geom.rgba
        if material >= 0 and model.material(material).name == "accent":
            rgba = np.array([*accent, 255]) / 255.0
        mesh.apply_transform(trimesh.transformations.quaternion_matrix(geom.quat))
        mesh.apply_translation(geom.pos)
        mesh.visual.vertex_colors = np.round(255.0 * np.asarray(rgba)).astype(np.uint8)
        meshes.setdefault(int(body), []).append(mesh)
    return {body: trimesh.util.concatenate(parts) for body, parts in meshes.items()}
