"""README: each of its figures is that of a file, and it stays short."""

import json
import math
import re
from pathlib import Path

import jax
import numpy as np
import pytest

from hector_jax.control.controller import walk_config
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import nominal
from hector_jax.control.weights_file import best
from hector_jax.core.tree_file import tree_hash
from hector_jax.robot.model import load_robot
from hector_jax.store.nets import CollectConfig

ROOT = Path(__file__).parents[1]
REPORTS = ROOT / "experiments/reports"
BEST = REPORTS / "best"  # evaluations of the sets on each command
ROBOTS = REPORTS / "robots/robots.json"
ROBUSTNESS = REPORTS / "robustness/robustness.json"
RACE = REPORTS / "race/nominal/race.json"
VERDICT = REPORTS / "verdict" / "verdict.json"
INTEGRAL = REPORTS / "integral.json"  # weights and the numbers beside them, apart
RUN = REPORTS / "run.json"  # the run whose lines README shows

ERRORS = ("L_Eul", "L_pos")  # parts of the loss: attitude, position

README = (ROOT / "README.md").read_text()
TEXT = " ".join(README.split())
PROSE = re.sub(r"```.*?```", "", README, flags=re.DOTALL)


def cells(start):
    """Cells of the row of a table that starts so, without bold type."""
    (row,) = re.findall(rf"^\| {re.escape(start)}.*", README, re.MULTILINE)
    return [cell.strip().replace("**", "") for cell in row.strip("|").split("|")[1:]]


def evaluation(trajectory, name):
    sets = json.loads((BEST / f"{trajectory}.json").read_text())["sets"]
    return sets[name]["standin"]


def plain(rms):
    """Errors in the plane and in height [cm], in pitch and yaw [degrees]."""
    (_, pitch, yaw), (x, y, z) = rms["euler"], rms["position"]
    return 100 * math.hypot(x, y), 100 * z, math.degrees(pitch), math.degrees(yaw)


def test_the_readme_is_read_in_two_minutes():
    lines = [line for line in PROSE.splitlines() if not line.startswith("|")]
    words = re.sub(r"\]\([^)]*\)", "]", "\n".join(lines)).split()
    assert README.count("\n") <= 110
    assert len(words) <= 700


def test_the_readme_has_no_seeds_hashes_or_intervals():
    hashes = re.findall(r"\b(?=\w*\d)(?=\w*[a-f])[0-9a-f]{7,40}\b", README)
    assert hashes == []
    assert not re.search(r"\bseeds?\b|\[-?\d+, -?\d+\]", README)


def test_what_the_readme_links_is_there():
    targets = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", README)
    missing = {target for target in targets if not (ROOT / target).exists()}
    assert missing == set()
    assert len(targets) > 25


@pytest.mark.parametrize("name", ["nominal", "expert", "best"])
def test_the_errors_of_the_table_are_those_of_the_files(name):
    *errors, falls = cells(f"`{name}`:")
    each = [evaluation(trajectory, name) for trajectory in ("straight", "c", "s")]
    for cell, one in zip(errors, each, strict=True):
        plane, height, pitch, _ = plain(one["rms"])
        assert cell == f"{plane:.1f} cm, {height:.1f} cm, {pitch:.1f}°"
        assert f"on {len(one['seeds'])} other simulated robots that took no part" in TEXT
    assert falls == str(sum(one["falls"] for one in each))
    assert list(COMMANDS) == ["straight", "c", "s"]
    speeds = [float(named_command(trajectory).velocity[0, 0]) for trajectory in COMMANDS]
    assert speeds[0] == speeds[2]
    assert "in walks of 4 s at {} m/s (C: {})".format(*speeds) in TEXT


