"""What a log foretells of weights that have not walked: the forecast, its interval, the command."""

import json
import runpy
from functools import cache
from pathlib import Path

import jax
import numpy as np
import pytest
from model import ROBOT
from pretend import call, pretend_verdict, refused

from hector_jax import InputError, Job, RolloutConfig, TuneConfig, expert, named_command, nominal
from hector_jax.own.walk_log import at_ticks, evaluate_log, log_of
from hector_jax.report.report import elsewhere_line
from hector_jax.sim.walk import walk
from hector_jax.sim.world import ideal
from hector_jax.verdict import foretell as module
from hector_jax.verdict.foretell import (
    HERE,
    Carried,
    carry,
    forecast,
    foretell,
    interval,
    log_ratio,
    quantities,
    widening,
)
from hector_jax.verdict.metrics import Interval

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
REPORTS = EXPERIMENTS / "reports"
CONFIG = TuneConfig(rollout=RolloutConfig(ticks=150))
LARGEST = module._calibration()["pairs"][HERE]["largest"]
GAINS = {"horizontal_gain": 10.0, "height_gain": 40.0, "tilt_gain": 100.0, "yaw_gain": 50.0}


@cache
def logged(name):
    """The log of a walk in MuJoCo."""
    sets = {"nominal": nominal(), "expert": expert()}
    sets["gains"] = nominal()._replace(others={x: np.array(value) for x, value in GAINS.items()})
    job = Job(sets[name], named_command("straight"), ideal(), 1.5)
    log = jax.tree.map(np.asarray, log_of(walk(CONFIG.rollout.walk, ROBOT, job)))
    return sets[name], log


def foretold(walked, sets, log=None):
    weights, own = logged(walked)
    log = at_ticks(own if log is None else log, 0.01)
    return foretell(CONFIG, ROBOT, named_command("straight"), log, sets, walked=weights)


def loss(name):
    return evaluate_log(CONFIG, ROBOT, named_command("straight"), logged(name)[1]).loss


def test_a_log_foretells_its_own_walk_and_that_of_other_weights():
    found = foretold("nominal", {"nominal": nominal(), "expert": expert()})
    assert float(found.walked.L) == pytest.approx(loss("nominal"), rel=0.03)  # but for a tick
    same = {
        x: log_ratio(y, quantities(found.walked)[x]) for x, y in quantities(found.walked).items()
    }
    assert same == dict.fromkeys(same, 0.0)
    said = log_ratio(float(found.scores["expert"].L), float(found.walked.L))
    assert said == pytest.approx(np.log(loss("expert") / loss("nominal")), abs=0.1)
    assert found.distances == {"nominal": 0.0, "expert": pytest.approx(found.distances["expert"])}
    assert 0.0 < found.margins["expert"][0] < 0.5
    assert found.margins["expert"][1] > 1.2


def test_a_number_that_a_set_lacks_is_the_controllers_and_not_that_of_the_log():
    none = nominal()._replace(others={name: np.array(0.0) for name in GAINS})
    found = foretold("gains", {"nominal": nominal(), "none": none, "gains": logged("gains")[0]})
    assert float(found.scores["nominal"].L) == float(found.scores["none"].L)
    assert float(found.scores["gains"].L) == float(found.walked.L)
    assert float(found.scores["gains"].L) != float(found.scores["none"].L)


def test_what_no_plan_depends_on_is_refused_by_its_name():
    stiff = expert()._replace(others={"foot_height": np.array(0.15)})
    with pytest.raises(InputError, match="stiff: foot_height differs from that of the log"):
        foretold("nominal", {"stiff": stiff})
    same = expert()._replace(others={"foot_height": np.array(CONFIG.rollout.walk.legs.height)})
    assert foretold("nominal", {"same": same}).scores.keys() == {"same"}
    _, log = logged("nominal")
    fell = log._replace(fallen=np.ones_like(log.fallen))
    with pytest.raises(InputError, match="fell in the log"):
        foretold("nominal", {"expert": expert()}, fell)


def test_an_interval_holds_its_share_of_what_is_drawn_alike():
    rng, held = np.random.default_rng(0), []

    def pairs(count):
        said = rng.normal(-0.5, 0.5, count)
        return np.stack([said, said + (0.3 + np.abs(said)) * 0.1 * rng.standard_t(3, count)], 1)

    for _ in range(300):
        (said, came), known = pairs(1)[0], pairs(79)
        found = interval(said, known)
        assert found.low < found.value == said < found.high
        held.append(found.low <= came <= found.high)
    assert 0.85 <= np.mean(held) <= 0.95
    assert np.isnan(interval(-0.5, pairs(module.FEWEST - 1)).low)


