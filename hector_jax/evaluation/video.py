"""Before and after side by side, as a film and as a strip of pictures.

MuJoCo reads which OpenGL back end to draw with when it is imported, and a broken back end may end
its process. So the drawing is done by a child process, one per back end until one succeeds: EGL,
OSMesa, GLFW, or only that of MUJOCO_GL where it is set. Parent and child share a file of poses. A
film is a comfort: where none can be made, `VideoUnavailable` says why in one line, and the run goes
on without it.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import imageio_ffmpeg
import jax
import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from hector_jax.geometry import rotation_from_euler
from hector_jax.inputs import POSITIVE, SOME, InputError, Interval, check, choose
from hector_jax.robot import Robot
from hector_jax.trajectory import State, Trajectory

BACK_ENDS = ("egl", "osmesa", "glfw")
METRES_PER_NEWTON = 0.35 / 120.0  # the robot's weight is an arrow of 35 cm
LEAST_ARROW = 0.03  # [m]; shorter ones are not drawn

_PATIENCE = 300.0  # [s] for a back end to draw the whole film
_HEIGHT = 0.423  # [m] of the centre of mass of the robot that the camera is set for
_TRAILS = ((0.72, 0.13, 0.20, 1.0), (0.0, 0.48, 0.37, 1.0))  # colours of before and after
_REFERENCE = (0.08, 0.08, 0.10, 1.0)
_ARROW = (237, 107, 28)


class VideoUnavailable(RuntimeError):  # noqa: N818, it is no fault of the program
    """No film can be made here; the message says why in one line."""


class Arrows(NamedTuple):
    """Arrows of one meaning in both walks of a film."""

    words: str
    colour: tuple[int, int, int]
    ends: tuple[Float[np.ndarray, "T 2 2 3"], ...]  # of each walk: sample, foot, start and tip [m]


@dataclass(frozen=True)
class VideoConfig:
    """How a film looks."""

    width: int = 640  # [pixel], both halves together
    height: int = 360
    rate: int = 25  # frames per second
    speed: float = 1.0  # of the film over that of the walk
    tiles: int = 6  # pictures in a row of the strip

    def __post_init__(self) -> None:
        size = Interval(64, 8192)
        check(self, width=size, height=size, rate=SOME, speed=POSITIVE, tiles=SOME)
        for name, of in (("width", 4), ("height", 2)):
            if getattr(self, name) % of:
                raise InputError(
                    f"VideoConfig.{name} must be a multiple of {of}, got {getattr(self, name)}"
                )


def poses(
    robot: Robot, state: State, joints: Float[np.ndarray, "T 10"]
) -> Float[np.ndarray, "T 17"]:
    """MuJoCo's qpos of a walk: trunk position, trunk quaternion, joints.

    Args:
        robot: whose CoM offset leads from the centre of mass to the trunk.
        state: (T, 3) each, world frame.
        joints: [rad].
    """
    R_wb = np.asarray(jax.vmap(rotation_from_euler)(np.asarray(state.euler)))
    trunk = np.asarray(state.position) - R_wb @ np.asarray(robot.com_offset)
    quaternion = Rotation.from_matrix(R_wb).as_quat()[:, [3, 0, 1, 2]]
    return np.concatenate([trunk, quaternion, joints], axis=1)


def check_back_end() -> None:
    """Find out, before anything is walked for a film, whether MUJOCO_GL names a back end.

    Raises:
        InputError: it does not.
    """
    if asked := os.environ.get("MUJOCO_GL"):
        choose("MUJOCO_GL", asked.lower(), (*BACK_ENDS, "disable"))


def write_video(
    path: Path,
    robot: Robot,
    walks: Mapping[str, Trajectory],
    strip: Path | None = None,
    config: VideoConfig | None = None,
    arrows: Sequence[Arrows] | None = None,
) -> str:
    """Draw two walks side by side as an MP4.

    Args:
        path: film to write.
        robot: the body that walked.
        walks: two, by the words that stand above them, before and after.
        strip: PNG to write with snapshots of both.
        config: size and rate; None takes 640 x 360 at 25 frames per second.
        arrows: to draw at the feet; None takes the forces of the ground.

    Returns:
        The back end that drew it.

    Raises:
        VideoUnavailable: no back end works here, or there is no encoder.
        ValueError: not two walks.
    """
    config = config or VideoConfig()
    if len(walks) != 2:
        raise ValueError(f"a film shows two walks side by side, got {len(walks)}: {list(walks)}")
    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise VideoUnavailable(f"no film: no video encoder ({_one_line(str(error))})") from None
    asked = os.environ.get("MUJOCO_GL")
    with tempfile.TemporaryDirectory(prefix="hector-film-") as name:
        folder = Path(name)
        np.savez(folder / "request.npz", **_request(config, robot, walks, arrows))
        failures = []
        for back_end in (asked,) if asked else BACK_ENDS:
            failure = _draw_in_child(folder, back_end)
            if not failure:
                shutil.move(folder / "film.mp4", path)
                if strip is not None:
                    shutil.move(folder / "strip.png", strip)
                return back_end
            failures.append(f"{back_end}: {failure}")
    raise VideoUnavailable(f"no film: MuJoCo cannot draw here ({'; '.join(failures)})")


def _one_line(text: str, longest: int = 100) -> str:
    words = " ".join(text.split())
    return words if len(words) <= longest else words[: longest - 3] + "..."


def _draw_in_child(folder: Path, back_end: str) -> str:
    """Draw with one back end; why it failed, or nothing."""
    # found wherever the parent found it; PyOpenGL's own choice follows MuJoCo's
    places = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"MUJOCO_GL": back_end, "PYTHONPATH": os.pathsep.join(places)}
    environment.pop("PYOPENGL_PLATFORM", None)
    command = [sys.executable, "-m", "hector_jax.evaluation.video", "request.npz"]
    try:
        done = subprocess.run(
            command,
            cwd=folder,  # MuJoCo logs into the working directory
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"not done after {_PATIENCE:.0f} s"
    if done.returncode == 0:
        return ""
    said = [line for line in done.stderr.splitlines() if line.strip() and line[0] != " "]
    return _one_line(said[-1]) if said else f"ended with code {done.returncode}"


def _request(
    config: VideoConfig,
    robot: Robot,
    walks: Mapping[str, Trajectory],
    arrows: Sequence[Arrows] | None = None,
) -> dict[str, Any]:
    """Everything the child needs to know, as arrays."""
    arrows = [_ground(walks)] if arrows is None else arrows
    seconds = min(float(w.period) * len(w.fallen) for w in walks.values())
    times = np.arange(0.0, seconds + 1e-9, config.speed / config.rate)
    request: dict[str, Any] = {
        "size": np.array([config.width, config.height, config.rate, config.tiles]),
        "times": times,
        "scale": np.asarray(robot.standing_height / _HEIGHT),
        "model": np.array(str(robot.description.model.resolve())),
        "labels": np.array(list(walks)),
        "arrow_words": np.array([one.words for one in arrows]),
        "arrow_colours": np.array([one.colour for one in arrows]) / 255.0,
    }
    for i, walk in enumerate(walks.values()):
        period, fallen = float(walk.period), np.asarray(walk.fallen)
        up = int(np.argmax(fallen)) if fallen.any() else len(fallen)
        at = np.clip(np.round(times / period).astype(int) - 1, 0, max(up - 1, 0))
        state = State(*(np.asarray(x)[at] for x in walk.state))
        request |= {
            f"pose_{i}": poses(robot, state, np.asarray(walk.joints)[at]),
            f"path_{i}": np.asarray(walk.state.position)[at],
            f"aim_{i}": np.asarray(walk.reference.position)[at],
            f"reference_{i}": np.asarray(walk.reference.position)[:: max(1, round(0.02 / period))],
            f"arrows_{i}": np.stack([one.ends[i][at] for one in arrows], axis=1),
            f"fall_{i}": np.array(period * up if fallen.any() else np.inf),
        }
    return request


def _ground(walks: Mapping[str, Trajectory]) -> Arrows:
    """The forces of the ground on both feet."""
    ends = []
    for walk in walks.values():
        feet = np.asarray(walk.feet)
        force = _smooth(np.asarray(walk.effect.force), float(walk.period))
        ends.append(np.stack([feet, feet + METRES_PER_NEWTON * force], axis=2))
    return Arrows("ground force", _ARROW, tuple(ends))


def _smooth(force: Float[np.ndarray, "T 2 3"], period: float) -> Float[np.ndarray, "T 2 3"]:
    """Mean over the 10 ms before each sample: an arrow that can be looked at."""
    width = max(1, round(0.01 / period))
    total = np.cumsum(np.concatenate([np.zeros((width, 2, 3)), force]), axis=0)
    return (total[width:] - total[:-width]) / width


# What follows runs in the child.


def _draw(request: Mapping[str, Any]) -> None:
    """Write film.mp4 and strip.png into the working directory."""
    width, height, rate, tiles = (int(x) for x in request["size"])
    times, labels = request["times"], [str(x) for x in request["labels"]]
    words = [str(x) for x in request["arrow_words"]]
    meanings = dict(zip(words, request["arrow_colours"], strict=True))
    model = mujoco.MjModel.from_xml_path(str(request["model"]))
    data = mujoco.MjData(model)
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width // 2)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    model.vis.quality.shadowsize = 2048  # drawn without a GPU, shadows cost the most
    chosen = np.linspace(0, len(times) - 1, min(tiles, len(times))).round().astype(int)
    snapshots: list[list[np.ndarray]] = [[], []]
    renderer = mujoco.Renderer(model, height, width // 2)
    writer = imageio_ffmpeg.write_frames(
        "film.mp4",
        (width, height),
        fps=rate,
        codec="libx264",
        macro_block_size=2,
        quality=None,
        ffmpeg_log_level="error",
        output_params=["-crf", "19", "-preset", "fast", "-movflags", "+faststart"],
    )
    writer.send(None)
    for k, time in enumerate(times):
        halves = [_view(renderer, model, data, request, i, k) for i in range(2)]
        if k in chosen:
            for row, half in zip(snapshots, halves, strict=True):
                row.append(half)
        falls = [float(request[f"fall_{i}"]) for i in range(2)]
        writer.send(np.ascontiguousarray(_frame(halves, labels, falls, float(time), meanings)))
    writer.close()
    renderer.close()
    Image.fromarray(_strip(snapshots, labels, times[chosen])).save("strip.png")


def _view(
    renderer: mujoco.Renderer,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    request: Mapping[str, Any],
    walk: int,
    k: int,
) -> UInt8[np.ndarray, "height width 3"]:
    """One walk at one time, seen by a camera that goes with the reference."""
    data.qpos[:] = request[f"pose_{walk}"][k]
    mujoco.mj_forward(model, data)
    reference, path = request[f"reference_{walk}"], request[f"path_{walk}"]
    camera, scale = mujoco.MjvCamera(), float(request["scale"])
    camera.lookat[:] = [*request[f"aim_{walk}"][k, :2], 0.37 * scale]
    camera.distance, camera.azimuth, camera.elevation = 1.75 * scale, 125.0, -14.0
    renderer.update_scene(data, camera)
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
    scene = renderer.scene
    for start, end in _dashes(reference):
        _line(scene, start, end, 0.005, _REFERENCE)
    for start, end in zip(path[:k], path[1 : k + 1], strict=True):
        _line(scene, start, end, 0.006, _TRAILS[walk])
    for both, colour in zip(request[f"arrows_{walk}"][k], request["arrow_colours"], strict=True):
        for foot, tip in both:
            if np.linalg.norm(tip - foot) > LEAST_ARROW:
                _between(scene, mujoco.mjtGeom.mjGEOM_ARROW, foot, tip, 0.012, (*colour, 0.9))
    return renderer.render()


def _dashes(points: Float[np.ndarray, "T 3"], length: float = 0.06) -> list[tuple[Any, Any]]:
    """Pieces of a path of `length` [m] with gaps of the same length between them."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    starts = np.arange(0.0, way[-1] - length, 2 * length)
    place = lambda s: np.stack([np.interp(s, way, x) for x in points.T], axis=-1)  # noqa: E731
    return list(zip(place(starts), place(starts + length), strict=True))