def test_the_share_of_the_numbers_beside_the_weights_is_that_of_their_file():
    report = json.loads(INTEGRAL.read_text())
    assert report["weights"]["best"] == tree_hash(best())

    def told(name):
        each = [report["sets"][trajectory][name]["change"]["nominal"] for trajectory in COMMANDS]
        assert all(change["counts"] for change in each)
        return "{:.0f}, {:.0f}, {:.0f}".format(*(-change["median"] for change in each))

    text = "They alone take {} % of the loss away (straight, C, S), tuned weights {}, both {} %."
    names = ("nominal with others of best", "with", "best")
    assert text.format(*map(told, names)) in TEXT


def test_the_heading_is_told_as_the_file_of_the_s_curve_has_it():
    tuned, expert = (plain(evaluation("s", name)["rms"])[3] for name in ("best", "expert"))
    assert f"on S it is {tuned:.1f}° off" in TEXT
    assert f"with `expert` {expert:.1f}°" in TEXT


def test_the_smoothness_is_that_of_the_files():
    ratios = []
    for trajectory in COMMANDS:
        each = [evaluation(trajectory, name) for name in ("best", "expert")]
        tuned, expert = (one["L_ctrl"]["mean"] - one["L_ctrl_switching"] for one in each)
        ratios.append(tuned / expert)
    assert f"changes {min(ratios):.1f} to {max(ratios):.1f} times as much" in TEXT


def test_the_falls_under_disturbances_are_those_of_their_file():
    report = json.loads(ROBUSTNESS.read_text())
    assert report["weights"]["best"] == tree_hash(best())
    shares = {n: 100 * one["falls"] / one["walks"] for n, one in report["totals"].items()}
    told = "falls in {best:.0f} % of walks, `nominal` in {nominal:.0f} %"
    assert told.format(**shares) in TEXT
    floor = [c["sets"] for c in report["cells"] if (c["traj"], c["level"]) == ("s", "friction 0.3")]
    for name in ("best", "nominal"):
        assert sum(c[name]["falls"] for c in floor) > sum(c[name]["walks"] for c in floor) / 2


def test_the_engines_are_told_as_their_file_has_them():
    result = json.loads(VERDICT.read_text())
    assert result["config"]["flags"]["engine"] == ["c", "drake", "pinocchio"]
    one = result["sets"]["best"]
    below = [one["against"][base] for base in ("nominal", "expert")]
    assert f"below that of `nominal` in {below[0]['below']} of {below[0]['cells']} cases" in TEXT
    assert f"of `expert` in {below[1]['below']}; `best` never falls" in TEXT
    assert below[1]["below"] == below[1]["cells"]
    assert one["falls"] == 0 < result["sets"]["nominal"]["falls"]


def test_what_a_run_prints_is_what_its_result_says():
    run = json.loads(RUN.read_text())
    sets = run["sets"]
    told = "{} minutes on two cores with set-up, then {}".format(*map(round, run["minutes"]))
    assert told in TEXT
    each = {name: plain(sets[name]["rms"])[:3] for name in ("best", "nominal", "expert")}
    first = "best is {:.1f} cm off, {:.1f} cm in height, {:.1f} degrees in pitch"
    rest = ["{} {:.1f}, {:.1f}, {:.1f}".format(name, *each[name]) for name in [*each][1:]]
    assert "; ".join([first.format(*each["best"]) + " (RMS)", *rest]) + "." in TEXT
    falls = ", ".join(f"{name} {sets[name]['falls']}" for name in each)
    walks = sets["best"]["plants"]
    assert f"Falls in {walks} walks on robots that the tuning has not seen: {falls}." in TEXT


@pytest.mark.parametrize(
    ("start", "robot"),
    [
        ("`examples/quadruped`", "quadruped"),
        ("Unitree Go2", "go2"),
        ("`examples/humanoid`", "humanoid"),
        ("Unitree H1", "h1"),
    ],
)
def test_the_other_robots_are_told_as_their_file_has_them(start, robot):
    runs = json.loads(ROBOTS.read_text())["all"][robot]
    each = {
        name: [runs[trajectory]["sets"][name]["standin-even"] for trajectory in COMMANDS]
        for name in ("nominal", "best")
    }
    changes = [one["change"]["nominal"] for one in each["best"]]
    parts = [(change, *(change["parts"][part] for part in ERRORS)) for change in changes]
    falls = [sum(one["falls"] for one in ones) for ones in each.values()]
    walks = sum(len(one["seeds"]) for one in each["best"])
    assert cells(start) == [
        "{}, {}".format(*falls),
        *(", ".join(f"{x['median']:+.0f}" for x in column) for column in zip(*parts, strict=True)),
    ]
    assert f"falls in {walks} walks" in README
    assert f"on {len(each['best'][0]['seeds'])} simulated robots each" in TEXT


