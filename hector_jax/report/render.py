"""The child process of a film: draws a `video.Scene` with MuJoCo and writes the film or strip.

It runs in a folder with `scene.pickle`.
"""

import pickle
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from hector_jax.core.headless import mujoco
from hector_jax.report.motion import COLOURS, INK
from hector_jax.report.plots import distances
from hector_jax.report.video import Scene

_WINDOW = 4.0  # [s] of the reference in view of a film
_STRIP_WINDOW = 0.8  # [s] of the reference in view of a snapshot
_SAMPLE = 0.02  # [s] between the points of the lines on the floor
_DASH = 4  # points of a dash
_DOWN, _ASIDE = 30.0, 35.0  # [deg] of the camera, against the horizon and the heading
_LAST = 1500  # [ms] of the last frame of an animated picture, before it repeats


def main() -> None:
    """Draw scene.pickle of the working directory."""
    scene: Scene = pickle.loads(Path("scene.pickle").read_bytes())
    width, height = scene.config.width, scene.config.height
    views = _views(scene, 3 * width // 10 if scene.strip else width // 2, 3 * height // 4)
    if scene.strip:
        _strip(scene, list(views)).save(scene.file)
    else:
        box = distances(Path("plot.png"), scene.motions, width, height // 4)
        plot = np.asarray(Image.open("plot.png").convert("RGB"))
        frames = (_frame(scene, plot, box, halves, k) for k, halves in enumerate(views))
        _encode(scene.file, frames, (width, height), scene.config.rate)


def _views(scene: Scene, width: int, height: int) -> Iterator[list[UInt8[np.ndarray, "h w 3"]]]:
    """Render the two walks at each time of the scene."""
    model = scene.model
    data = mujoco.MjData(model)
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    quality = model.vis.quality  # half the time without a GPU, and no visible difference
    quality.shadowsize, quality.numslices, quality.numstacks = 1024, 16, 8
    accent = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MATERIAL, "accent")
    seconds = _STRIP_WINDOW if scene.strip else _WINDOW
    cameras = _cameras(scene, model.vis.global_.fovy, width / height, seconds)
    motions, reference = list(scene.motions.values()), _floor_reference(scene)
    with mujoco.Renderer(model, height, width) as renderer:

        def view(i: int, sample: int, camera: mujoco.MjvCamera) -> np.ndarray:
            motion, colour = motions[i], _rgba(COLOURS[i])
            if accent >= 0:
                model.mat_rgba[accent] = colour
            data.qpos[:] = motion.qpos[sample]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
            path = motion.path[: min(sample + 1, motion.upright) : _spacing(motion.period)]
            _lines(renderer.scene, pairwise(path), 5.0, 0.003, colour)
            dashes = zip(reference[:: 2 * _DASH], reference[_DASH :: 2 * _DASH], strict=False)
            _lines(renderer.scene, dashes, 2.5, 0.005, _rgba(INK))
            return renderer.render()

        samples = np.stack([motion.sample_at(scene.times) for motion in motions], axis=1)
        for pair, camera in zip(samples, cameras, strict=True):
            yield [view(i, sample, camera) for i, sample in enumerate(pair)]


def _rgba(colour: tuple[int, int, int]) -> Float[np.ndarray, "4"]:
    return np.array([*colour, 255]) / 255.0


def _spacing(period: float) -> int:
    """Return the number of samples between two points of a line on the floor."""
    return max(1, round(_SAMPLE / period))


def _floor_reference(scene: Scene) -> Float[np.ndarray, "n 3"]:
    last = list(scene.motions.values())[-1]
    return last.reference[:: _spacing(last.period)]


def _lines(scene: Any, lines: Iterable[Any], pixels: float, height: float, rgba: Any) -> None:
    """Draw lines under pairs of points, at a `height` [m]; higher lines hide lower ones."""
    rgba = (rgba * [0.6, 0.6, 0.6, 1.0]).astype("f")  # MuJoCo draws lines brighter than bodies
    kind, zero, identity = mujoco.mjtGeom.mjGEOM_LINE, np.zeros(3), np.eye(3).ravel()
    for ends in lines:
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, zero, zero, identity, rgba)
        mujoco.mjv_connector(geom, kind, pixels, *(np.array([*end[:2], height]) for end in ends))
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR
        scene.ngeom += 1


