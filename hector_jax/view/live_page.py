"""The page of a live walk: robots, what they are at, and all that a person can turn.

All clients see one page. What they click or move is done in turn by the loop of `serve_live`; the
robots walk in another process (`sim.live`). Weights are moved as a tuning moves them, by their
logarithms and with one weight for all feet.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from itertools import count
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

import numpy as np
from jaxtyping import Float

from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import FEET, SOLVED
from hector_jax.report.plots.style import rgb_of
from hector_jax.robot.model import compile_model
from hector_jax.sim.live import LATE, PUSH_TIME, WINDOW, Frame, Now, Walked
from hector_jax.sim.world import MAX_DELAY, WORLDS, named_world
from hector_jax.tuning.difftune import TuneState
from hector_jax.tuning.live import Work, take_step, what_matters
from hector_jax.view import page_parts as parts
from hector_jax.view.live_weights import PageSetup, WeightsPanel
from hector_jax.view.motion import INK

_FRAME = 1.0 / 30.0  # [s]
_PAUSE = 8  # frames between two of which the numbers are shown
_STRIP = 10.0  # [s] of the errors that are drawn
_SLOW = 0.95  # share of the wanted speed below which the machine is too slow
_LOADED = 0.05  # share of the weight on a foot that is worth showing
_FORCES = {"planned": (25, 25, 30), "measured": (240, 120, 20)}  # colours of arrows
_SIDES = {"from behind": (1, 0, 0), "from ahead": (-1, 0, 0), "from the right": (0, 1, 0)}
_SIDES |= {"from the left": (0, -1, 0)}
NUMBERS = {  # sliders of command and plant: label, least, largest value, step
    "ahead": ("ahead [m/s]", -1.0, 1.0, 0.05),
    "aside": ("to the left [m/s]", -0.4, 0.4, 0.05),
    "turn": ("turn left [rad/s]", -1.6, 1.6, 0.05),
    "mass": ("mass [times its own]", 0.7, 1.3, 0.01),
    "floor_friction": ("friction of the floor", 0.1, 1.2, 0.01),
    "delay": ("delay of the motors [s]", 0.0, MAX_DELAY, 1e-4),
    "payload": ("payload on the trunk [kg]", 0.0, 10.0, 0.1),
}
_COMMAND = {"ahead": 0.5, "aside": 0.0, "turn": 0.0}  # at the start
_PLANT = "mass", "floor_friction", "delay"  # those in `Imperfections`


def serve_live(server: Any, setup: PageSetup, connection: Connection, pool: Executor) -> None:
    """Show frames and do what clients want until interrupted; a process of the pool tunes."""
    page, due = LivePage(server, setup, connection, pool), time.monotonic()
    while True:
        connection.send(("frame", ()))
        while not isinstance(message := connection.recv(), Frame):
            page.tune(message)
        page.show(message)
        page.work()
        now = time.monotonic()
        due = max(due + _FRAME, now - LATE)
        time.sleep(max(due - now, 0.0))


class LivePage:
    """The page in the browser."""

    def __init__(self, server: Any, setup: PageSetup, connection: Connection, pool: Any) -> None:
        """Build the page on a `viser.ViserServer`; other arguments as in `serve_live`."""
        self._server, self._setup, self._pool = server, setup, pool
        self._send = lambda name, *values: connection.send((name, values))
        self._calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._names, self._frames = list(setup.sets), count()
        self._strip = deque[tuple[float, ...]]()  # see `_note`
        self._states: dict[int, TuneState] = {}  # of the tuner, by number of the set
        self._job: Future[Any] | None = None  # what is computed, of the last that was asked for
        self._at, self._drawn = dict(setup.at), {}  # values of `NUMBERS`, world and seed, if moved
        self._status = server.gui.add_markdown("")
        self._add_errors()
        self._weights = WeightsPanel(server.gui, self._when, setup, self._send, self._line)
        self._add_tuning()
        self._add_walk()
        self._add_plant()
        self._build_world()

    def work(self) -> None:
        """Do what clients have wanted since, and show what a tuning found."""
        while not self._calls.empty():
            self._calls.get()()
        if self._job is not None and self._job.done():
            job, self._job = self._job, None
            if isinstance(error := job.exception(), InputError):
                self._found.content = str(error)
                return
            i = self._wanted[1]
            self._states[i], weights, self._found.content = job.result()
            if weights is not None:
                self._weights.set(i, weights)

    def _when(self, handle: Any, do: Callable[..., None]) -> Any:
        """Let `do` be called, by the loop, with what a client chose of a handle."""
        event = handle.on_click if hasattr(handle, "on_click") else handle.on_update

        def by_client(event: Any) -> None:
            if event.client is not None:  # the page moves its sliders too
                self._calls.put(partial(do, getattr(event.target, "value", None)))

        event(by_client)
        return handle

    def _line(self, files: Sequence[str]) -> str:
        """Return how a client repeats this page with files, in Markdown."""
        at = tuple(f"{name}={value}" for name, value in self._at.items())
        line = self._setup.line(weights=tuple(files), at=at, **self._drawn)
        return f"Saved. This repeats it:\n\n```\n{line}\n```"

    # The panel

    def _add_sliders(self, start: Mapping[str, float], do: Callable[..., None]) -> dict[str, Any]:
        """Add sliders of `NUMBERS` by their values at the start, which call `do` when moved."""
        add = self._server.gui.add_slider
        at = {name: self._at.get(name, value) for name, value in start.items()}
        return {name: self._when(add(*NUMBERS[name], value), do) for name, value in at.items()}

    def _add_walk(self) -> None:
        gui, when, send = self._server.gui, self._when, self._send

        def pace(_: Any) -> None:
            send("set_speed", speed.value * (run.label == "Stop"))

        def stop(_: Any) -> None:
            run.label = "Go on" if run.label == "Stop" else "Stop"
            pace(None)

        def command(_: Any) -> None:
            self._at |= {name: slider.value for name, slider in velocity.items()}
            send("set_velocity", *(self._at[name] for name in _COMMAND))

        with gui.add_folder("Walk"):
            run = when(gui.add_button("Stop"), stop)
            when(gui.add_button("Reset: stand at the start again"), lambda _: send("reset"))
            speed = when(gui.add_slider("speed [real time]", 0.1, 2.0, 0.1, 1.0), pace)
            velocity = self._add_sliders(_COMMAND, command)
            newtons = gui.add_slider("push [N]", 10.0, 400.0, 10.0, 60.0)
            sides = gui.add_button_group(f"push {PUSH_TIME:g} s", list(_SIDES))
            when(sides, lambda side: send("push", newtons.value * np.array(_SIDES[side])))
        if self._at.keys() & velocity:
            command(None)

    def _add_errors(self) -> None:
        gui = self._server.gui
        gui.add_markdown(
            "Forces of the ground: black as planned, orange as measured; they end inside the "
            "friction cone of the floor, or the foot slips."
        )
        with gui.add_folder(f"Errors, RMS of the last {WINDOW:g} s"):
            self._table = gui.add_markdown("")
            empty = {name: np.full(1, np.nan) for name in self._names}
            titles = "off its reference, in the plane [cm]", "roll and pitch together [degrees]"
            self._plots = [parts.plot(gui, x, "time [s]", np.zeros(1), empty) for x in titles]

    def _add_tuning(self) -> None:
        gui, when = self._server.gui, self._when
        with gui.add_folder("Tuning"):
            step = gui.add_button("Tune from here: one Gauss-Newton step")
            when(step, lambda _: self._ask(take_step))
            matter = gui.add_button("Which weights matter in this walk?")
            when(matter, lambda _: self._ask(what_matters))
            self._found = gui.add_markdown("")

    def _add_plant(self) -> None:
        gui, setup, send = self._server.gui, self._setup, self._send
        self._plant = named_world(setup.world, setup.seed, setup.robot.description)
        of_world = {name: float(getattr(self._plant, name)) for name in _PLANT}

        def draw(_: Any) -> None:
            self._drawn = {"world": world.value, "seed": int(seed.value)}
            self._plant = named_world(world.value, int(seed.value), setup.robot.description)
            for name in _PLANT:
                self._at.pop(name, None)
                numbers[name].value = float(getattr(self._plant, name))
            send("set_world", self._plant, int(seed.value))

        def change(_: Any) -> None:
            self._at |= {name: slider.value for name, slider in numbers.items()}
            self._plant = self._plant._replace(**{n: np.asarray(self._at[n]) for n in _PLANT})
            send("set_numbers", self._plant, self._at["payload"])

        with gui.add_folder("Plant", expand_by_default=False):
            worlds = gui.add_dropdown("world", WORLDS, initial_value=setup.world)
            world = self._when(worlds, draw)
            seed = self._when(gui.add_number("seed", setup.seed, min=0, step=1), draw)
            numbers = self._add_sliders(of_world | {"payload": 0.0}, change)
        if self._at.keys() & numbers:
            change(None)

    # Tuning

    def _ask(self, work: Work) -> None:
        if self._job is None:
            self._wanted = work, self._weights.chosen
            self._found.content = "computing, the first time on a machine for a minute ..."
            self._send("log", self._weights.chosen)

    def tune(self, walked: Walked | str) -> None:
        """Compute what a client asked for from a walk, or show why that cannot be."""
        if isinstance(walked, str):
            self._found.content = f"Not yet: {walked}."
        elif self._job is None:
            work, i = self._wanted
            self._job = self._pool.submit(work, self._setup.robot, self._states.get(i), walked)

    # The scene

    def _build_world(self) -> None:
        scene, robot = self._server.scene, self._setup.robot
        height, feet = float(robot.standing_height), range(len(robot.foot_point))
        model, edges = compile_model(robot.description), np.zeros((8, 2, 3), np.float32)
        parts.lay_out(self._server, height)
        distance = parts.DISTANCE * height
        (self._world, self._floor), self._handles = parts.add_floor(scene), []
        for i, (name, colour) in enumerate(zip(self._names, rgb_of(self._names), strict=True)):
            root, across = f"/world/{i}", distance * ((len(self._names) - 1) / 2 - i)
            scene.add_frame(root, show_axes=False, position=(0.0, across, 0.0))
            # a label that moves lags behind: the robots stay near it, while the world moves
            parts.add_label(scene, f"/name{i}", name).position = (0.0, across, 2.0 * height)
            # each foot has arrows and a cone, from the origin of their own frames
            handles: dict[str, Any] = {
                kind: [parts.add_arrows(scene, f"{root}/{kind}{f}", shade, height) for f in feet]
                for kind, shade in _FORCES.items()
            }
            add, shade = scene.add_line_segments, _FORCES["measured"]
            handles["cones"] = [add(f"{root}/cone{f}", edges, shade, thickness=0.004) for f in feet]
            handles["bodies"] = parts.Bodies(scene, root, model, colour)
            handles["aim"] = scene.add_icosphere(f"{root}/aim", 0.018, INK)
            self._handles.append(handles)

    def show(self, frame: Frame) -> None:
        """Show a frame; numbers and errors over time in some of them."""
        aim = frame.walks[0].reference * [1.0, 1.0, 0.0]
        with self._server.atomic():
            self._world.position, self._floor.position = -aim, 5.0 * np.round(aim / 5.0)
            for now, handles in zip(frame.walks, self._handles, strict=True):
                self._draw(now, handles)
        self._note(frame.walks)
        if next(self._frames) % _PAUSE == 0:
            self._show_numbers(frame)

    def _note(self, walks: Sequence[Now]) -> None:
        """Add to the strip the time, and the errors in the plane and of roll and pitch together."""
        pairs = np.reshape([now.error for now in walks], (-1, 2, 3))[..., :2]
        off = np.linalg.norm(pairs, axis=2).T.ravel()
        # with a NaN the page draws no line at all: a set that fell before its path began has zero
        row = max(now.time for now in walks), *np.nan_to_num(off)
        last = self._strip[-1][0] if self._strip else -np.inf
        if row[0] < last:
            self._strip.clear()  # after a reset
        elif row[0] > last and np.isfinite(off).any():  # before the path begins there is no error
            self._strip.append(row)
            while self._strip[0][0] < row[0] - _STRIP:
                self._strip.popleft()

    def _draw(self, now: Now, handles: dict[str, Any]) -> None:
        robot = self._setup.robot
        weight = float(robot.mass * robot.gravity[2])
        scale = parts.WEIGHT * float(robot.standing_height) / weight
        cone = _cone_edges(float(self._plant.floor_friction))
        kinds = {"planned": now.planned, "measured": now.measured, "cones": now.measured}
        for kind, forces in kinds.items():
            for handle, foot, force in zip(handles[kind], now.feet, scale * forces, strict=True):
                handle.position, handle.visible = foot, bool(force[2] > _LOADED * scale * weight)
                if handle.visible:
                    arrow = np.stack([np.zeros(3), force])[None]
                    points = force[2] * cone if kind == "cones" else arrow
                    handle.points = points.astype(np.float32)
        handles["bodies"].move(now.pose)
        handles["aim"].position = now.reference

    def _show_numbers(self, frame: Frame) -> None:
        lines = [f"Real-time factor {frame.factor:.2f}" if frame.wanted else "Stopped."]
        if frame.factor < _SLOW * frame.wanted:
            lines[0] += f": **this machine is too slow** for speed {frame.wanted:g}"
        rows = ["| | x, y, z [cm] | roll, pitch, yaw [°] |", "|---|---|---|"]
        for name, now, first in zip(self._names, frame.walks, frame.starts, strict=True):
            lines.append(f"**{name}**: {self._state_text(now)}")
            rows.append(_row(f"**{name}** now", now.errors))
            if first is not None:
                rows.append(_row(f"{name} at the start", first))
        self._status.content, self._table.content = "\n\n".join(lines), "\n".join(rows)
        if len(self._strip) > 1:
            times, *off = np.transpose(self._strip)
            for k, handle in enumerate(self._plots):
                handle.data = (times, *off[k * len(self._names) :][: len(self._names)])

    def _state_text(self, now: Now) -> str:
        if now.fall:
            return f"{now.fall}. Reset lets it stand again."
        mu, robot, text = float(self._plant.floor_friction), self._setup.robot, []
        for foot, force in zip(FEET[len(now.measured)], now.measured, strict=True):
            if force[2] > _LOADED * float(robot.mass * robot.gravity[2]):
                share = 100.0 * np.abs(force[:2]).sum() / (mu * force[2])  # the cone is a diamond
                words = foot.replace("_", " ")
                text.append(f"{words} {force[2]:.0f} N, {share:.0f} % of friction")
        solved = now.residual <= SOLVED
        qp = "QP solved" if solved else f"**QP not solved**, residual {now.residual:.0e}"
        return f"{now.time:.1f} s; {qp}; " + ("; ".join(text) or "in the air")


def _cone_edges(mu: float) -> Float[np.ndarray, "8 2 3"]:
    """Return the edges of the cone |F_x| + |F_y| <= mu F_z up to F_z = 1: four up, four around."""
    rim = np.array([[mu, 0.0, 1.0], [0.0, mu, 1.0], [-mu, 0.0, 1.0], [0.0, -mu, 1.0]], np.float32)
    sides = np.stack([np.zeros_like(rim), rim], axis=1)
    return np.concatenate([sides, np.stack([rim, np.roll(rim, -1, axis=0)], axis=1)])


def _row(name: str, errors: Float[np.ndarray, "6"]) -> str:
    x, y, z, *angles = (f"{e:.1f}" if np.isfinite(e) else "-" for e in errors)
    return f"| {name} | {x}, {y}, {z} | {', '.join(angles)} |"