def test_robots_tuned_for_straight_are_told_as_their_file_has_them():
    robots = json.loads(ROBOTS.read_text())
    runs = robots["straight"].items()
    tuned = {name: one["straight"]["sets"]["best"]["standin"] for name, one in runs}
    told = "Spot {spot}, Go2 {go2}, Go1 {go1}, T1 {t1}, B2 {b2}, ANYmal B {anymal_b}, "
    told += "ANYmal C {anymal_c}, Adam Lite {adam_lite}, G1 {g1} %; no fall"
    changes = {n: f"{one['change']['nominal']['median']:+.0f}" for n, one in tuned.items()}
    assert told.format(**changes) in TEXT
    assert {(len(one["seeds"]), one["falls"]) for one in tuned.values()} == {(8, 0)}
    assert "Loss on straight, tuned for it, on 8 each:" in TEXT
    on_s = {name: one["s"]["sets"]["nominal"]["standin"]["falls"] for name, one in runs}
    assert {name for name, falls in on_s.items() if falls} == {"g1", "t1", "adam_lite"}
    more = [one["sets"] for one in robots["more_on_s"].values()]
    falls = [sum(one[n]["standin-even"]["falls"] for one in more) for n in ("nominal", "best")]
    assert falls == [1, 0]
    assert {len(one["best"]["standin-even"]["seeds"]) for one in more} == {64}
    assert "On 64 others, on S, the two quadrupeds together fall once before, never after" in TEXT


def test_the_race_is_told_as_its_file_has_it():
    race = json.loads(RACE.read_text())["s"]
    at = {
        method: {walks: float(np.median(x)) / 1e6 for walks, x in one["own"].items()}
        for method, one in race.items()
    }
    ours, bayes = at["nominal walks"], at["nominal turbo on model"]
    evolution = min(at["nominal cma-es"]["200"], at["nominal lq-cma-es"]["200"])
    assert f"loss then [1e6], from {ours['0']:.2f} |" in README
    assert cells("Bayesian optimisation")[0] == f"200: {bayes['200']:.2f}"
    assert cells("CMA-ES (better of plain and lq-CMA-ES)")[0] == f"200: {evolution:.2f}"
    assert cells("`hector tune --walks`")[0] == f"5: {ours['5']:.2f}"
    assert cells("`hector tune`")[0].startswith(f"{CollectConfig().walks}, once")
    assert ours["5"] < min(bayes["200"], evolution)  # as the picture's words have it


def test_the_robot_and_its_mpc_are_those_of_the_readme():
    robot = load_robot()
    config = walk_config(robot)
    mpc, tick = config.mpc, config.gait.tick
    assert f"a biped of {float(robot.mass):.0f} kg with ten motors" in TEXT
    assert len(robot.description.joints) == 10
    assert (mpc.horizon, mpc.step_ticks, tick) == (10, 3, 0.01)
    assert "ten steps of 30 ms" in TEXT
    assert "a plan every 10 ms" in TEXT
    weights = nominal(robot)
    state, wrench = (sum(x.size for x in jax.tree.leaves(tree)) for tree in (weights.Q, weights.R))
    assert f"the {state + wrench // 2} weights of Q and R" in TEXT  # R is that of both feet
    assert "50 on attitude and position, 1 on rates" in TEXT
    assert {*weights.Q.euler, *weights.Q.position} == {50.0}
    assert {*weights.Q.ang_velocity, *weights.Q.velocity} == {1.0}
