"""A run on a local web page: two walks side by side, what the ground does, the tuning as it goes.

Where everything is at each tick is worked out before the page opens, and a displayed tick is one
batch of updates. The walks stand beside one another, shifted across their way. To follow them the
world moves under the camera, so that turning the camera by hand keeps working. The page is drawn by
viser, of the extra `view`, and asks no other machine for anything.
"""

import errno
import logging
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from importlib.util import find_spec
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.core.geometry import rot_z
from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Trajectory, Wrench, from_start
from hector_jax.report.folder import METRICS, RESULT, as_sentence, curves, read_histories
from hector_jax.report.plots.style import named
from hector_jax.report.video import COLOURS, poses
from hector_jax.robot.model import Robot

HOST, PORT = "127.0.0.1", 8080

_RATE = 30.0  # displayed ticks per second, at most
_PAUSE = 1.0  # [s] between looks at the metrics
_APART = 0.8  # [m] between the two walks
# [m/N], [m/(N m)] of the arrows: that of the robot's weight has 35 cm
_SCALES = {"force": 0.35 / 120.0, "moment": 0.35 / 12.0}
_LEAST_ARROW = 0.03  # [m]; shorter ones are not drawn
_RADII = {"force": 0.008, "moment": 0.014}  # [m] of their shafts
_DARK = (20, 20, 25)
# before, after and what else there is: told apart by dashes too
_STROKES = (
    ("rgb(184, 33, 51)", [6, 4]),
    ("rgb(0, 122, 94)", []),
    ("rgb(0, 114, 178)", [2, 3]),
    ("rgb(122, 62, 157)", [10, 3, 2, 3]),
)

_NONE_YET = {"no iteration yet": np.full(1, np.nan)}  # a plot without a line is refused


class _Source(NamedTuple):
    """How the wrenches of one source are shown."""

    words: str
    colour: tuple[int, int, int]
    aside: float  # [m] outwards from the foot point: legs and arrows do not hide each other


_SOURCES = {
    "commanded": _Source("commanded", (25, 25, 30), 0.06),
    "measured": _Source("measured", (240, 120, 20), 0.09),
    "predicted": _Source("predicted by the net", (80, 170, 255), 0.12),
}


class Shown(NamedTuple):
    """One walk, at the plan interval."""

    walk: Trajectory
    ground: dict[str, Wrench]  # commanded, measured, predicted, or some; (T, 2, 3), yaw frame


class Motion(NamedTuple):
    """Where everything of a walk is, world frame; after a fall, where it was last seen."""

    seconds: Float[np.ndarray, " T"]
    position: Float[np.ndarray, "T bodies 3"]  # of MuJoCo's bodies [m]
    wxyz: Float[np.ndarray, "T bodies 4"]
    path: Float[np.ndarray, "T 3"]  # of the centre of mass
    reference: Float[np.ndarray, "T 3"]
    arrows: dict[tuple[str, str], Float[np.ndarray, "T 2 2 3"]]  # by kind and source: start, end
    soles: Float[np.ndarray, "n 2 3"]  # heel and toe of each foot as it was set down
    fall: float  # [s], infinite where there is none


def motion(robot: Robot, model: mujoco.MjModel, shown: Shown) -> Motion:
    """What of a walk is drawn where, in the frame of its start.

    Args:
        robot: the body that walked.
        model: of the same body.
        shown: the walk.
    """
    walk = from_start(shown.walk)
    fallen, period = np.asarray(walk.fallen), float(walk.period)
    up = int(np.argmax(fallen)) if fallen.any() else len(fallen)
    at = np.minimum(np.arange(len(fallen)), max(up - 1, 0))
    state, feet, joints, contact = jax.tree.map(
        lambda x: np.asarray(x)[at], (walk.state, walk.feet, walk.joints, walk.contact)
    )
    position, wxyz = _body_frames(model, poses(robot, state, joints))
    # the yaw frame of a wrench is that as its tick starts
    yaw = np.concatenate([np.asarray(walk.initial.euler)[None], state.euler])[:-1, 2]
    R = np.asarray(jax.vmap(rot_z)(yaw))
    outwards = np.stack([R[..., 1], -R[..., 1]], axis=1)  # of the left foot and of the right
    arrows = {}
    for source, wrench in shown.ground.items():
        start = feet + _SOURCES[source].aside * outwards
        for kind, scale in _SCALES.items():
            turned = np.einsum("tij,tfj->tfi", R, np.asarray(getattr(wrench, kind))[at])
            end = start + scale * turned
            arrows[kind, source] = np.stack([start, end], axis=2)
    landed = np.diff(contact.astype(int), axis=0, prepend=0) > 0
    tick, foot = np.nonzero(landed)
    ahead = R[tick, :, 0]
    soles = [feet[tick, foot] - robot.heel * ahead, feet[tick, foot] + robot.toe * ahead]
    return Motion(
        seconds=period * np.arange(1, len(fallen) + 1),
        position=position,
        wxyz=wxyz,
        path=state.position,
        reference=np.asarray(walk.reference.position),
        arrows=arrows,
        soles=np.stack(soles, axis=1),
        fall=period * up if fallen.any() else np.inf,
    )


