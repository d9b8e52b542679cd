"""A run on a local web page: two walks side by side, ground forces, and the tuning in progress.

Each displayed tick is one batch of updates. The walks are side by side, shifted across their
heading. To follow them the world moves under the camera, so that the user can still turn the
camera. The page is drawn by viser, of the extra `view`, loads nothing from other machines and
answers no page of theirs.
"""

import errno
import logging
import os
import re
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Trajectory, Wrench
from hector_jax.report.plots.style import rgb_of
from hector_jax.report.report import render
from hector_jax.store.run import METRICS, Run, loss_curves, progress_sentence
from hector_jax.view import page_parts as parts
from hector_jax.view.motion import INK, Motion

_RATE = 30.0  # displayed ticks per second, at most
_PAUSE = 1.0  # [s] between readings of the metrics
# Lengths in the scene, as shares of the robot's standing height.
_MIN_ARROW = 0.07  # shorter ones are not drawn
_RADII = {"force": 0.019, "moment": 0.033}  # of the shafts of arrows
_LEVER = 0.24  # of the moment that is drawn as long as the weight: the weight at this lever
_NO_CURVES = {"no iteration yet": np.full(1, np.nan)}  # viser refuses a plot without a line


class _Source(NamedTuple):
    """Appearance of the wrenches of one source."""

    words: str
    colour: tuple[int, int, int]
    offset: float  # outwards from the foot point, so that legs and arrows stay visible; see above


_SOURCES = {
    "commanded": _Source("commanded", (25, 25, 30), 0.14),
    "measured": _Source("measured", (240, 120, 20), 0.21),
    "predicted": _Source("predicted by the net", (80, 170, 255), 0.29),
}


class ViewedWalk(NamedTuple):
    """One walk, at the plan interval."""

    walk: Trajectory
    ground: dict[str, Wrench]  # some of commanded, measured, predicted; (T, feet, 3), yaw frame


def arrows(motion: Motion, kind: str, source: str) -> Float[np.ndarray, "T feet 2 3"]:
    """Return start and end of the arrow at each foot.

    Args:
        motion: motion with wrenches of this source.
        kind: force or moment.
        source: commanded, measured or predicted.
    """
    scale = parts.WEIGHT * motion.height / motion.weight
    scale /= {"force": 1.0, "moment": _LEVER * motion.height}[kind]
    left = motion.R_yaw[:, :, 1]
    pairs = motion.feet.shape[1] // 2
    outwards = np.stack([left, -left] * pairs, axis=1)  # each pair is left, right
    start = motion.feet + _SOURCES[source].offset * motion.height * outwards
    return np.stack([start, start + scale * getattr(motion.wrenches[source], kind)], axis=2)


def serve(
    walk: Callable[[], tuple[Mapping[str, Motion], str]],
    model: mujoco.MjModel,
    folder: Path,
    on_open: Callable[[str], None],
    *,
    host: str,
    port: int,
) -> None:
    """Show two walks and the tuning of a run until interrupted.

    Args:
        walk: called once the page can be opened; returns the motions of the walks by title, before
            and after, and their description in Markdown.
        model: model of the robot.
        folder: folder of the run, whose metrics are read again as they grow.
        on_open: called with the page's address once it can be opened.
        host: address to listen on.
        port: port to listen on; if it is in use, a free one.

    Raises:
        InputError: the server cannot listen on the address.
    """
    with opened_server(host, port) as (server, address):
        note = server.gui.add_markdown("The robots walk in a moment.")
        on_open(address)
        motions, description = walk()
        note.remove()
        page = Page(server, motions, model, folder, description)
        last = time.monotonic()
        while True:
            time.sleep(1.0 / _RATE)
            now = time.monotonic()
            page.advance(now - last)
            last = now


@contextmanager
def opened_server(host: str, port: int) -> Iterator[tuple[Any, str]]:
    """Open a `viser.ViserServer`, see `serve`; yields it with the page's address."""
    # a browser that disconnects early would print a traceback
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    # viser prints the address itself
    with Path(os.devnull).open("w") as null, redirect_stdout(null):
        server = _server(host, _free_port(host, port))
        try:
            yield server, f"http://{_in_url(host)}:{server.get_port()}"
        finally:
            server.stop()


