"""Two walks of one command side by side: a film, and a strip of snapshots.

The camera goes beside the reference. Both halves have the same one and, as each walk is shown in
the frame of its start, the same reference. MuJoCo chooses its OpenGL back end when it is imported,
and a broken back end may kill its process. So child processes (render.py) try the back ends in
turn: EGL, OSMesa, GLFW, or only that of MUJOCO_GL if it is set. If none can draw,
`VideoUnavailable` gives the reason in one line, and the run goes on without a film.
"""

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import imageio_ffmpeg
import numpy as np
from jaxtyping import Float

from hector_jax.core.console import Broken
from hector_jax.core.files import write_file
from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError, one_line
from hector_jax.core.settings import AT_LEAST_ONE, Range, check, choose
from hector_jax.report.plots.style import label_of, rgb_of
from hector_jax.robot.model import Robot, compile_model
from hector_jax.view.motion import Motion

BACK_ENDS = ("egl", "osmesa", "glfw")
ENDINGS = (".mp4", ".webp", ".gif", ".png")  # all but the first are animated pictures

_TIMEOUT = 300.0  # [s] for a back end to draw the whole film and its strip


class VideoUnavailable(Broken):
    """Error of a machine that cannot make a film; the message gives the reason in one line."""


@dataclass(frozen=True)
class VideoConfig:
    """Size and frame rate of a film."""

    width: int = 800  # [pixel], both halves together
    height: int = 540  # a quarter of it is the plot below
    rate: int = 20  # frames per second
    tiles: int = 6  # pictures in a row of the strip

    def __post_init__(self) -> None:
        size = Range(64, 8192)
        check(self, width=size, height=size, rate=AT_LEAST_ONE, tiles=AT_LEAST_ONE)
        for name, value in (("width", self.width), ("height", self.height)):
            if value % 4:
                raise InputError(f"VideoConfig.{name} must be a multiple of 4, got {value}")


class Scene(NamedTuple):
    """Inputs of the child process, which draws into its working directory."""

    file: str  # name of the film or strip
    strip: bool
    config: VideoConfig
    model: mujoco.MjModel  # of the robot
    motions: dict[str, Motion]  # before and after, by title
    colours: list[tuple[int, int, int]]  # of the motions
    times: Float[np.ndarray, " K"]  # of the frames [s]


def check_film(path: Path) -> None:
    """Check, before the walks of a film, that it can be written to this path.

    Raises:
        InputError: the ending is none of `ENDINGS`, or MUJOCO_GL names no back end.
    """
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"a film must end in {', '.join(ENDINGS)}, got {path.name}")
    if back_end := os.environ.get("MUJOCO_GL"):
        choose("MUJOCO_GL", back_end.lower(), (*BACK_ENDS, "disable"))


def write_film(
    path: Path,
    robot: Robot,
    motions: Mapping[str, Motion],
    config: VideoConfig | None = None,
    *,
    strip: Path | None = None,
) -> str:
    """Draw two walks side by side, and below them their distance from the reference.

    Args:
        path: film (.mp4), or animated picture that repeats (.webp, .gif, .png); see `check_film`.
        robot: the body that walked.
        motions: two of one command by set or title, before and after.
        config: size and rate.
        strip: PNG for their strip of snapshots, see `write_strip`, drawn by the same process.

    Returns:
        The back end that drew it.

    Raises:
        VideoUnavailable: no back end works on this machine, or there is no encoder.
    """
    if path.suffix.lower() == ".mp4":
        try:
            imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError as error:
            raise VideoUnavailable(f"no film: no video encoder ({one_line(error)})") from None
    files, config = {path: False} | ({strip: True} if strip else {}), config or VideoConfig()
    return _write({x: make_scene(x, robot, motions, config, strip=y) for x, y in files.items()})


def write_strip(
    path: Path, robot: Robot, motions: Mapping[str, Motion], config: VideoConfig | None = None
) -> str:
    """Draw snapshots of walks, a row for each, spread over the phases of a gait cycle.

    Args, returns and raises as `write_film`; the path is that of a PNG, and there may be one walk.
    """
    return _write({path: make_scene(path, robot, motions, config or VideoConfig(), strip=True)})


def make_scene(
    path: Path, robot: Robot, motions: Mapping[str, Motion], config: VideoConfig, *, strip: bool
) -> Scene:
    """Collect the inputs of a film or a strip; arguments as in `write_film`."""
    if not strip and len(motions) != 2:
        raise ValueError(f"a film shows two walks side by side, got {len(motions)}: {[*motions]}")
    seconds = min(float(motion.times[-1]) for motion in motions.values())
    times = np.arange(0.0, seconds + 1e-9, 1.0 / config.rate)
    if strip:
        times = _snapshot_times(next(iter(motions.values())), seconds, config.tiles)
    return Scene(
        file=f"{'strip' if strip else 'drawn'}{path.suffix.lower()}",
        strip=strip,
        config=config,
        model=compile_model(robot.description),
        motions={label_of(name): motion for name, motion in motions.items()},
        colours=rgb_of(motions),
        times=times,
    )


def _snapshot_times(motion: Motion, seconds: float, tiles: int) -> Float[np.ndarray, " tiles"]:
    """Return times [s] of snapshots, whose phase of the gait cycle increases by 1/tiles each."""
    stance = motion.contact[:, 0]
    touchdowns = np.flatnonzero(stance[1:] & ~stance[:-1]) * motion.period
    cycle = min(seconds, np.median(np.diff(touchdowns)) if len(touchdowns) > 1 else seconds)
    cycles = np.floor(np.linspace(0.0, seconds / cycle - 1.0, tiles) + 1e-6)
    return cycle * (cycles + np.arange(tiles) / tiles)


def _write(scenes: Mapping[Path, Scene]) -> str:
    """Draw scenes in one process with the first back end that works; return its name."""
    with tempfile.TemporaryDirectory(prefix="hector-film-") as name:
        folder, failures = Path(name), []
        (folder / "scenes.pickle").write_bytes(pickle.dumps(list(scenes.values())))
        setting = os.environ.get("MUJOCO_GL")
        for back_end in (setting,) if setting else BACK_ENDS:
            failure = _draw_in_child(folder, back_end)
            if not failure:
                for path, scene in scenes.items():
                    write_file(path, (folder / scene.file).read_bytes())
                return back_end
            failures.append(f"{back_end}: {failure}")
    raise VideoUnavailable(f"no film: MuJoCo cannot draw here ({'; '.join(failures)})")


def _draw_in_child(folder: Path, back_end: str) -> str:
    """Draw scenes.pickle of a folder with one back end; return why it failed, or ""."""
    # the child imports this copy of the package
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"MUJOCO_GL": back_end, "PYTHONPATH": os.pathsep.join(paths)}
    environment.pop("PYOPENGL_PLATFORM", None)  # PyOpenGL's default follows MuJoCo's choice
    # import MuJoCo first, with this back end; the package would import it without one
    program = f"import mujoco; from {__package__} import render; render.main()"
    try:
        child = subprocess.run(
            [sys.executable, "-c", program],
            cwd=folder,  # where MuJoCo writes its log
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"not done after {_TIMEOUT:.0f} s"
    if child.returncode == 0:
        return ""
    if child.returncode == -signal.SIGINT:  # Ctrl-C reaches the child too
        raise KeyboardInterrupt
    # the error of the first traceback; later ones come from resources that it left open
    first = child.stderr.split("Traceback (most recent call last):")[:2][-1]
    errors = [line for line in first.splitlines() if line.strip() and line[0] != " "]
    return one_line(errors[0])[:100] if errors else f"ended with code {child.returncode}"
