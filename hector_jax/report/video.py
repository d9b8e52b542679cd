"""Two walks of one command side by side: a film, and a strip of snapshots.

Both halves have the same camera and, as each walk is seen from where it started, the same
reference. MuJoCo reads which OpenGL back end to draw with when it is imported, and a broken back
end may end its process. So the drawing is done by a child process, one per back end until one
succeeds: EGL, OSMesa, GLFW, or only that of MUJOCO_GL where it is set. Where none can draw,
`VideoUnavailable` says why in one line, and the run goes on without a film.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import imageio_ffmpeg
import jax
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from hector_jax.core.console import Broken
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import AT_LEAST_ONE, Range, check, choose
from hector_jax.core.trajectory import State, Trajectory, from_start
from hector_jax.report.plots import distances, named
from hector_jax.robot.model import Robot

BACK_ENDS = ("egl", "osmesa", "glfw")
ENDINGS = (".mp4", ".webp", ".gif", ".png")  # all but the first are pictures that move
COLOURS = ((184, 33, 51), (0, 122, 94))  # of before and after

_PATIENCE = 300.0  # [s] for a back end to draw the whole film
_TOP = 1.6  # height of the robot, in heights of its centre of mass
_WINDOW = 4.0  # [s] of the reference that a film keeps in view
_SAMPLE = 0.02  # [s] between the points of the lines on the floor
_DASH = 4  # of these points
_DOWN, _ASIDE = np.deg2rad(30.0), np.deg2rad(35.0)  # how the camera looks along the way
_LAST = 1500  # [ms] that a picture that moves stands still before it starts again
_INK = (20, 20, 25)


class VideoUnavailable(Broken):
    """No film can be made here; the message says why in one line."""


@dataclass(frozen=True)
class VideoConfig:
    """How a film looks."""

    width: int = 800  # [pixel], both halves together
    height: int = 540  # a quarter of it is the plot below
    rate: int = 20  # frames per second
    tiles: int = 6  # pictures in a row of the strip

    def __post_init__(self) -> None:
        size = Range(64, 8192)
        check(self, width=size, height=size, rate=AT_LEAST_ONE, tiles=AT_LEAST_ONE)
        for name in ("width", "height"):
            if getattr(self, name) % 4:
                raise InputError(
                    f"VideoConfig.{name} must be a multiple of 4, got {getattr(self, name)}"
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


def check_film(path: Path) -> None:
    """Find out, before anything is walked for a film, whether it can be asked for.

    Raises:
        InputError: the ending is none of `ENDINGS`, or MUJOCO_GL names no back end.
    """
    _check_ending(path)
    if asked := os.environ.get("MUJOCO_GL"):
        choose("MUJOCO_GL", asked.lower(), (*BACK_ENDS, "disable"))


def _check_ending(path: Path) -> None:
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"a film must end in {', '.join(ENDINGS)}, got {path.name}")


def write_film(
    path: Path, robot: Robot, walks: Mapping[str, Trajectory], config: VideoConfig | None = None
) -> str:
    """Draw two walks side by side, and below how far each is from the reference.

    Args:
        path: film (.mp4), or picture that moves and starts again (.webp, .gif, .png).
        robot: the body that walked.
        walks: two of one command, by the words that stand above them, before and after.
        config: size and rate.

    Returns:
        The back end that drew it.

    Raises:
        VideoUnavailable: no back end works here, or there is no encoder.
        InputError: the ending is none of these.
    """
    config = config or VideoConfig()
    _check_ending(path)
    if path.suffix.lower() == ".mp4":
        try:
            imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError as error:
            raise VideoUnavailable(f"no film: no video encoder ({_one_line(str(error))})") from None
    times = np.arange(0.0, _seconds(walks) + 1e-9, 1.0 / config.rate)
    return _write(path, config, robot, walks, times, strip=False)


def write_strip(
    path: Path, robot: Robot, walks: Mapping[str, Trajectory], config: VideoConfig | None = None
) -> str:
    """Draw snapshots of two walks, a row each, spread over the phases of a gait cycle.

    Args, returns and raises as `write_film`; the path is that of a PNG.
    """
    config = config or VideoConfig()
    return _write(path, config, robot, walks, _snapshots(walks, config.tiles), strip=True)


def _seconds(walks: Mapping[str, Trajectory]) -> float:
    return min(float(walk.period) * len(walk.fallen) for walk in walks.values())


def _snapshots(walks: Mapping[str, Trajectory], tiles: int) -> Float[np.ndarray, " tiles"]:
    """Times [s] of snapshots, each 1/tiles of a gait cycle later in it: no two show one pose."""
    walk, seconds = next(iter(walks.values())), _seconds(walks)
    stands = np.asarray(walk.contact)[:, 0]
    lands = np.flatnonzero(stands[1:] & ~stands[:-1]) * float(walk.period)
    cycle = min(seconds, np.median(np.diff(lands)) if len(lands) > 1 else seconds)
    whole = np.floor(np.linspace(0.0, seconds / cycle - 1.0, tiles) + 1e-6)
    return cycle * (whole + np.arange(tiles) / tiles)


def _write(
    path: Path,
    config: VideoConfig,
    robot: Robot,
    walks: Mapping[str, Trajectory],
    times: Float[np.ndarray, " K"],
    *,
    strip: bool,
) -> str:
    """Draw what is seen at these times [s] with the first back end that works; returns it."""
    if len(walks) != 2:
        raise ValueError(f"a film shows two walks side by side, got {len(walks)}: {list(walks)}")
    chosen = os.environ.get("MUJOCO_GL")
    with tempfile.TemporaryDirectory(prefix="hector-film-") as name:
        folder, failures = Path(name), []
        drawn = folder / f"drawn{path.suffix.lower()}"
        request = _request(config, robot, walks, times)
        if not strip:
            plot = folder / "plot.png"
            request["box"] = distances(plot, walks, COLOURS, config.width, config.height // 4)
        np.savez(folder / "request.npz", name=np.array(drawn.name), strip=strip, **request)
        for back_end in (chosen,) if chosen else BACK_ENDS:
            failure = _draw_in_child(folder, back_end)
            if not failure:
                shutil.move(drawn, path)
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
    # MuJoCo first, with this back end; the package would load it without any
    program = "import mujoco; from hector_jax.report import video; video.main()"
    command = [sys.executable, "-c", program, "request.npz"]
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
    # what ends the first traceback; those that follow are of what it left open
    first = done.stderr.split("Traceback (most recent call last):")[:2][-1]
    said = [line for line in first.splitlines() if line.strip() and line[0] != " "]
    return _one_line(said[0]) if said else f"ended with code {done.returncode}"


def _request(
    config: VideoConfig,
    robot: Robot,
    walks: Mapping[str, Trajectory],
    times: Float[np.ndarray, " K"],
) -> dict[str, Any]:
    """Everything the child needs to know, as arrays; the walks in the frame of their start."""
    request: dict[str, Any] = {
        "size": np.array([config.width, config.height, config.rate]),
        "times": times,
        "seconds": max(float(walk.period) * len(walk.fallen) for walk in walks.values()),
        "top": _TOP * robot.standing_height,
        "model": np.array(str(robot.description.model.resolve())),
        "labels": np.array([named(name) for name in walks]),
    }
    for i, walk in enumerate(map(from_start, walks.values())):
        period, fallen = float(walk.period), walk.fallen
        up = int(np.argmax(fallen)) if fallen.any() else len(fallen)
        now = np.clip(np.round(times / period).astype(int) - 1, 0, len(fallen) - 1)
        at = np.minimum(now, max(up - 1, 0))
        each = max(1, round(_SAMPLE / period))  # samples from one point of a line to the next
        state = State(*(x[at] for x in walk.state))
        request |= {
            "reference": walk.reference.position[::each],
            "sample": now // each,
            f"pose_{i}": poses(robot, state, walk.joints[at]),
            f"path_{i}": walk.state.position[:up:each],
            f"fall_{i}": np.array(period * up if fallen.any() else np.inf),
        }
    return request


# What follows runs in the child.


class _Stage(NamedTuple):
    """What both walks are drawn with."""

    request: Mapping[str, Any]
    model: mujoco.MjModel
    data: mujoco.MjData
    renderer: mujoco.Renderer
    cameras: list[mujoco.MjvCamera]  # of each frame

    def view(self, walk: int, k: int) -> UInt8[np.ndarray, "height width 3"]:
        """One walk in frame k."""
        request, colour = self.request, np.array([*COLOURS[walk], 255]) / 255.0
        accent = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_MATERIAL, "accent")
        if accent >= 0:
            self.model.mat_rgba[accent] = colour
        self.data.qpos[:] = request[f"pose_{walk}"][k]
        mujoco.mj_forward(self.model, self.data)
        self.renderer.update_scene(self.data, self.cameras[k])
        scene, sample = self.renderer.scene, request["sample"][k]
        scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        ink = np.array([*_INK, 255]) / 255.0
        path, reference = request[f"path_{walk}"][: sample + 1], request["reference"]
        for start, end in pairwise(path):
            _line(scene, start, end, 5.0, 0.003, colour)
        for start, end in zip(reference[:: 2 * _DASH], reference[_DASH :: 2 * _DASH], strict=False):
            _line(scene, start, end, 2.5, 0.005, ink)
        return self.renderer.render()


def _draw(request: Mapping[str, Any]) -> None:
    """Write what is asked for into the working directory."""
    width, height, rate = (int(x) for x in request["size"])
    strip, file = bool(request["strip"]), str(request["name"])
    across, down = (3 * width // 10, 3 * height // 4) if strip else (width // 2, 3 * height // 4)
    model = mujoco.MjModel.from_xml_path(str(request["model"]))
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, across)
    model.vis.global_.offheight = max(model.vis.global_.offheight, down)
    model.vis.quality.shadowsize = 2048  # drawn without a GPU, shadows cost the most
    cameras = _cameras(request, model.vis.global_.fovy, across / down, 0.8 if strip else _WINDOW)
    frames = range(len(request["times"]))
    with mujoco.Renderer(model, down, across) as renderer:
        stage = _Stage(request, model, mujoco.MjData(model), renderer, cameras)
        if strip:
            _strip(request, [[stage.view(i, k) for k in frames] for i in range(2)]).save(file)
        else:
            plot = np.asarray(Image.open("plot.png").convert("RGB"))
            shown = (_frame(request, plot, [stage.view(i, k) for i in range(2)], k) for k in frames)
            _encode(file, shown, (width, height), rate)


def _encode(file: str, frames: Iterable[Image.Image], size: tuple[int, int], rate: int) -> None:
    if not file.endswith(".mp4"):
        first, *rest = frames
        lasts = [1000 // rate] * len(rest) + [_LAST]
        first.save(file, save_all=True, append_images=rest, duration=lasts, loop=0, quality=75)
        return
    writer = imageio_ffmpeg.write_frames(
        file,
        size,
        fps=rate,
        codec="libx264",
        macro_block_size=2,
        quality=None,
        ffmpeg_log_level="error",
        output_params=["-crf", "19", "-preset", "fast", "-movflags", "+faststart"],
    )
    writer.send(None)
    for frame in frames:
        writer.send(frame.tobytes())
    writer.close()


def _cameras(
    request: Mapping[str, Any], fovy: float, aspect: float, seconds: float
) -> list[mujoco.MjvCamera]:
    """Cameras from behind and above that see the robot and `seconds` of the reference around it.

    A walk that lasts no longer is seen by a camera that does not move.
    """
    reference, top = request["reference"] * [1.0, 1.0, 0.0], float(request["top"])
    way = reference[-1] - reference[0]
    heading = np.arctan2(way[1], way[0]) if np.linalg.norm(way) > top else 0.0
    azimuth = heading + _ASIDE
    ahead = np.array(
        [np.cos(azimuth) * np.cos(_DOWN), np.sin(azimuth) * np.cos(_DOWN), -np.sin(_DOWN)]
    )
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    axes = np.stack([right, np.cross(right, ahead), ahead], axis=1)
    half = np.tan(np.deg2rad(fovy) / 2) * np.array([aspect, 1.0])
    count = min(len(reference), round(seconds / _SAMPLE))
    middles, away = [], []
    for sample in request["sample"]:
        first = int(np.clip(sample - count // 2, 0, len(reference) - count))
        floor = reference[first : first + count]
        body = np.concatenate([floor, floor + [0.0, 0.0, top]]) @ axes
        middle = (body.min(axis=0) + body.max(axis=0)) / 2
        spread = np.abs(body[:, :2] - middle[:2]) + 0.3 * top * np.array([1.0, 0.4])
        away.append(np.max(spread / half - (body[:, 2:] - middle[2])))
        middles.append(axes @ middle)
    cameras = [mujoco.MjvCamera() for _ in middles]
    for camera, middle in zip(cameras, middles, strict=True):
        camera.lookat[:], camera.distance = middle, max(away)
        camera.azimuth, camera.elevation = np.rad2deg(azimuth), -np.rad2deg(_DOWN)
    return cameras


def _line(
    scene: mujoco.MjvScene, start: Any, end: Any, pixels: float, height: float, rgba: np.ndarray
) -> None:
    """A line under two points, at a `height` [m] above the floor; the higher hides the lower."""
    geom, kind, zero = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_LINE, np.zeros(3)
    start, end = (np.array([*point[:2], height]) for point in (start, end))
    rgba = rgba * [0.6, 0.6, 0.6, 1.0]  # MuJoCo draws lines brighter than bodies
    mujoco.mjv_initGeom(geom, kind, zero, zero, np.eye(3).ravel(), rgba.astype("f"))
    mujoco.mjv_connector(geom, kind, pixels, start, end)
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    scene.ngeom += 1


def _frame(
    request: Mapping[str, Any], plot: np.ndarray, halves: list[np.ndarray], k: int
) -> Image.Image:
    """Both halves with their words, and below the plot, pale where time has not come yet."""
    left, top, right, bottom = request["box"]
    now = round(left + (right - left) * request["times"][k] / request["seconds"])
    plot = plot.copy()
    ahead = plot[top:bottom, now : right + 1]
    ahead[:] = 255 - (255 - ahead) // 5
    picture = Image.fromarray(np.concatenate([np.concatenate(halves, axis=1), plot]))
    draw = ImageDraw.Draw(picture, "RGBA")
    half, height = halves[0].shape[1], halves[0].shape[0]
    for i, label in enumerate(request["labels"]):
        _words(draw, (i * half + 12, 12), str(label), COLOURS[i])
        if request["times"][k] >= request[f"fall_{i}"]:
            _words(draw, (i * half + 12, 40), f"fell at {request[f'fall_{i}']:.2f} s", COLOURS[0])
    draw.rectangle((half - 1, 0, half, height - 1), fill="white")
    _words(draw, (picture.width - 12, height - 12), f"{request['times'][k]:.1f} s", None, 14, "rb")
    _words(draw, (picture.width - 12, 12), "dashed: reference", None, 14, "rt")
    return picture


def _words(
    draw: ImageDraw.ImageDraw,
    place: tuple[int, int],
    text: str,
    colour: tuple[int, int, int] | None,
    size: int = 16,
    anchor: str = "lt",
) -> None:
    """Words on a light plate, with a mark in the colour of what they name."""
    font = ImageFont.load_default(size=size)
    left, top, right, bottom = draw.textbbox(place, text, font, anchor)
    mark = 0 if colour is None else size
    draw.rounded_rectangle(
        (left - 5, top - 5, right + 5 + mark, bottom + 5), 4, fill=(255, 255, 255, 205)
    )
    if colour is not None:
        draw.rounded_rectangle((left, top, left + size - 5, bottom), 2, fill=colour)
    draw.text((place[0] + mark, place[1]), text, _INK, font, anchor)


def _strip(request: Mapping[str, Any], rows: list[list[np.ndarray]]) -> Image.Image:
    """Snapshots, one row per walk."""
    picture = Image.fromarray(np.concatenate([np.concatenate(row, axis=1) for row in rows]))
    draw = ImageDraw.Draw(picture, "RGBA")
    high, wide = rows[0][0].shape[:2]
    for i, label in enumerate(request["labels"]):
        _words(draw, (12, i * high + 12), str(label), COLOURS[i])
        for k, time in enumerate(request["times"]):
            place = (wide * (k + 1) - 10, high * (i + 1) - 10)
            _words(draw, place, f"{time:.2f} s", None, 14, "rb")
    for k in range(1, len(rows[0])):
        draw.rectangle((wide * k - 1, 0, wide * k, picture.height), fill="white")
    draw.rectangle((0, high - 1, picture.width, high), fill="white")
    return picture


def main() -> None:
    """Draw the request that the first argument names."""
    with np.load(sys.argv[1], allow_pickle=False) as archive:
        _draw(dict(archive))