def _cameras(scene: Scene, fovy: float, aspect: float, seconds: float) -> list[mujoco.MjvCamera]:
    """Place cameras behind and above, with the robot and `seconds` of the reference in view.

    In a walk that is no longer than that, the camera does not move.
    """
    last, top = list(scene.motions.values())[-1], scene.top
    reference = _floor_reference(scene) * [1.0, 1.0, 0.0]
    span = reference[-1] - reference[0]
    heading = np.arctan2(span[1], span[0]) if np.linalg.norm(span) > top else 0.0
    azimuth = np.rad2deg(heading) + _ASIDE
    view = Rotation.from_euler("ZX", [azimuth - 90.0, 90.0 - _DOWN], degrees=True)
    slopes = np.tan(np.deg2rad(fovy) / 2) * np.array([aspect, 1.0])  # of the edges of the image
    count = min(len(reference), round(seconds / _SAMPLE))
    cameras = []
    for sample in last.sample_at(scene.times) // _spacing(last.period):
        first = int(np.clip(sample - count // 2, 0, len(reference) - count))
        floor = reference[first : first + count]
        points = np.concatenate([floor, floor + [0.0, 0.0, top]])
        points = view.apply(points, inverse=True)  # right, up, back
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        spread = np.abs(points[:, :2] - middle[:2]) + 0.3 * top * np.array([1.0, 0.4])
        camera = mujoco.MjvCamera()
        camera.lookat[:] = view.apply(middle)
        camera.distance = np.max(spread / slopes + (points[:, 2:] - middle[2]))
        camera.azimuth, camera.elevation = azimuth, -_DOWN
        cameras.append(camera)
    farthest = max(camera.distance for camera in cameras)
    for camera in cameras:
        camera.distance = farthest
    return cameras


def _encode(file: str, frames: Iterable[Image.Image], size: tuple[int, int], rate: int) -> None:
    if not file.endswith(".mp4"):
        first, *rest = frames
        durations = [1000 // rate] * len(rest) + [_LAST]
        first.save(file, save_all=True, append_images=rest, duration=durations, loop=0, quality=75)
        return
    options: dict[str, Any] = {"codec": "libx264", "macro_block_size": 2, "quality": None}
    options["output_params"] = ["-crf", "19", "-preset", "fast", "-movflags", "+faststart"]
    writer = imageio_ffmpeg.write_frames(file, size, fps=rate, ffmpeg_log_level="error", **options)
    writer.send(None)
    for frame in frames:
        writer.send(frame.tobytes())
    writer.close()


def _frame(
    scene: Scene, plot: np.ndarray, box: tuple[int, int, int, int], halves: list[np.ndarray], k: int
) -> Image.Image:
    """Join both halves, their labels, and the plot below, whose future part is pale."""
    time, last = scene.times[k], max(motion.times[-1] for motion in scene.motions.values())
    left, top, right, bottom = box
    plot = plot.copy()
    future = plot[top:bottom, round(left + (right - left) * time / last) : right + 1]
    future[:] = 255 - (255 - future) // 5
    picture = Image.fromarray(np.concatenate([np.concatenate(halves, axis=1), plot]))
    draw = ImageDraw.Draw(picture, "RGBA")
    height, half, _ = halves[0].shape
    for i, (label, motion) in enumerate(scene.motions.items()):
        _text(draw, (i * half + 12, 12), label, COLOURS[i])
        if time >= motion.fall_time:
            _text(draw, (i * half + 12, 40), f"fell at {motion.fall_time:.2f} s", COLOURS[0])
    draw.rectangle((half - 1, 0, half, height - 1), fill="white")
    _text(draw, (picture.width - 12, height - 12), f"{time:.1f} s", size=14, anchor="rb")
    _text(draw, (picture.width - 12, 12), "dashed: reference", size=14, anchor="rt")
    return picture


def _strip(scene: Scene, columns: list[list[np.ndarray]]) -> Image.Image:
    """Join snapshots, one row per walk."""
    picture = Image.fromarray(np.concatenate([np.concatenate(c) for c in columns], axis=1))
    draw = ImageDraw.Draw(picture, "RGBA")
    height, width, _ = columns[0][0].shape
    for i, label in enumerate(scene.motions):
        _text(draw, (12, i * height + 12), label, COLOURS[i])
        for k, time in enumerate(scene.times, 1):
            place = (width * k - 10, height * (i + 1) - 10)
            _text(draw, place, f"{time:.2f} s", size=14, anchor="rb")
    for k in range(1, len(columns)):
        draw.rectangle((width * k - 1, 0, width * k, picture.height), fill="white")
    draw.rectangle((0, height - 1, picture.width, height), fill="white")
    return picture


def _text(
    draw: ImageDraw.ImageDraw,
    place: tuple[int, int],
    text: str,
    colour: tuple[int, int, int] | None = None,
    *,
    size: int = 16,
    anchor: str = "lt",
) -> None:
    """Write text on a light plate, with a mark in the colour of the walk that it names."""
    font = ImageFont.load_default(size=size)
    left, top, right, bottom = draw.textbbox(place, text, font, anchor)
    mark = 0 if colour is None else size
    plate = (left - 5, top - 5, right + 5 + mark, bottom + 5)
    draw.rounded_rectangle(plate, 4, fill=(255, 255, 255, 205))
    if colour is not None:
        draw.rounded_rectangle((left, top, left + size - 5, bottom), 2, fill=colour)
    draw.text((place[0] + mark, place[1]), text, INK, font, anchor)
