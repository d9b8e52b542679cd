"""The page of a live walk: robots, what they are at, and all that a person can turn.

All clients see one page. What they click or move is done in turn by the loop of `serve_live`; the
robots walk in another process (`view.live`). Weights are moved as a tuning moves them, by their
logarithms and with one weight for all feet.
"""

import time
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.trajectory import FEET, SOLVED
from hector_jax.report.plots.style import rgb_of
from hector_jax.sim.live import PUSH_TIME, WINDOW, Now
from hector_jax.sim.world import MAX_DELAY, WORLDS, Imperfections, named_world
from hector_jax.view.live import Frame, Walked
from hector_jax.view.live_tuning import Tuner
from hector_jax.view.live_weights import PageSetup, WeightsPanel
from hector_jax.view.motion import INK
from hector_jax.view.page_parts import add_floor, body_meshes, plot

_STRIP = 10.0  # [s] of the errors that are drawn
_SLOW = 0.95  # share of the wanted speed below which the machine is too slow
_ARROW = 5 / 6  # length of an arrow for the robot's weight, as a share of its height
_LOADED = 0.05  # share of the weight on a foot that is worth showing
_FORCES = {"planned": (25, 25, 30), "measured": (240, 120, 20)}  # colours of arrows
_SIDES = {"from behind": (1, 0), "from ahead": (-1, 0), "from the right": (0, 1)}
_SIDES |= {"from the left": (0, -1)}


def serve_live(server: Any, setup: PageSetup, connection: Connection, tuner: Tuner) -> None:
    """Show frames and do what clients want until interrupted."""
    page = LivePage(server, setup, connection, tuner)
    while True:
        if connection.poll(0.02):
            message = connection.recv()
            if isinstance(message, Frame):
                page.show(message)
                connection.send(("taken", ()))
            else:
                page.tune(message)
        page.work()