def _line(scene: mujoco.MjvScene, start: Any, end: Any, radius: float, rgba: tuple) -> None:
    """A line on the floor under two points."""
    start, end = (np.array([*point[:2], 0.002]) for point in (start, end))
    _between(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, start, end, radius, rgba)


def _between(
    scene: mujoco.MjvScene, kind: int, start: Any, end: Any, radius: float, rgba: tuple
) -> None:
    """A decoration of the scene from one point to another."""
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(
        geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.array(rgba, "f")
    )
    mujoco.mjv_connector(geom, kind, radius, start, end)
    if kind == mujoco.mjtGeom.mjGEOM_ARROW:
        geom.size[2] *= 2.0  # MuJoCo draws an arrow half as long as it was asked for
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    scene.ngeom += 1


def _frame(
    halves: list[np.ndarray],
    labels: list[str],
    falls: list[float],
    time: float,
    meanings: Mapping[str, Any],
) -> UInt8[np.ndarray, "height width 3"]:
    """Both halves with their words."""
    picture = Image.fromarray(np.concatenate(halves, axis=1))
    draw = ImageDraw.Draw(picture, "RGBA")
    half, height = picture.width // 2, picture.height
    for i, (label, fall) in enumerate(zip(labels, falls, strict=True)):
        _words(draw, (i * half + 10, 10), label, _TRAILS[i])
        if time >= fall:
            _words(draw, (i * half + 10, 36), f"fell at {fall:.2f} s", (0.7, 0.1, 0.1, 1.0))
    draw.rectangle((half - 1, 0, half, height), fill="white")
    _words(draw, (picture.width - 10, height - 10), f"{time:.1f} s", None, anchor="rb")
    place = 10.0
    for words, colour in {"dashed: reference": None, **meanings}.items():
        place = 14.0 + _words(draw, (place, height - 10), words, colour, 11, "lb")
    return np.asarray(picture)


