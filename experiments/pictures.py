"""The pictures of README and docs: `python experiments/pictures.py NAME ...`, by default all.

    method        how a tuning works, as a block diagram
    own           a controller of one's own: what its user provides, and the first minutes
    worlds        who may read which simulated robots
    commands      which command is for whom
    time          calls of the exported controller, and the first seconds of a walk
    foot          points, lengths and signs of a foot
    weights       the weights expert and shipped by the nominal ones
    film          the robot with plain and with tuned weights, side by side
    before-after  errors along one walk of the sets nominal, expert and shipped
    foretold      loss walked by loss foretold, with intervals
    race          loss by the number of walks, against CMA-ES and Bayesian optimisation
    robots        four robots walking
    gallery       robots of one's own walking (needs their files: --robots NAME/robot.toml ...)
    page          the browser page of a run (needs Chromium and a run: --run)
    live          the browser page of a live walk (needs Chromium)
    live-film     ten seconds of it, in which a weight is turned and the robot pushed

Walks are those of the first plant of the hardware stand-in, which no tuning has read; those of
`robots` and `gallery` are on the high-fidelity simulator.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from diagrams import DIAGRAMS
from PIL import Image, ImageDraw, ImageFont
from plots import draw_repeats, forecasts

from hector_jax import (
    Job,
    Weights,
    expert,
    hfs,
    load_robot,
    named_command,
    nominal,
    setup_jax,
    walk,
    walk_config,
)
from hector_jax.control.weights_file import shipped
from hector_jax.core.console import exit_code, say
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import check
from hector_jax.core.trajectory import Trajectory
from hector_jax.report.plots.style import drawing, label_of, looks_of
from hector_jax.robot.model import Robot
from hector_jax.sim.live import Call, Session
from hector_jax.sim.standin import standin
from hector_jax.sim.world import Imperfections
from hector_jax.verdict.foretell import HERE, calibrated
from hector_jax.view.live_page import LivePage
from hector_jax.view.live_weights import PageSetup
from hector_jax.view.motion import motions
from hector_jax.view.page import opened_server
from hector_jax.view.video import VideoConfig, write_film, write_strip

ROOT = Path(__file__).parents[1]
OUT = ROOT / "docs" / "pictures"
sys.path.insert(0, str(ROOT / "tests"))  # the browser of its tests
_FRAME = 0.2  # [s] of the film of the live page
_TICKS = 4  # from frame to frame that the page is shown
FORETOLD = ROOT / "experiments" / "reports" / "foretell" / "standin.json"
RACE = ROOT / "experiments" / "reports" / "race" / "nominal" / "race.json"
CLOSE_NOTICES = "document.querySelectorAll('.mantine-CloseButton-root').forEach(x => x.click())"
METHODS = {  # of the race, by plain names, with their lines
    "tuner": ("hector tune --walks", {"color": "#00805f", "linewidth": 2.2}),
    "nominal turbo on model": (
        "Bayesian optimisation (TuRBO with our model)",
        {"color": "#e07c24", "linestyle": (0, (5, 1.5))},
    ),
    "nominal lq-cma-es": ("lq-CMA-ES", {"color": "#7a3e9d", "linestyle": (0, (1.2, 1.2))}),
}


@dataclass(frozen=True)
class Flags:
    """Draw the pictures of README and docs."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()  # pictures; all by default
    run: Path = Path("runs/straight")  # folder of a run of `hector tune`, for the page
    robots: tuple[Path, ...] = ()  # TOML files, for the gallery

    def __post_init__(self) -> None:
        check(self, names=tuple(PICTURES))
        if "gallery" in self.names and not self.robots:
            raise InputError("gallery: --robots must name TOML files of robots, got none")


def walk_of(robot: Robot, weights: Weights, plant: Imperfections, seconds: float) -> Trajectory:
    """Walk a robot straight ahead on a plant."""
    job = Job(weights, named_command("straight"), plant, seconds)
    return walk(walk_config(robot), robot, job)


# The walks


def draw_film(path: Path) -> None:
    """Film the plain and the tuned weights on one plant."""
    robot, pair = load_robot(), {"nominal": nominal(), "shipped": shipped()}
    walks = {name: walk_of(robot, weights, standin(0), 4.0) for name, weights in pair.items()}
    config = VideoConfig(width=720, height=488, rate=12)
    write_film(path, robot, motions(robot, walks), config)


def draw_before_after(path: Path) -> None:
    """Draw the distance from the reference and the error in pitch along one walk of each set."""
    sets = {"nominal": nominal(), "expert": expert(), "shipped": shipped()}
    with drawing(path, 7.2, 2.6, dpi=190.0) as figure:
        left, right = figure.subplots(1, 2)
        for name, look in looks_of(sets).items():
            one = walk_of(load_robot(), sets[name], standin(0), 4.0)
            times = float(one.period) * np.arange(1, len(one.fallen) + 1)
            off = np.asarray(one.state.position) - one.reference.position
            distance = 100 * np.linalg.norm(off[:, :2], axis=1)
            pitch = np.rad2deg(np.asarray(one.state.euler) - one.reference.euler)[:, 1]
            for panel, values in ((left, distance), (right, pitch)):
                panel.plot(
                    times, np.where(one.fallen, np.nan, values), **look.line, label=label_of(name)
                )
        left.set(ylabel="distance from the reference [cm]", ylim=(0, None))
        right.set(ylabel="error in pitch [degrees]")
        right.axhline(0.0, color="black", linewidth=0.8)
        for panel in (left, right):
            panel.set(xlabel="time [s]", xlim=(0, 4))