def _server(host: str, port: int) -> Any:
    """Return a `viser.ViserServer` that only its own page can reach, and that opens no tunnel."""
    import viser
    from websockets.asyncio import server as sockets

    own = {"localhost", "127.0.0.1", "[::1]", _in_url(host)}

    def refuse(connection: Any, request: Any, response: Any) -> Any:
        """Refuse a page of another site; one of a name that is not ours may be of anybody's."""
        asked, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        pages = {f"http://{name}:{port}" for name in own}
        if host in ("0.0.0.0", "::") or re.sub(r":\d+$", "", asked) in own:
            pages.add(f"http://{asked}")  # also through a tunnel from another port
        foreign = origin is not None and origin not in pages
        return connection.respond(HTTPStatus.FORBIDDEN, "of another site\n") if foreign else None

    serve = sockets.serve  # viser passes no check on
    sockets.serve = partial(serve, process_response=refuse)
    try:
        server = viser.ViserServer(host, port, label="hector", verbose=False)
    finally:
        sockets.serve = serve
    server.request_share_url = lambda verbose=True: None  # any client can call it
    return server


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _free_port(host: str, port: int) -> int:
    """Return the port, or a free one if it is in use."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host, port), family=family) as listener:
            return listener.getsockname()[1]
    except OSError as error:
        if error.errno == errno.EADDRINUSE and port:
            return _free_port(host, 0)
        raise InputError(f"cannot listen on {host}, port {port}: {error.strerror}") from None


class Page:
    """The page in the browser, with its playback."""

    def __init__(
        self,
        server: Any,
        motions: Mapping[str, Motion],
        model: mujoco.MjModel,
        folder: Path,
        description: str,
    ) -> None:
        """Build the page on a `viser.ViserServer`; other arguments as in `serve`."""
        self._server, self._folder = server, folder
        self._model = model
        self._names, self._motions = list(motions), list(motions.values())
        self._length = min(len(motion.times) for motion in self._motions)
        self._playing, self._tick = True, -1  # displayed tick; -1: draw again
        self._metrics_state = (-1, False)  # size of the metrics when last read; tuning finished
        self._since = np.inf  # [s] since that reading
        self._build_panel(description)
        self._build_world()
        self.advance(0.0)

    def advance(self, elapsed: float) -> None:
        """Advance by `elapsed` [s]: move the robots if playing, read the metrics periodically."""
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
            self._read_metrics()

    def _build_panel(self, description: str) -> None:
        gui, first = self._server.gui, self._motions[0]
        times = first.times[: self._length]
        gui.add_markdown(description)
        with gui.add_folder("Playback"):
            self._button = gui.add_button("Pause")
            self._time = gui.add_slider("time [s]", 0.0, float(times[-1]), first.period, 0.0)
            self._speed = gui.add_slider("speed", 0.05, 2.0, 0.05, 0.5)
            self._follow = gui.add_checkbox("follow the robots", True)
        with gui.add_folder("Ground on the feet"):
            sources = {source: _SOURCES[source] for source in first.wrenches}
            drawn = {"weight": first.weight, "length": 100.0 * parts.WEIGHT * first.height}
            drawn |= {"sources": sources.values(), "moment": _LEVER * first.height * first.weight}
            gui.add_html(render("legend.html.j2", **drawn))
            labels = {name: source.words for name, source in sources.items()}
            labels |= {"force": "forces", "moment": "moments"}
            self._boxes = {n: gui.add_checkbox(text, n != "moment") for n, text in labels.items()}
        with gui.add_folder("Tuning"):
            self._losses = parts.plot(
                gui, "loss on the model [% of the start]", "iteration", np.zeros(1), _NO_CURVES
            )
            self._progress = gui.add_markdown("")
        with gui.add_folder("Distance from the reference"):
            lines = [100.0 * motion.distance[: self._length] for motion in self._motions]
            errors = dict(zip(self._names, lines, strict=True))
            parts.plot(gui, "in the plane [cm]", "time [s]", times, errors)
        self._button.on_click(lambda _: self._play(not self._playing))
        # pause when the user moves the slider, which `advance` also moves
        self._time.on_update(lambda event: event.client is not None and self._play(False))
        for box in (self._follow, *self._boxes.values()):
            box.on_update(lambda _: setattr(self, "_tick", -1))

    def _play(self, playing: bool) -> None:
        self._playing = playing
        self._button.label = "Pause" if playing else "Play"

    def _build_world(self) -> None:
        scene = self._server.scene
        displacement = self._motions[0].reference[-1] - self._motions[0].reference[0]
        heading = np.arctan2(displacement[1], displacement[0])
        across = np.array([-np.sin(heading), np.cos(heading), 0.0])
        height = self._motions[0].height
        parts.lay_out(self._server, height, heading)
        self._world, _ = parts.add_floor(scene)
        self._handles = []
        for i in range(len(self._motions)):
            position = (0.5 - i) * parts.DISTANCE * height * across
            scene.add_frame(f"/world/{i}", show_axes=False, position=position)
            self._handles.append(self._add_walk(i))

    def _add_walk(self, i: int) -> dict[str, Any]:
        """Add one walk to the scene; return the handles of its moving parts."""
        scene, motion, colour = self._server.scene, self._motions[i], rgb_of(self._names)[i]
        root, pale = f"/world/{i}", tuple(int(c + 0.55 * (255 - c)) for c in colour)
        lines = {  # on the floor, at different heights [m] to avoid flicker
            "footholds": (motion.soles, 0.003, pale, 0.03),
            "path": (_segments(motion.path, 2), 0.006, colour, 0.008),
            "reference": (_segments(motion.reference, 6)[::2], 0.008, INK, 0.01),
        }
        for line, (segments, height, shade, thickness) in lines.items():
            points = segments * [1.0, 1.0, 0.0] + [0.0, 0.0, height]
            scene.add_line_segments(f"{root}/{line}", points, shade, thickness=thickness)
        return {
            "aim": scene.add_icosphere(f"{root}/aim", 0.018, INK),
            "name": parts.add_label(scene, f"{root}/name", ""),
            "bodies": parts.Bodies(scene, root, self._model, colour),
            "arrows": {
                (kind, source): (self._add_arrows(root, kind, source), arrows(motion, kind, source))
                for source in motion.wrenches
                for kind in _RADII
            },
        }

    def _add_arrows(self, root: str, kind: str, source: str) -> Any:
        name, height = f"{root}/{kind}/{source}", self._motions[0].height
        scene, colour = self._server.scene, _SOURCES[source].colour
        return parts.add_arrows(scene, name, colour, height, _RADII[kind])

    def _draw(self, tick: int) -> None:
        aim = self._motions[0].reference[tick] * [1.0, 1.0, 0.0]
        self._world.position = -aim * self._follow.value
        for name, motion, handles in zip(self._names, self._motions, self._handles, strict=True):
            handles["bodies"].move(motion.qpos[tick])
            for (kind, source), (handle, ends) in handles["arrows"].items():
                length = np.linalg.norm(ends[tick, :, 1] - ends[tick, :, 0], axis=1)
                visible = length > _MIN_ARROW * motion.height  # false for NaN
                switched_on = self._boxes[kind].value and self._boxes[source].value
                handle.visible = bool(switched_on and visible.any())
                if handle.visible:
                    handle.points = ends[tick, visible].astype(np.float32)
            handles["aim"].position = motion.reference[tick]
            handles["name"].position = motion.path[tick] + [0.0, 0.0, 0.86 * motion.height]
            fell = motion.times[tick] > motion.fall_time
            handles["name"].text = f"{name}, fell at {motion.fall_time:.2f} s" if fell else name

    def _read_metrics(self) -> None:
        run = Run(self._folder)
        path, done = self._folder / METRICS, run.is_finished
        state = (path.stat().st_size if path.exists() else 0, done)
        if state == self._metrics_state:
            return
        self._metrics_state = state
        histories = run.histories
        lines = loss_curves(histories) or _NO_CURVES
        iterations = np.arange(float(len(next(iter(lines.values())))))
        with self._server.atomic():
            self._losses.series = parts.series("iteration", lines)
            self._losses.data = (iterations, *lines.values())
            self._progress.content = progress_sentence(histories, done)


def _segments(points: Float[np.ndarray, "T 3"], ticks: int) -> Float[np.ndarray, "n 2 3"]:
    """Split a path into segments of `ticks` ticks each."""
    return np.stack([points[:-ticks:ticks], points[ticks::ticks]], axis=1)
