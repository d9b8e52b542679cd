"""The child process of a film: draws each `video.Scene` with MuJoCo and writes the film or strip.

It runs in a folder with `scenes.pickle`.
"""

import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from hector_jax.core.headless import mujoco
from hector_jax.report.plots import style
from hector_jax.view.motion import INK, Motion
from hector_jax.view.video import Scene

_SAMPLE = 0.02  # [s] between the points of the lines on the floor
_DASH = 4  # points of a dash
_DOWN, _ASIDE = 8.0, 68.0  # [deg] of the camera, against the horizon and the heading
_ROOM = np.array([1.1, 1.2])  # of the image, across and up, in reaches of the robot
_SMOOTH = 0.8  # [s] over which the camera's heading is a mean
_FAR = 0.25  # distance from the reference at which the camera goes along, in heights of the robot
_LAST = 1500  # [ms] of the last frame of an animated picture, before it repeats


def main() -> None:
    """Draw scenes.pickle of the working directory."""
    for scene in pickle.loads(Path("scenes.pickle").read_bytes()):
        _draw(scene)


def _draw(scene: Scene) -> None:
    width, height = scene.config.width, scene.config.height
    views = _views(scene, 3 * width // 10 if scene.strip else width // 2, 3 * height // 4)
    if scene.strip:
        _strip(scene, list(views)).save(scene.file)
    else:
        box = _save_distances(Path("plot.png"), scene.motions, width, height // 4)
        plot = np.asarray(Image.open("plot.png").convert("RGB"))
        frames = (_frame(scene, plot, box, halves, k) for k, halves in enumerate(views))
        _encode(scene.file, frames, (width, height), scene.config.rate)


def _save_distances(
    path: Path, motions: Mapping[str, Motion], width: int, height: int
) -> tuple[int, int, int, int]:
    """Draw the distance from the reference in the plane by time, for the lower part of a film.

    Args:
        path: file to write.
        motions: two motions by title, before and after.
        width: width of the picture [pixel].
        height: height of the picture [pixel].

    Returns:
        Left, top, right and bottom of the axes in the picture [pixel].
    """
    dpi = height / 1.2  # the figure is always 1.2 inches high
    last = max(motion.times[-1] for motion in motions.values())
    with style.drawing(path, width / dpi, height / dpi, dpi=dpi, legend_columns=0) as figure:
        axes = figure.subplots()
        colours = style.rgb_of(motions)
        for (name, motion), colour in zip(motions.items(), colours, strict=True):
            upright = motion.times <= motion.fall_time
            distance = np.where(upright, 100 * motion.distance, np.nan)
            rms = "fell at once"
            if upright.any():
                rms = f"{np.sqrt(np.mean(distance[upright] ** 2)):.1f} cm RMS"
            line = {"color": np.divide(colour, 255), "linewidth": 2.2}
            axes.plot(motion.times, distance, **line, label=f"{style.label_of(name)}: {rms}")
        axes.set_title("distance from the reference [cm]", loc="left")
        axes.set(xlabel="time [s]", xlim=(0.0, last), ylim=(0.0, None))
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.95), ncols=2, borderaxespad=0.1)
        figure.draw_without_rendering()
        box = axes.get_window_extent()
    return round(box.x0), round(height - box.y1), round(box.x1), round(height - box.y0)


def _views(scene: Scene, width: int, height: int) -> Iterator[list[UInt8[np.ndarray, "h w 3"]]]:
    """Render the two walks at each time of the scene."""
    model = scene.model
    data = mujoco.MjData(model)
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    quality = model.vis.quality  # a third of the time without a GPU, and no visible difference
    quality.shadowsize, quality.numslices, quality.numstacks, quality.numquads = 1024, 12, 6, 1
    accent = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MATERIAL, "accent")
    fovy = float(model.vis.global_.fovy)
    cameras = _cameras(scene, fovy, width / height)
    motions, reference = list(scene.motions.values()), _floor_reference(scene)
    with mujoco.Renderer(model, height, width) as renderer:

        def view(i: int, sample: int, camera: mujoco.MjvCamera) -> np.ndarray:
            motion, colour = motions[i], _rgba(scene.colours[i])
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
            picture = Image.fromarray(renderer.render())
            if len(motions) > 1:
                project = partial(_project, camera, fovy, picture.size)
                _mark(picture, motion, sample, project, scene.colours[i])
            return np.asarray(picture)

        samples = np.stack([motion.sample_at(scene.times) for motion in motions], axis=1)
        for pair, views in zip(samples, cameras, strict=True):
            inputs = zip(pair, views, strict=True)
            yield [view(i, sample, camera) for i, (sample, camera) in enumerate(inputs)]


def _mark(
    picture: Image.Image,
    motion: Motion,
    sample: int,
    project: Callable[[Float[np.ndarray, "3"]], tuple[float, float]],
    colour: tuple[int, int, int],
) -> None:
    """Draw a cross where the centre of mass should be, and a dot where it is."""
    draw = ImageDraw.Draw(picture, "RGBA")
    x, y = project(motion.reference[sample])
    u, v = project(motion.path[min(sample, max(motion.upright - 1, 0))])
    size = picture.height / 24
    for width, fill in ((7, (*INK, 255)), (3, (255, 255, 255, 255))):
        draw.line((x - size, y, x + size, y), fill=fill, width=width)
        draw.line((x, y - size, x, y + size), fill=fill, width=width)
    radius = picture.height / 50
    box = (u - radius, v - radius, u + radius, v + radius)
    draw.ellipse(box, fill=(*colour, 255), outline=(255, 255, 255, 255), width=2)


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


