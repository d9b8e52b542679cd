"""Each command line of a page or of the help runs to its end, on what the lines before it made.

As a user types them, but small: `SMALL` shortens the walks and the tunings of each command, and
trajectories of the names in the pages are of 0.2 s. `PAIRS` are flags that meet in the code.
"""

import re
import shlex
import shutil
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import pytest
from pretend import HandsOver, call
from test_docs import READ, README, ROOT, lines_of

from hector_jax.cli import commands, evaluate, flags, propose, tune, walk, walker
from hector_jax.control.weights import expert
from hector_jax.control.weights_file import save_weights
from hector_jax.grfm.training import TrainConfig
from hector_jax.store import nets
from hector_jax.store.nets import CollectConfig

SHORT = 'name = "{}"\n[[segment]]\nseconds = {}\nv_x = {}\n'
LENGTHS = {"short": 0.2, "long": 1.5}  # a log of a walker is checked, which takes 1.5 s
SPEEDS = {"straight": 0.3, "c": 0.25, "s": 0.2, "slalom": 0.15}
SMALL = {
    "tune": "--iterations 1 --seeds 1 --no-video --walk-plants 1",
    "evaluate": "--seeds 1 --other-seeds 1",
    "collect": "--walks 3 --seconds 0.2 --engine c",
    "train": "--epochs 1",
    "view": "--out shown",
}
"""Flags that make a line of a command small, in the place of its own."""
SECONDS = {"walk": 0.2, "evaluate": 0.2, "check": 1.5, "twin": 1.5, "foretell": 1.5}
"""Lengths of the walks of a command; those of others are as long as a trajectory's file says."""
# a scheduler; no work; the machine's; of test_live.py and of test_bag.py
ELSEWHERE = ("--cluster", "--help", "doctor", "--live", "--mapping")


def words_of(line):
    first, *words = shlex.split(line, comments=True)[1:]
    if first == "tune":  # each of them is made short
        words = " ".join(words).replace("--traj all", "--traj straight c s").split()
    top = [first] if first in ("log", "steps") else []
    command = words.pop(0) if top else first
    small = shlex.split(SMALL.get(command, ""))
    for flag in {"--seeds", "--walks", "--engine"} & {*small, *words}:
        if flag in small and flag in words:
            del words[words.index(flag) : words.index(flag) + 2]
    if "--walk-plants" in words:
        small = small[: small.index("--walk-plants")]
    if command == "tune" and "--walker" in words:  # or as the run that is resumed
        small = ["--seeds", "1"]
    if {"--resume", "--runs"} & {*words}:
        small = []
    if command == "tune" and "--walks" in words and "0" not in words:
        words[words.index("--walks") + 1] = "6" if "c" in words else "4"
    if command == "tune" and not {"--traj", "--resume", "--config"} & {*words}:
        words += ["--traj", "straight"]
    files = command not in SECONDS or "runs/robot" in line  # that `hector propose` was given
    long = "--walker" in words
    words = [one for word in words for one in found(word, files, "long" if long else "short")]
    if {"--seconds", "--runs"} & {*words}:
        return [*top, command, *words, *small]
    if command in SECONDS and "short/" not in " ".join(words):
        small += ["--seconds", str(LENGTHS["long"] if long else SECONDS[command])]
    return [*top, command, *words, *small]


def found(word, files, length):
    """The words that stand for one: trajectories of a length, files, the last run."""
    name = Path(word).stem
    if word == "examples/slalom.toml" or (files and word in SPEEDS):
        return [f"{length}/{name}.toml"]
    if "TIME" in word:
        return [word.replace("runs/c/TIME", str(max(Path("runs/short-c").iterdir())))]
    if "*" in word:
        return sorted(map(str, Path().glob(word.replace("runs/", "runs/short-"))))
    return [word.replace("$i", "0")]


def documented(*pages):
    """The lines of pages, each once, and those of the help."""
    lines = [line for page in pages for line in lines_of(page, "hector")]
    if README not in pages:
        for kind in flags.COMMANDS.values():
            lines += re.findall(r"Example: (hector .*)", kind.__doc__ or "")
    bare = dict.fromkeys(re.sub(r"\s+#.*", "", line).strip() for line in lines)
    return [line for line in bare if not any(word in line for word in ELSEWHERE)]