def titles(names: Iterable[str]) -> list[str]:
    """What stands above two walks."""
    return [f"{when}: {named(name)}" for when, name in zip(("before", "after"), names, strict=True)]


def _body_frames(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    data, frames = mujoco.MjData(model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        frames.append((data.xpos.copy(), data.xquat.copy()))
    position, wxyz = zip(*frames, strict=True)
    return np.stack(position), np.stack(wxyz)


def check_viser() -> None:
    """Find out, before anything is walked, whether the page can be drawn.

    Raises:
        InputError: viser is not installed.
    """
    if find_spec("viser") is None:
        raise InputError(
            "the page needs the package viser: pip install 'hector-jax[view]' "
            "(--headless writes a film without it)"
        )


def serve(
    walk: Callable[[], tuple[Mapping[str, Motion], str]],
    model: mujoco.MjModel,
    folder: Path,
    on_open: Callable[[str], None],
    host: str = HOST,
    port: int = PORT,
) -> None:
    """Show two walks and the tuning of a run until interrupted.

    Args:
        walk: called once the page can be opened; gives the motions of the walks, before and after,
            by the words that stand above them, and what is seen, in Markdown.
        model: of the body that walks.
        folder: of the run, whose metrics are read again as they grow.
        on_open: called with the page's address once it can be opened.
        host: address to listen on; the default lets no other machine in.
        port: where it is taken, a free one is used instead.

    Raises:
        InputError: viser is not installed, or the address cannot be listened on.
    """
    check_viser()
    import viser

    # a browser that hangs up early would be told with a traceback
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):  # viser tells its own
        server = viser.ViserServer(host, _free_port(host, port), label="hector", verbose=False)
        try:
            note = server.gui.add_markdown("The robots walk in a moment.")
            on_open(f"http://{host}:{server.get_port()}")
            motions, story = walk()
            note.remove()
            page = Page(server, motions, model, folder, story)
            last = time.monotonic()
            while True:
                time.sleep(1.0 / _RATE)
                now = time.monotonic()
                page.advance(now - last)
                last = now
        finally:
            server.stop()


def _free_port(host: str, asked: int) -> int:
    """The port, or a free one where it is taken."""
    for port in (asked, 0):
        try:
            with socket.create_server((host, port)) as listening:
                return listening.getsockname()[1]
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                told = f"cannot listen on {host}, port {port}: {error.strerror}"
                raise InputError(told) from None
    raise InputError(f"no free port on {host}")


class Page:
    """What the browser shows, and when."""

    def __init__(
        self,
        server: Any,
        motions: Mapping[str, Motion],
        model: mujoco.MjModel,
        folder: Path,
        story: str,
    ) -> None:
        """Build the page on a `viser.ViserServer`; the rest as in `serve`."""
        self._server, self._folder = server, folder
        self._names, self._motions = list(motions), list(motions.values())
        self._length = min(len(one.seconds) for one in self._motions)
        self._playing, self._tick = True, -1  # the tick that is shown; -1: to be drawn anew
        self._read, self._since = (-1, False), np.inf  # size of the metrics, run done; [s] ago
        self._build_panel(story)
        self._build_scene(model)
        self.advance(0.0)

    def advance(self, elapsed: float) -> None:
        """Let `elapsed` [s] go by: move on if playing, look at the metrics from time to time."""
        if self._playing:
            now, end = self._time.value, self._time.max
            self._time.value = min(now + elapsed * self._speed.value, end) if now < end else 0.0
        tick = int(np.clip(round(self._time.value / self._time.step) - 1, 0, self._length - 1))
        if tick != self._tick:
            self._tick = tick
            with self._server.atomic():
                self._draw(tick)
        self._since += elapsed
        if self._since >= _PAUSE:
            self._since = 0.0
            self._look()

    def _build_panel(self, story: str) -> None:
        gui = self._server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.add_markdown(story)
        seconds = self._motions[0].seconds[: self._length]
        with gui.add_folder("Playback"):
            self._button = gui.add_button("Pause")
            self._time = gui.add_slider("time [s]", 0.0, float(seconds[-1]), float(seconds[0]), 0.0)
            self._speed = gui.add_slider("speed", 0.05, 2.0, 0.05, 0.5)
            self._follow = gui.add_checkbox("follow the robots", True)
        with gui.add_folder("Ground on the feet"):
            sources = {source: None for _, source in self._motions[0].arrows}
            gui.add_html(_legend(list(sources)))
            self._shown = {
                **{source: gui.add_checkbox(_SOURCES[source].words, True) for source in sources},
                "force": gui.add_checkbox("forces", True),
                "moment": gui.add_checkbox("moments", False),
            }
        with gui.add_folder("Tuning"):
            self._losses = _plot(gui, "L on the model [1e6]", "iteration", np.zeros(1), _NONE_YET)
            self._told = gui.add_markdown("")
        with gui.add_folder("Distance from the reference"):
            errors = {
                name: 100.0 * np.linalg.norm((m.path - m.reference)[: self._length, :2], axis=1)
                for name, m in zip(self._names, self._motions, strict=True)
            }
            _plot(gui, "in the plane [cm]", "time [s]", seconds, errors)
        self._button.on_click(lambda _: self._play(not self._playing))
        # moved by a person, not by us
        self._time.on_update(lambda event: event.client is not None and self._play(False))
        for box in (self._follow, *self._shown.values()):
            box.on_update(lambda _: setattr(self, "_tick", -1))

    def _play(self, playing: bool) -> None:
        self._playing = playing
        self._button.label = "Pause" if playing else "Play"

    def _build_scene(self, model: mujoco.MjModel) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        way = self._motions[0].reference[-1] - self._motions[0].reference[0]
        heading = np.arctan2(way[1], way[0])
        across = np.array([-np.sin(heading), np.cos(heading), 0.0])
        side = heading - np.deg2rad(50.0)
        self._server.initial_camera.look_at = (0.0, 0.0, 0.32)
        self._server.initial_camera.position = (1.6 * np.cos(side), 1.6 * np.sin(side), 0.75)
        self._world = scene.add_frame("/world", show_axes=False)
        scene.add_grid(
            "/world/floor",
            30.0,
            30.0,
            cell_color=(224, 228, 233),
            section_color=(196, 203, 211),
            plane_color=(241, 243, 246),
            plane_opacity=1.0,
        )
        self._handles = []
        for i, one in enumerate(self._motions):
            root = f"/world/{i}"
            scene.add_frame(root, show_axes=False, position=(0.5 - i) * _APART * across)
            lines = {
                "footholds": (_on_floor(one.soles, 0.003), _pale(COLOURS[i]), 0.03),
                "path": (_on_floor(_pieces(one.path, 2), 0.006), COLOURS[i], 0.008),
                "reference": (_on_floor(_pieces(one.reference, 6)[::2], 0.008), _DARK, 0.01),
            }
            for line, (points, colour, thickness) in lines.items():
                scene.add_line_segments(f"{root}/{line}", points, colour, thickness=thickness)
            self._handles.append(
                {
                    "aim": scene.add_icosphere(f"{root}/aim", 0.018, _DARK),
                    "name": scene.add_label(
                        f"{root}/name", "", anchor="bottom-center", font_screen_scale=1.4
                    ),
                    "bodies": {
                        body: scene.add_mesh_trimesh(f"{root}/body{body}", mesh)
                        for body, mesh in _meshes(model, COLOURS[i]).items()
                    },
                    "arrows": {
                        (kind, source): scene.add_arrows(
                            f"{root}/{kind}/{source}",
                            np.zeros((1, 2, 3), np.float32),
                            _SOURCES[source].colour,
                            shaft_radius=_RADII[kind],
                            head_radius=2.3 * _RADII[kind],
                            head_length=0.035,
                        )
                        for kind, source in one.arrows
                    },
                }
            )

    def _draw(self, tick: int) -> None:
        aim = self._motions[0].reference[tick] * [1.0, 1.0, 0.0]
        self._world.position = -aim * self._follow.value
        for name, one, handles in zip(self._names, self._motions, self._handles, strict=True):
            for body, handle in handles["bodies"].items():
                handle.position, handle.wxyz = one.position[tick, body], one.wxyz[tick, body]
            for (kind, source), handle in handles["arrows"].items():
                arrows = one.arrows[kind, source][tick]
                seen = (
                    np.linalg.norm(arrows[:, 1] - arrows[:, 0], axis=1) > _LEAST_ARROW
                )  # NaN: not
                shown = self._shown[kind].value and self._shown[source].value
                handle.visible = bool(shown and seen.any())
                if handle.visible:
                    handle.points = arrows[seen].astype(np.float32)
            handles["aim"].position = one.reference[tick]
            handles["name"].position = one.path[tick] + [0.0, 0.0, 0.36]
            fell = f", fell at {one.fall:.2f} s" if one.seconds[tick] > one.fall else ""
            handles["name"].text = name + fell

    def _look(self) -> None:
        path, done = self._folder / METRICS, (self._folder / RESULT).exists()
        now = (path.stat().st_size if path.exists() else 0, done)
        if now == self._read:
            return
        self._read = now
        histories = read_histories(self._folder)
        found = curves(histories) or _NONE_YET
        iterations = np.arange(float(len(next(iter(found.values())))))
        with self._server.atomic():
            self._losses.series = _series("iteration", found)
            self._losses.data = (iterations, *found.values())
            self._told.content = as_sentence(histories, done)


def _plot(gui: Any, title: str, x_name: str, x: np.ndarray, lines: Mapping[str, np.ndarray]) -> Any:
    """A plot in the panel."""
    return gui.add_uplot(
        (x, *lines.values()),
        _series(x_name, lines),
        title=title,
        scales={"x": {"time": False}},
        axes=({"label": x_name}, {}),
        aspect=2.0,
    )


def _series(x_name: str, names: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:
    looks = zip(names, cycle(_STROKES), strict=False)
    lines = ({"label": n, "stroke": s, "dash": d, "width": 2} for n, (s, d) in looks)
    return ({"label": x_name}, *lines)


def _legend(sources: Sequence[str]) -> str:
    """Which colour is whose, and the scale, as HTML."""
    marks = []
    for source in sources:
        words, colour, _ = _SOURCES[source]
        marks.append(f'<span style="color:rgb{colour}">&#9650;</span>&nbsp;{words}')
    scale = "thin: forces, 35 cm are 120 N; thick: moments, 35 cm are 12 N m"  # see _SCALES
    return f'<div style="padding:0 1em; font-size:smaller">{" &ensp;".join(marks)}<br>{scale}</div>'


def _pale(colour: tuple[int, int, int]) -> tuple[int, ...]:
    return tuple(int(c + 0.55 * (255 - c)) for c in colour)


def _pieces(points: Float[np.ndarray, "T 3"], ticks: int) -> Float[np.ndarray, "n 2 3"]:
    """A path as pieces of some ticks each."""
    return np.stack([points[:-ticks:ticks], points[ticks::ticks]], axis=1)


def _on_floor(pieces: Float[np.ndarray, "n 2 3"], height: float) -> Float[np.ndarray, "n 2 3"]:
    """What lies on the floor under them, at its own height [m] so that nothing flickers."""
    return pieces * [1.0, 1.0, 0.0] + [0.0, 0.0, height]


def _meshes(model: mujoco.MjModel, accent: tuple[int, int, int]) -> dict[int, Any]:
    """What MuJoCo draws of each body (geom groups 0 to 2), the material `accent` recoloured."""
    import trimesh

    box, ball = trimesh.creation.box, trimesh.creation.icosphere
    kinds, pieces = mujoco.mjtGeom, {}
    for i in np.nonzero((model.geom_bodyid > 0) & (model.geom_group <= 2))[0]:
        size, kind = model.geom_size[i], model.geom_type[i]
        if kind == kinds.mjGEOM_BOX:
            mesh = box(extents=2.0 * size)
        elif kind == kinds.mjGEOM_CYLINDER:
            mesh = trimesh.creation.cylinder(radius=size[0], height=2.0 * size[1])
        elif kind == kinds.mjGEOM_CAPSULE:
            mesh = trimesh.creation.capsule(radius=size[0], height=2.0 * size[1])
        elif kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
            mesh = ball(subdivisions=2).apply_scale(
                size if kind == kinds.mjGEOM_ELLIPSOID else size[0]
            )
        else:
            continue
        if kind in (kinds.mjGEOM_BOX, kinds.mjGEOM_CYLINDER):
            mesh.unmerge_vertices()  # sharp edges
        material = model.geom_matid[i]
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[i]
        if material >= 0 and model.material(material).name == "accent":
            rgba = np.array([*accent, 255]) / 255.0
        pieces.setdefault(int(model.geom_bodyid[i]), []).append(
            _placed(mesh, model.geom_pos[i], model.geom_quat[i], rgba)
        )
    return {body: trimesh.util.concatenate(parts) for body, parts in pieces.items()}


def _placed(mesh: Any, position: np.ndarray, wxyz: np.ndarray, rgba: Any) -> Any:
    import trimesh

    T = trimesh.transformations.quaternion_matrix(wxyz)
    T[:3, 3] = position
    mesh.apply_transform(T)
    mesh.visual.vertex_colors = np.round(255.0 * np.asarray(rgba)).astype(np.uint8)
    return mesh