def _words(
    draw: ImageDraw.ImageDraw,
    place: tuple[float, float],
    text: str,
    colour: Sequence[float] | None,
    size: int = 14,
    anchor: str = "lt",
) -> float:
    """Words on a light plate, with a mark in the colour of what they name; its right edge."""
    font = ImageFont.load_default(size=size)
    left, top, right, bottom = draw.textbbox(place, text, font, anchor)
    mark = 0 if colour is None else size
    draw.rounded_rectangle(
        (left - 5, top - 5, right + 5 + mark, bottom + 5), 4, fill=(255, 255, 255, 205)
    )
    if colour is not None:
        fill = tuple(int(255 * c) for c in colour)
        draw.rounded_rectangle((left, top, left + size - 5, bottom), 2, fill=fill)
    draw.text((place[0] + mark, place[1]), text, "#16181c", font, anchor)
    return right + 5 + mark


def _strip(
    rows: list[list[np.ndarray]], labels: list[str], times: np.ndarray
) -> UInt8[np.ndarray, "height width 3"]:
    """Snapshots, one row per walk, cut to the robot."""
    cut = rows[0][0].shape[1] // 8
    lines = [np.concatenate([tile[:, cut:-cut] for tile in row], axis=1) for row in rows]
    picture = Image.fromarray(np.concatenate(lines, axis=0))
    draw = ImageDraw.Draw(picture, "RGBA")
    wide, high = picture.width // len(times), picture.height // 2
    for i, label in enumerate(labels):
        _words(draw, (10, i * high + 10), label, _TRAILS[i])
        for k, time in enumerate(times):
            _words(
                draw, (wide * (k + 1) - 10, high * (i + 1) - 10), f"{time:.1f} s", None, 12, "rb"
            )
            if k:
                draw.rectangle((wide * k - 1, 0, wide * k, picture.height), fill="white")
    draw.rectangle((0, high - 1, picture.width, high), fill="white")
    return np.asarray(picture)


if __name__ == "__main__":
    with np.load(sys.argv[1], allow_pickle=False) as archive:
        _draw(dict(archive))