def test_a_foretold_fall_and_weights_too_far_away_have_no_interval():
    found = foretold("nominal", {"expert": expert()})
    ends = forecast(found, "expert", HERE)
    assert all(x.low < x.value < x.high for x in ends.values())
    score = found.scores["expert"]._replace(fallen=np.array(True))
    fell = forecast(found._replace(scores={"expert": score}), "expert", HERE)
    assert all(np.isnan(x.low) and x.value == ends[name].value for name, x in fell.items())
    still = found._replace(walked=found.walked._replace(rms_euler=np.zeros(3)))
    assert np.isnan(forecast(still, "expert", HERE)["pitch"].value)
    far = found._replace(distances={"expert": 5.0})
    with pytest.raises(InputError, match=r"expert: 148.4 times .* measured up to"):
        forecast(far, "expert", HERE)


def test_a_log_unlike_those_that_were_measured_has_wider_intervals():
    found = foretold("nominal", {"expert": expert()})
    assert 0.0 < found.unexplained < LARGEST
    assert widening(found, HERE) == 1.0
    odd = found._replace(unexplained=2.0 * LARGEST)
    assert widening(odd, HERE) == pytest.approx(2.0)
    pairs = zip(*(forecast(x, "expert", HERE).values() for x in (found, odd)), strict=True)
    for usual, wide in pairs:
        assert wide.value == usual.value
        assert wide.high - wide.low == pytest.approx(2.0 * (usual.high - usual.low))


def test_what_carries_over_to_other_engines_and_masses_is_that_of_the_verdict():
    columns = json.loads((REPORTS / "verdict" / "verdict.json").read_text())["columns"]
    script = runpy.run_path(str(EXPERIMENTS / "foretell.py"))
    assert script["carried_pairs"](columns) == module._calibration()["pairs"]["carried"]
    carried = carry(pretend_verdict(8), "with")
    assert 0.85 <= carried.held / carried.walks <= 0.95
    (change,) = carried.change.values()
    assert change.low < change.value < change.high
    line = elsewhere_line(carried)
    assert line.startswith("On a robot that is not this simulator expect ")
    assert f"(90 %; held in {carried.held} of {carried.walks} walks of other sets" in line
    less = Carried({"s": Interval(-70.0, -79.2, -63.4)}, 58, 64)
    assert "63 to 79 % less loss than with nominal on s (90 %; held in 58 of 64" in elsewhere_line(
        less
    )
    either = Carried({"s": Interval(-1.0, -8.0, 6.0)}, 58, 64)
    assert "up to 8 % less or 6 % more loss" in elsewhere_line(either)
    assert carry(pretend_verdict(8, {("with", i) for i in range(8)}), "with").change == {}
    assert elsewhere_line(Carried({}, 58, 64)) == ""


@pytest.mark.slow
def test_the_command_tells_errors_with_intervals_or_why_a_log_foretells_nothing(
    monkeypatch, capsys, tmp_path
):
    log, seconds = tmp_path / "log.npz", ("--seconds", "2")
    assert call(monkeypatch, "walk", "--world", "hfs", *seconds, "--out", log) == 0
    capsys.readouterr()
    words = "log", "foretell", log, *seconds, "--weights", "expert", "shipped"
    assert call(monkeypatch, *words, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["calibration"] == HERE
    for name in ("expert", "shipped"):
        plane = result["sets"][name]["plane"]
        assert plane["low"] < plane["value"] < plane["high"]
        assert not result["sets"][name]["falls"]
    assert result["sets"]["shipped"]["L"]["change"]["high"] < 0.0
    assert call(monkeypatch, *words) == 0
    told = capsys.readouterr().out
    assert "nominal (walked)" in told
    assert "in brackets 90 % intervals" in told
    with np.load(log, allow_pickle=False) as archive:
        parts = {name: archive[name] for name in archive.files if name != "card"}
    forces = {name: parts[name] for name in ("command.force", "effect.force")}
    for name, faulty in {
        "legs": {"joints": np.roll(parts["joints"], 5, axis=1)},
        "mass": {name: 1.25 * force for name, force in forces.items()},
        "late": {"effect.force": np.roll(forces["effect.force"], 20, axis=0)},
    }.items():
        np.savez(tmp_path / f"{name}.npz", **parts | faulty)
        line = refused(monkeypatch, capsys, "log", "foretell", tmp_path / f"{name}.npz", *seconds)
        assert f"{name}.npz foretells nothing: " in line
