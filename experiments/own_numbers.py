"""Does a tuning find numbers of a controller of one's own that are 40 % off?

The controller is that of examples/own_controller, with weights that were tuned before. Its numbers
are planted 40 % too low, the time of its steps 40 % too long: with shorter ones it falls.

    python experiments/own_numbers.py --weights runs/straight-s/20260101-120000/weights/best.json

The report has the walks of the planted and the tuned set on plants that no tuning has walked.
"""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import lib

from hector_jax.core.files import write_json
from hector_jax.core.settings import read_toml

OWN = Path(__file__).parents[1] / "examples" / "own_controller"
OFF = {"KP": 0.6, "KD": 0.6, "APEX": 0.6, "FEEDBACK": 0.6, "STEP": 1.4}
WALKED_BY = (
    "--walker",
    OWN / "walker.py",
    "--robot",
    OWN / "numbers.toml",
    "--traj",
    "straight",
    "s",
)


@dataclass(frozen=True, kw_only=True)
class Flags(lib.Flags):
    """What to start from."""

    weights: Path  # tuned without the numbers
    out: Path = Path("runs/own_numbers")  # folder of the report
    walks: int = 40
    seeds: int = 16  # plants of the report
    first_seed: int = 9100


def hector(*words: object) -> str:
    """Run a line of the console script; return what it prints."""
    line = [sys.executable, "-m", "hector_jax", *map(str, words)]
    return subprocess.run(line, check=True, stdout=subprocess.PIPE, text=True).stdout


def experiment(flags: Flags) -> Path:
    """Plant the numbers, tune, and walk both sets."""
    numbers = read_toml(OWN / "numbers.toml", "the robot")["numbers"]
    planted = {name: factor * numbers[name]["start"] for name, factor in OFF.items()}
    start, run = flags.out / "start.json", flags.out / "tuned"
    write_json(start, json.loads(flags.weights.read_text()) | {"others": planted})
    together = *WALKED_BY, "--processes", flags.processes
    planner = "--planner", OWN / "planner.py", "--start", start, "--walks", flags.walks
    hector("tune", *together, *planner, "--seeds", 1, "--no-video", "--out", run)
    best = run / "weights" / "best.json"
    plants = "--seeds", flags.seeds, "--first-seed", flags.first_seed
    found = hector("evaluate", *together, *plants, "--weights", start, best, "--json")
    sets = {name: json.loads(path.read_text()) for name, path in (("start", start), ("best", best))}
    report = flags.out / "own_numbers.json"
    walks = json.loads((run / "result.json").read_text())["walks"]
    made = {"sets": sets, "walks": walks, "evaluation": json.loads(found)}
    write_json(report, made)
    return report


if __name__ == "__main__":
    lib.run(experiment, Flags)