class LivePage:
    """The page in the browser."""

    def __init__(self, server: Any, setup: PageSetup, connection: Connection, tuner: Tuner) -> None:
        """Build the page on a `viser.ViserServer`."""
        self._server, self._setup, self._tuner = server, setup, tuner
        self._send = lambda name, *values: connection.send((name, values))
        self._calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._names = list(setup.sets)
        self._plant = named_world(setup.world, setup.seed, setup.robot.description)
        self._strips = [deque[tuple[float, ...]]() for _ in self._names]
        self._data, self._next, self._moved = mujoco.MjData(setup.model), 0.0, False
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        self._status = server.gui.add_markdown("")
        self._add_walk()
        self._add_errors()
        self._weights = WeightsPanel(server.gui, self._when, setup, self._send, self._line)
        self._add_tuning()
        self._add_plant()
        self._build_world()

    def work(self) -> None:
        """Do what clients have wanted since, and show what a tuning found."""
        while not self._calls.empty():
            self._calls.get()()
        if (found := self._tuner.found()) is not None:
            self._found.content = found.text
            if found.weights is not None:
                self._weights.set(found.set, found.weights)

    def _when(self, handle: Any, do: Callable[..., None]) -> Any:
        """Let `do` be called, by the loop, with what a client chose of a handle."""
        event = handle.on_click if hasattr(handle, "on_click") else handle.on_update

        def by_client(event: Any) -> None:
            if event.client is not None:  # the page moves its sliders too
                value = getattr(event.target, "value", None)
                self._calls.put(lambda: do(value))

        event(by_client)
        return handle

    def _line(self, files: Sequence[str]) -> str:
        """Return how a client repeats this page with files, in Markdown."""
        line = self._setup.line(files, self._setup.world, self._setup.seed)
        more = " Velocities and numbers of the plant are not in it." * self._moved
        return f"Saved. This repeats it:{more}\n\n```\n{line}\n```"

    # The panel

    def _add_walk(self) -> None:
        gui, sent, velocity = self._server.gui, self._send, {}
        with gui.add_folder("Walk"):
            self._run = self._when(gui.add_button("Stop"), self._stop)
            self._when(gui.add_button("Reset: stand at the start again"), lambda _: self._reset())
            speed = gui.add_slider("speed [real time]", 0.1, 2.0, 0.1, 1.0)
            self._when(speed, lambda value: sent("set_speed", value))

            def command(_: Any) -> None:
                sent("set_velocity", *(handle.value for handle in velocity.values()))
                self._moved = True

            rows = ("ahead [m/s]", 1.0, 0.5), ("to the left [m/s]", 0.4, 0.0)
            for name, most, start in (*rows, ("turn left [rad/s]", 1.6, 0.0)):
                slider = gui.add_slider(name, -most, most, 0.05, start)
                velocity[name] = self._when(slider, command)
            newtons = gui.add_slider("push [N]", 10.0, 400.0, 10.0, 60.0)
            sides = gui.add_button_group(f"push {PUSH_TIME:g} s", list(_SIDES))
            self._when(
                sides,
                lambda side: sent("push", newtons.value * np.array([*_SIDES[side], 0.0])),
            )

    def _stop(self, _: Any) -> None:
        running = self._run.label != "Stop"
        self._run.label = "Stop" if running else "Go on"
        self._send("run", running)

    def _reset(self) -> None:
        for strip in self._strips:
            strip.clear()
        self._send("reset")

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
            self._plots = [plot(gui, title, "time [s]", np.zeros(1), empty) for title in titles]

    def _add_tuning(self) -> None:
        gui = self._server.gui
        with gui.add_folder("Tuning"):
            self._when(
                gui.add_button("Tune from here: one Gauss-Newton step"), lambda _: self._ask("step")
            )
            self._when(
                gui.add_button("Which weights matter in this walk?"), lambda _: self._ask("matter")
            )
            self._found = gui.add_markdown("")

    def _add_plant(self) -> None:
        gui, setup, plant = self._server.gui, self._setup, self._plant
        with gui.add_folder("Plant", expand_by_default=False):
            world = gui.add_dropdown("world", WORLDS, initial_value=setup.world)
            seed = gui.add_number("seed", setup.seed, min=0, step=1)
            mass = gui.add_slider("mass [times its own]", 0.7, 1.3, 0.01, float(plant.mass))
            friction = gui.add_slider("friction of the floor", 0.1, 1.2, 0.01, 0.8)
            delay = gui.add_slider("delay of the motors [ms]", 0.0, 1e3 * MAX_DELAY, 0.1, 0.0)
            payload = gui.add_slider("payload on the trunk [kg]", 0.0, 10.0, 0.1, 0.0)

            def show(plant: Imperfections) -> None:
                self._plant = plant
                mass.value, friction.value = float(plant.mass), float(plant.floor_friction)
                delay.value = 1e3 * float(plant.delay)

            def draw(_: Any) -> None:
                show(named_world(world.value, int(seed.value), setup.robot.description))
                self._setup = setup._replace(world=world.value, seed=int(seed.value))
                self._send("set_plant", self._plant, payload.value)

            def change(_: Any) -> None:
                self._plant = self._plant._replace(
                    mass=np.asarray(mass.value),
                    floor_friction=np.asarray(friction.value),
                    delay=np.asarray(1e-3 * delay.value),
                )
                self._moved = True
                self._send("set_plant", self._plant, payload.value)

            show(plant)
            for handle in (world, seed):
                self._when(handle, draw)
            for handle in (mass, friction, delay, payload):
                self._when(handle, change)

    # Tuning

    def _ask(self, what: str) -> None:
        self._wanted = what, self._weights.chosen
        self._found.content = "computing, the first time on a machine for a minute ..."
        self._send("log", self._wanted[1])

    def tune(self, walked: Walked | str) -> None:
        """Compute what a client asked for from a walk, or show why that cannot be."""
        what, i = self._wanted
        if isinstance(walked, str):
            self._found.content = f"Not yet: {walked}."
        else:
            self._tuner.start(what, i, walked)

    # The scene

    def _build_world(self) -> None:
        scene, height = self._server.scene, float(self._setup.robot.standing_height)
        scene.set_up_direction("+z")
        camera, side = self._server.initial_camera, np.deg2rad(-50.0)
        camera.look_at = (0.0, 0.0, 0.76 * height)
        camera.position = tuple(height * np.array([3.8 * np.cos(side), 3.8 * np.sin(side), 1.8]))
        (self._world, self._floor), self._handles = add_floor(scene), []
        for i, (name, colour) in enumerate(zip(self._names, rgb_of(self._names), strict=True)):
            root, across = f"/world/{i}", (len(self._names) - 1) / 2 - i
            scene.add_frame(root, show_axes=False, position=(0.0, 1.9 * height * across, 0.0))
            meshes = body_meshes(self._setup.model, colour).items()
            bodies = {b: scene.add_mesh_trimesh(f"{root}/body{b}", mesh) for b, mesh in meshes}
            # a label that moves lags behind: the robots stay near it, while the world moves
            above = (0.0, 1.9 * height * across, 2.0 * height)
            label = {"anchor": "bottom-center", "font_screen_scale": 1.4, "position": above}
            scene.add_label(f"/name{i}", name, **label)
            self._handles.append(
                {
                    "bodies": bodies,
                    "arrows": [self._add_arrows(f"{root}/{kind}", kind) for kind in _FORCES],
                    "cones": self._add_cones(f"{root}/cone"),
                    "aim": scene.add_icosphere(f"{root}/aim", 0.018, INK),
                }
            )

    def _add_arrows(self, root: str, kind: str) -> list[Any]:
        """Add an arrow for each foot, that starts at the origin of its own frame."""
        robot = self._setup.robot
        height, points = float(robot.standing_height), np.zeros((1, 2, 3), np.float32)
        radius = 0.019 * height
        size = {"shaft_radius": radius, "head_radius": 2.3 * radius, "head_length": 0.083 * height}
        feet = range(len(robot.foot_point))
        add = self._server.scene.add_arrows
        return [add(f"{root}{foot}", points, _FORCES[kind], **size) for foot in feet]

    def _add_cones(self, root: str) -> list[Any]:
        """Add the edges of the friction cone of each foot, as high as the force on it."""
        edges, colours = np.zeros((8, 2, 3), np.float32), _FORCES["measured"]
        add = self._server.scene.add_line_segments
        feet = range(len(self._setup.robot.foot_point))
        return [add(f"{root}{foot}", edges, colours, thickness=0.004) for foot in feet]

    def show(self, frame: Frame) -> None:
        """Show a frame; numbers and strips four times a second."""
        aim = frame.walks[0].reference * [1.0, 1.0, 0.0]
        with self._server.atomic():
            self._world.position, self._floor.position = -aim, 5.0 * np.round(aim / 5.0)
            for now, handles in zip(frame.walks, self._handles, strict=True):
                self._draw(now, handles)
        for strip, now in zip(self._strips, frame.walks, strict=True):
            # before the path begins there is no error, and with a NaN the page draws no line at all
            if np.isfinite(now.error).all() and (not strip or now.time > strip[-1][0]):
                off = np.hypot(*now.error[:2]), np.hypot(*now.error[3:5])
                strip.append((now.time, *off))
                while strip[0][0] < now.time - _STRIP:
                    strip.popleft()
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + 0.25
            self._show_numbers(frame)

    def _draw(self, now: Now, handles: dict[str, Any]) -> None:
        robot = self._setup.robot
        height, weight = float(robot.standing_height), float(robot.mass * robot.gravity[2])
        self._data.qpos[:] = now.pose
        mujoco.mj_kinematics(self._setup.model, self._data)
        for body, handle in handles["bodies"].items():
            handle.position = self._data.xpos[body].copy()
            handle.wxyz = self._data.xquat[body].copy()
        for arrows, forces in zip(handles["arrows"], (now.planned, now.measured), strict=True):
            for arrow, foot, force in zip(arrows, now.feet, forces, strict=True):
                arrow.position, arrow.visible = foot, bool(force[2] > _LOADED * weight)
                if arrow.visible:
                    end = _ARROW * height / weight * force
                    arrow.points = np.stack([np.zeros(3), end])[None].astype(np.float32)
        for cone, foot, force in zip(handles["cones"], now.feet, now.measured, strict=True):
            cone.position, cone.visible = foot, bool(force[2] > _LOADED * weight)
            if cone.visible:
                up = _ARROW * height / weight * force[2]
                cone.points = up * _cone_edges(float(self._plant.floor_friction))
        handles["aim"].position = now.reference

    def _show_numbers(self, frame: Frame) -> None:
        slow = frame.wanted > 0.0 and frame.factor < _SLOW * frame.wanted
        lines = [f"Real-time factor {frame.factor:.2f}" if frame.wanted else "Stopped."]
        if slow:
            lines[0] += f": **this machine is too slow** for speed {frame.wanted:g}"
        rows = ["| | x, y, z [cm] | roll, pitch, yaw [°] |", "|---|---|---|"]
        sets = zip(self._names, frame.walks, frame.starts, strict=True)
        for name, now, first in sets:
            lines.append(f"**{name}**: {self._state_text(now)}")
            rows.append(_row(f"**{name}** now", now.errors))
            if first is not None and first is not now.errors:
                rows.append(_row(f"{name} at the start", first))
        self._status.content, self._table.content = "\n\n".join(lines), "\n".join(rows)
        if min(map(len, self._strips)) > 1:
            count = min(map(len, self._strips))
            data = np.array([list(strip)[-count:] for strip in self._strips])
            for k, handle in enumerate(self._plots):
                handle.data = (data[0, :, 0], *data[:, :, k + 1])

    def _state_text(self, now: Now) -> str:
        if now.fall:
            return f"{now.fall}. Reset lets it stand again."
        mu, robot, text = float(self._plant.floor_friction), self._setup.robot, []
        for foot, force in zip(FEET[len(now.measured)], now.measured, strict=True):
            if force[2] > _LOADED * float(robot.mass * robot.gravity[2]):
                share = np.abs(force[:2]).sum() / (mu * force[2])  # the cone is a diamond
                text.append(
                    f"{foot.replace('_', ' ')} {force[2]:.0f} N, {100 * share:.0f} % of friction"
                )
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