PAIRS = [
    "hector tune --traj straight --walks 4 --smooth 10 --out runs/smooth",
    "hector export runs/smooth --set with",
    "hector tune --resume runs/smooth",
    "hector tune --traj straight --walks 4 --alpha auto --tune all --out runs/auto",
    "hector tune --traj straight --walks 4 --tune footsteps --walk-plants 0 --out runs/hfs",
    "hector tune --robot examples/quadruped/robot.toml --walks 4 --out runs/four",
    "hector view runs/four",
    "hector export runs/four",
    "hector tune --traj straight --variant paper --walks 0 --out runs/paper",
    "hector export runs/paper",
    "hector tune --traj c --walks 4 --safe 0.05 --out runs/safe",
    "hector tune --resume runs/safe",
    "hector tune --traj straight --start shipped --alpha auto --json --out runs/judged",
    "hector tune --traj straight --net data/more.npz --out runs/net",
    "hector view runs/net",
    "hector tune --resume runs/net",
    "hector evaluate --runs runs/smooth runs/net",
    "hector tune --walker mine.py --planner plans.py --robot mine.toml --walks 4 --out runs/own",
    "hector tune --resume runs/own",
]
"""Lines of flags that meet in the code, in an order in which each has its input."""
PROPOSED = "hector propose runs/robot --traj s"
PROPOSED_WALK = "hector walk --weights runs/robot/weights/0.json --traj s --out {}"
A_WALK = "hector walk --weights nominal --traj {} --seconds 1.5 --out {}.npz"
INPUTS = {
    "hector log add runs/robot log.npz": [PROPOSED, PROPOSED_WALK.format("log.npz")],
    "hector log add runs/robot s.npz": [PROPOSED, PROPOSED_WALK.format("s.npz")],
    "hector export runs/c/TIME --set without": ["hector tune --traj c"],
    "hector log check mine.npz --traj straight": [A_WALK.format("straight", "mine")],
    "hector log foretell mine.npz --walked nominal --weights expert shipped": [
        A_WALK.format("straight", "mine")
    ],
    "hector log foretell s.npz --traj s --walked nominal --weights shipped": [
        A_WALK.format("s", "s")
    ],
    "hector log twin log.npz --planner plans.py --robot mine/robot.toml --weights mine.json": [
        "hector robot mine.xml --out mine",
        "hector walk --walker mine.py --robot mine/robot.toml --weights mine.json --out log.npz",
    ],
}
"""Lines whose input another page tells how to make, in words."""


def all_lines():
    """README's, which are quick, then those of the other pages and of the help, then pairs."""
    first = ["hector tune --traj straight", *documented(README)]  # what `make tune` runs
    rest = [line for line in documented(*READ) if line not in first]
    yield from (pytest.param(line, id=line) for line in first)
    yield from (pytest.param(line, id=line, marks=pytest.mark.slow) for line in (*rest, *PAIRS))


@dataclass(frozen=True)
class TwoEpochs(TrainConfig):
    """A training that takes no time."""

    epochs: int = 2


@pytest.fixture(scope="module")
def console(tmp_path_factory):
    """A function that runs a line in a folder with all that a reader brings."""
    small, pool = CollectConfig(walks=6, seconds=0.5), HandsOver()
    own, four = ROOT / "examples" / "own_controller", ROOT / "examples" / "quadruped"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("reader"))
        asked = nets.CollectConfig  # with numbers, by `hector steps collect`
        patch.setattr(nets, "CollectConfig", lambda *given: asked(*given) if given else small)
        patch.setattr(nets, "TrainConfig", TwoEpochs)
        patch.setattr(nets, "tuning_paths", lambda *_, **__: [])
        for module in (commands, evaluate, propose, tune, walk, walker):
            patch.setattr(module, "workers", lambda *_: nullcontext(pool))
        for folder in ("assets", "examples"):
            Path(folder).symlink_to(ROOT / folder)
        for length, seconds in LENGTHS.items():
            Path(length).mkdir()
            for name, speed in SPEEDS.items():
                text = SHORT.format(f"{length}-{name}", seconds, speed)
                Path(f"{length}/{name}.toml").write_text(text)
        Path("mine.py").symlink_to(own / "walker.py")
        Path("mine.xml").symlink_to(ROOT / "assets" / "hector.xml")
        Path("plans.py").symlink_to(own / "planner.py")
        Path("hector.xml").symlink_to(own / "hector.xml")
        for name in ("mine", "twin"):
            Path(f"{name}.toml").symlink_to(own / "twin.toml")
        shutil.copy(four / "quadruped.xml", "h1.xml")
        for name in ("mine", "best", *(f"runs/tuned/{name}" for name in SPEEDS)):
            save_weights(Path(f"{name}.json"), expert())
        yield lambda line: call(patch, *words_of(line))


@pytest.mark.parametrize("line", list(all_lines()))
def test_a_documented_line_runs_to_its_end(console, capsys, line):
    for engine in ("drake", "pinocchio"):
        if engine in line:
            pytest.importorskip("pydrake" if engine == "drake" else engine)
    for one in (*INPUTS.get(line, ()), line):
        if "propose" in one and "--traj" in one:
            shutil.rmtree("runs/robot", ignore_errors=True)  # another reader begins anew
        code = console(one)
    out, err = capsys.readouterr()
    assert code == 0, err
    assert "Traceback" not in out + err