def _cameras(scene: Scene, fovy: float, aspect: float) -> list[list[mujoco.MjvCamera]]:
    """Place a camera beside the robot for each time and walk, so that the robot fills the image.

    It goes along with the reference and turns with the smoothed heading, so that both walks are
    seen alike, and stops where a robot fell.
    """
    across, top = _extent(scene)
    reach = _ROOM * [across, top / 2]
    slopes = np.tan(np.deg2rad(fovy) / 2) * np.array([aspect, 1.0])  # of the edges of the image
    distance = float(np.max(reach / slopes))
    last = list(scene.motions.values())[-1]
    ahead = last.R_yaw[:, :, 0]
    count = min(len(ahead), round(_SMOOTH / last.period))
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    padded = np.pad(yaw, (count // 2, count - 1 - count // 2), mode="edge")
    azimuths = np.rad2deg(np.convolve(padded, np.full(count, 1 / count), "valid")) + _ASIDE
    cameras = []
    for time in scene.times:
        pair = []
        for motion in scene.motions.values():
            seen = min(time, motion.fall_time)
            sample = motion.sample_at(np.array(seen))
            place = motion.reference[sample, :2]
            off = motion.path[sample, :2] - place
            far = np.linalg.norm(off)  # a robot far from its reference stays in view
            place = place + off * max(0.0, 1.0 - _FAR * top / max(far, 1e-9))
            camera = mujoco.MjvCamera()
            camera.lookat[:] = [*place, top / 2]
            camera.distance = distance
            camera.azimuth, camera.elevation = azimuths[last.sample_at(np.array(seen))], -_DOWN
            pair.append(camera)
        cameras.append(pair)
    return cameras


def _extent(scene: Scene) -> tuple[float, float]:
    """Return how far the robots' first poses reach from their middle, and their height [m]."""
    data, model, reach = mujoco.MjData(scene.model), scene.model, []
    for motion in scene.motions.values():
        data.qpos[:] = motion.qpos[0]
        mujoco.mj_forward(model, data)
        R = data.geom_xmat.reshape(-1, 3, 3)
        middle = data.geom_xpos + np.einsum("gij,gj->gi", R, model.geom_aabb[:, :3])
        half = np.einsum("gij,gj->gi", np.abs(R), model.geom_aabb[:, 3:])
        middle[:, :2] -= motion.path[0, :2]
        body = model.geom_bodyid > 0
        reach.append((np.abs(middle) + half)[body].max(axis=0))
    x, y, z = np.max(reach, axis=0)
    return float(np.hypot(x, y)), float(z)


def _project(
    camera: mujoco.MjvCamera, fovy: float, size: tuple[int, int], point: Float[np.ndarray, "3"]
) -> tuple[float, float]:
    """Return the pixel of a point, from the left and the top of an image."""
    turn = [camera.azimuth - 90.0, 90.0 + camera.elevation]
    view = Rotation.from_euler("ZX", turn, degrees=True)
    right, up, back = view.apply(point - camera.lookat, inverse=True)
    width, height = size
    scale = height / 2 / np.tan(np.deg2rad(fovy) / 2) / (camera.distance - back)
    return width / 2 + scale * right, height / 2 - scale * up


def _encode(file: str, frames: Iterable[Image.Image], size: tuple[int, int], rate: int) -> None:
    options: dict[str, Any]
    if not file.endswith(".mp4"):
        first, *rest = frames
        durations = [1000 // rate] * len(rest) + [_LAST]
        first.save(
            file,
            save_all=True,
            append_images=rest,
            duration=durations,
            loop=0,
            quality=60,
            method=6,
        )
        return
    options = {"codec": "libx264", "macro_block_size": 2, "quality": None}
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
        _text(draw, (i * half + 12, 12), label, scene.colours[i], size=20)
        off = f"{100 * motion.distance[motion.sample_at(np.array(time))]:.1f} cm off"
        if time >= motion.fall_time:
            off = f"fell at {motion.fall_time:.2f} s"
        _text(draw, (i * half + half - 14, 12), off, size=20, anchor="rt")
    draw.rectangle((half - 1, 0, half, height - 1), fill="white")
    _text(draw, (picture.width - 14, height - 12), f"{time:.1f} s", anchor="rb")
    _text(draw, (12, height - 12), "cross: reference, dot: robot", anchor="lb")
    return picture


def _strip(scene: Scene, columns: list[list[np.ndarray]]) -> Image.Image:
    """Join snapshots, one row per walk."""
    picture = Image.fromarray(np.concatenate([np.concatenate(c) for c in columns], axis=1))
    draw = ImageDraw.Draw(picture, "RGBA")
    height, width, _ = columns[0][0].shape
    for i, label in enumerate(scene.motions):
        _text(draw, (12, i * height + 12), label, scene.colours[i])
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