def draw_race(path: Path) -> None:
    """Draw the loss of the best weights so far by the number of walks on the simulator."""
    race = json.loads(RACE.read_text())["s"]
    with drawing(path, 5.8, 3.1, dpi=190.0, legend_columns=2) as figure:
        axes = figure.subplots()
        for method, (label, line) in METHODS.items():
            each = {int(walks): losses for walks, losses in race[method]["own"].items()}
            draw_repeats(axes, each, {"marker": "o", "label": label, **line}, alpha=0.15)
        axes.set(
            xlabel="walks on the simulator (median and range of the repeats)",
            ylabel="loss of the best so far [10$^6$]",
        )
        axes.set(xlim=(-2, 202), ylim=(0, None))


def draw_robots(path: Path) -> None:
    """Draw HECTOR with its set shipped, and three robots of the examples with plain weights."""
    tiles = [_still(load_robot(), shipped(), "HECTOR: shipped")]
    for name in ("strider", "quadruped", "humanoid"):
        robot = load_robot(ROOT / "examples" / name / "robot.toml")
        tiles.append(_still(robot, nominal(robot), f"{name}: nominal"))
    _paste(path, tiles, len(tiles))


def draw_gallery(path: Path, robots: Sequence[Path]) -> None:
    """Draw robots with plain weights, eight in a row, with the names of their folders."""
    named = {file.parent.name: load_robot(file) for file in robots}
    tiles = [_still(robot, nominal(robot), f"{name}: nominal") for name, robot in named.items()]
    width, height = tiles[0].size
    _paste(path, [tile.resize((width // 2, height // 2)) for tile in tiles], 8)


def _paste(path: Path, tiles: Sequence[Image.Image], columns: int) -> None:
    """Write a picture of tiles of one size, row by row."""
    width, height = (size + 4 for size in tiles[0].size)
    rows = -(-len(tiles) // columns)
    picture = Image.new("RGB", (columns * width - 4, rows * height - 4), "white")
    for i, tile in enumerate(tiles):
        picture.paste(tile, (i % columns * width, i // columns * height))
    picture.save(path, optimize=True)


def _still(robot: Robot, weights: Weights, title: str) -> Image.Image:
    """Return a picture of a walk, with the robot's name and mass below."""
    moved = motions(robot, {title: walk_of(robot, weights, hfs(robot.description), 2.0)})
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "still.png"
        write_strip(file, robot, moved, VideoConfig(width=1000, height=560, tiles=4))
        strip = Image.open(file).convert("RGB")
    wide = strip.width // 4
    tile = Image.new("RGB", (wide - 2, strip.height + 44), "white")
    tile.paste(strip.crop((2 * wide + 1, 0, 3 * wide - 1, strip.height)), (0, 0))
    words = f"{title.partition(':')[0]}, {float(robot.mass):.0f} kg"
    place, font = (tile.width / 2, tile.height - 22), ImageFont.load_default(size=26)
    ImageDraw.Draw(tile).text(place, words, "black", font, "mm")
    return tile


# The page


def draw_page(path: Path, run: Path) -> None:
    """Take a picture of the page of `hector view` on a run."""
    _take_picture(path, [str(run), "--world", "standin"], "before:", 6.0)


def draw_live(path: Path) -> None:
    """Take a picture of the page of `hector view --live`, after six seconds of walking."""
    with _live_page({"nominal": nominal(), "shipped": shipped()}, 1200) as (tab, _):
        Image.fromarray(tab.picture()).save(path, optimize=True)


def draw_live_film(path: Path) -> None:
    """Film ten seconds of the page of `hector view --live`.

    Q_pitch is turned down after two seconds and back after six; a push from behind follows.
    """
    acts = {
        2.0: lambda tab: tab.fill("Q_pitch", "-0.5"),
        6.0: lambda tab: tab.click("Undo"),
        7.6: lambda tab: tab.click("from behind"),
    }
    frames: list[Image.Image] = []
    with _live_page({"shipped": shipped()}, 1100) as (tab, go):
        for frame in range(round(10.0 / _FRAME)):
            for due in [due for due in acts if due <= frame * _FRAME]:
                acts.pop(due)(tab)
                time.sleep(1.0)  # until the page has told the server
            go(_FRAME)
            frames.append(Image.fromarray(tab.picture()).reduce(2))
    options: dict[str, Any] = {
        "duration": round(1e3 * _FRAME),
        "loop": 0,
        "quality": 30,
        "method": 6,
    }
    frames[0].save(path, save_all=True, append_images=frames[1:], **options)


@contextmanager
def _live_page(
    sets: dict[str, Weights], height: int
) -> Iterator[tuple[Any, Callable[[float], None]]]:
    """Open the page of a live walk in a browser and walk for six seconds.

    Yields its tab, and a function that walks on.

    The walk waits for the browser, which draws slowly where there is no graphics card; its
    real-time factor is by the time of the processor.
    """
    from browser import opened  # pyright: ignore[reportMissingImports]

    robot = load_robot()
    plant, command = hfs(robot.description), named_command("straight")
    session = Session(robot, [Job(weights, command, plant) for weights in sets.values()])
    session.warm_up()
    named = {"nominal": nominal(), "expert": expert(), "shipped": shipped()}
    setup = PageSetup(robot, sets, list(sets), named, "hfs", 0, {}, str)
    with opened_server("127.0.0.1", 8765) as (server, address):
        page = LivePage(server, setup, _Direct(session), None)  # pyright: ignore

        def go(seconds: float) -> None:
            ticks, spent = round(seconds / session.config.gait.tick), 0.0
            page.work()
            for k in range(ticks):
                start = time.process_time()
                session.tick()
                spent += time.process_time() - start
                if k % _TICKS == _TICKS - 1 or k == ticks - 1:
                    factor = min(seconds * (k + 1) / ticks / spent, 1.0)
                    page.show(session.frame()._replace(factor=factor))
            time.sleep(1.0)  # until it is drawn

        with tempfile.TemporaryDirectory() as profile, opened(address, profile, height) as tab:
            go(0.1)
            while "Real-time factor" not in tab.text():
                time.sleep(2.0)
            tab.call("Runtime.evaluate", expression=CLOSE_NOTICES)
            for _ in range(60):  # the scene fades in by frames
                go(0.1)
            yield tab, go


@dataclass
class _Direct:
    """A pipe to a session that answers at once."""

    session: Session

    def send(self, call: Call) -> None:
        """Do what the page calls."""
        name, values = call
        getattr(self.session, name)(*values)


def _take_picture(path: Path, flags: list[str], words: str, seconds: float) -> None:
    """Take a picture of the page of `hector view`, so long after it shows these words."""
    from browser import opened  # pyright: ignore[reportMissingImports]

    line = [sys.executable, "-m", "hector_jax", "view", *flags, "--port", "8765"]
    server = subprocess.Popen(line, stderr=subprocess.PIPE, text=True)
    try:
        assert server.stderr is not None
        address = next(x for x in server.stderr if x.startswith("open http")).split()[1]
        with tempfile.TemporaryDirectory() as profile, opened(address, profile, height=960) as tab:
            deadline = time.monotonic() + 240.0
            while words not in tab.text() and time.monotonic() < deadline:
                time.sleep(2.0)
            time.sleep(seconds)
            tab.call("Runtime.evaluate", expression=CLOSE_NOTICES)
            time.sleep(2.0)
            Image.fromarray(tab.picture()).save(path, optimize=True)
    finally:
        server.terminate()
        server.wait()


def draw_foretold(path: Path) -> None:
    """Draw what a log of each of 20 plants foretold, and what was walked."""
    pairs = json.loads(FORETOLD.read_text())["pairs"]
    plants = sorted({pair["seed"] for pair in pairs if pair["far"]})[:20]
    cases = {
        traj: [
            (pair["foretold"]["L"], pair["walked"]["L"])
            for pair in pairs
            if pair["traj"] == traj and pair["seed"] in plants and pair["far"]
        ]
        for traj in ("straight", "c", "s")
    }
    forecasts(path, cases, calibrated(HERE)["L"])


PICTURES: dict[str, tuple[Path, Callable[[Path], None] | None]] = {
    **{name: (OUT / f"{name}.svg", draw) for name, draw in DIAGRAMS.items()},
    "film": (ROOT / "docs" / "walk.webp", draw_film),
    "before-after": (OUT / "before-after.png", draw_before_after),
    "foretold": (OUT / "foretold.png", draw_foretold),
    "race": (OUT / "race.png", draw_race),
    "robots": (OUT / "robots.png", draw_robots),
    "gallery": (OUT / "gallery.png", None),  # takes the files too
    "page": (OUT / "page.png", None),  # takes the run too
    "live": (OUT / "live.png", draw_live),
    "live-film": (OUT / "live.webp", draw_live_film),
}


def main() -> None:
    """Draw the pictures that are named."""
    flags = tyro.cli(Flags, description=__doc__)
    setup_jax()
    OUT.mkdir(exist_ok=True)
    own = {"gallery": partial(draw_gallery, robots=flags.robots)}
    own |= {"page": partial(draw_page, run=flags.run)}
    for name in flags.names or [name for name in PICTURES if flags.robots or name != "gallery"]:
        path, draw = PICTURES[name]
        (draw or own[name])(path)
        say(f"{name}: {path}")


if __name__ == "__main__":
    sys.exit(exit_code("pictures", main))
