"""Numbers of a user's controller: how they are given, reach his programs and are tuned."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import jax
import numpy as np
import pytest
from model import AHEAD, ANCHOR, BRIEF, HEIGHT, PLAIN, ROBOT
from pretend import call, refused, walking_program

from hector_jax.control.controller import walk_config
from hector_jax.control.parameters import gradient_by_steps, nudged, numbers_of
from hector_jax.control.weights import nominal
from hector_jax.control.weights_file import load_weights, save_weights, with_numbers
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import no_samples
from hector_jax.own.planner import plan_inputs
from hector_jax.own.walk_log import evaluate_log, log_of, trajectory_of
from hector_jax.own.walker import _request
from hector_jax.robot.description import description_of
from hector_jax.robot.numbers import Number
from hector_jax.sim.engine import MUJOCO_C
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs
from hector_jax.tuning.called import Planned, call_along
from hector_jax.tuning.curvature import least_squares_jit
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.grounded import fit_grounding, grounded_rollout
from hector_jax.tuning.loss import PAPER_LOSS, with_alphas
from hector_jax.tuning.rollout import Scenario
from hector_jax.walk_tuning import walks
from hector_jax.walk_tuning.campaign import Campaign
from hector_jax.walk_tuning.moved import (
    Moved,
    changed_by,
    numbers_by_walks,
    residuals_of,
    walks_needed,
)

NUMBERS = (
    ("KP", Number(30.0, 10.0, 300.0, "log")),
    ("LEAN", Number(0.5, 0.0, 1.0)),
    ("FEEDBACK", Number(0.12, 0.0, 0.4, used_by="plan")),
)
OWN = ROBOT._replace(description=replace(ROBOT.description, numbers=NUMBERS))
START = with_numbers(nominal(OWN), OWN)
OTHERS = numbers_of(OWN.description)
LOSS = with_alphas({"L_ctrl": 0.0})  # the toy's commands are not those of the twin
CONFIG = TuneConfig(rollout=BRIEF, loss=LOSS, least_gain=1e-6, others=OTHERS)
SECONDS, POOL = 0.05, ThreadPoolExecutor(1)
WALKED = []  # seed and numbers of the walks of the toy


def table(**changes):
    return {
        "model": "hector.xml",
        "numbers": {"KP": {"start": 60, "low": 10, "high": 300} | changes},
    }


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"low": 70}, "numbers: KP: start must be from 70 to 300, got 60"),
        ({"high": 5}, "numbers: KP: low must be less than high, got 10 and 5"),
        ({"low": 0, "scale": "log"}, "numbers: KP: low must be above 0 with the scale log, got 0"),
        ({"scale": "cubic"}, "numbers: KP: scale must be 'linear' or 'log', got 'cubic'"),
        ({"used_by": "feet"}, "numbers: KP: used_by must be 'legs' or 'plan', got 'feet'"),
        ({"start": "soft"}, "numbers: KP: start must be a number"),
        ({"unit": "N"}, "numbers: KP: unknown field 'unit'"),
    ],
)
def test_a_wrong_number_is_one_line(tmp_path, changes, told):
    with pytest.raises(InputError) as error:
        description_of(tmp_path / "mine.toml", table(**changes))
    assert str(error.value).startswith(f"{tmp_path / 'mine.toml'}: {told}")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("kp", "kp is a number of this project's controller: give yours another name"),
        ("cost_mine", "cost_mine is a number of this project's controller"),
        ("a b", "the name of a number must be letters, digits and _, got 'a b'"),
    ],
)
def test_a_name_is_one_of_its_own(tmp_path, name, told):
    one = {"model": "hector.xml", "numbers": {name: {"start": 1, "low": 0, "high": 2}}}
    with pytest.raises(InputError, match=told):
        numbers_of(description_of(tmp_path / "mine.toml", one))


def test_a_weights_file_has_them_or_takes_their_start(tmp_path):
    path = tmp_path / "mine.json"
    save_weights(path, nominal(OWN)._replace(others={"KP": np.array(90.0)}))
    found = load_weights(path, OWN)
    assert {n: float(x) for n, x in found.others.items()} == {
        "KP": 90.0,
        "LEAN": 0.5,
        "FEEDBACK": 0.12,
    }
    save_weights(path, nominal(OWN)._replace(others={"KP": np.array(9.0)}))
    with pytest.raises(InputError, match=r"others.KP must be a number from 10 to 300, got 9"):
        load_weights(path, OWN)
    with pytest.raises(InputError, match="unknown weight 'others.KP'"):
        load_weights(path, ROBOT)


def test_this_controller_has_no_such_number(tmp_path, monkeypatch, capsys):
    with pytest.raises(InputError, match="KP is a number of a controller of your own, which walks"):
        walk_config(OWN).parameters(START)
    (tmp_path / "hector.xml").write_bytes(ROBOT.description.model.read_bytes())
    path = tmp_path / "mine.toml"
    path.write_text('model = "hector.xml"\n[numbers.KP]\nstart = 60\nlow = 10\nhigh = 300\n')
    save_weights(weights := tmp_path / "w.json", nominal(ROBOT))
    for line, told in (
        (("tune", "--robot", path), f"{path}: [numbers] are of a controller of your own"),
        (("walk", "--robot", path), f"{path}: [numbers] are of a controller of your own"),
        (("evaluate", "--robot", path), f"{path}: [numbers] are of a controller of your own"),
        (
            ("export", weights, "--robot", path),
            "which is not exported, but they are to a file of yours: --into",
        ),
        (
            ("propose", tmp_path, "--start", "nominal", "--robot", path),
            "KP need slopes by walks",
        ),
        (
            ("tune", "--robot", path, "--walker", __file__, "--walks", 2),
            "at least 3 (1 command on 1 plant, twice, and with 1 number moved), got 2",
        ),
    ):
        assert told in refused(monkeypatch, capsys, *line)


def test_a_number_is_moved_within_its_box():
    for value, size, step in ((30.0, 0.1, 0.1), (300.0, 0.1, -0.1), (295.0, 9.0, np.log(10 / 295))):
        at = START._replace(others={**START.others, "KP": np.array(value)})
        moved, found = nudged(at, OTHERS[:1], [-1], size)
        assert found == pytest.approx(step)
        assert float(moved.others["KP"]) == pytest.approx(value * np.exp(step))
        assert jax.tree.all(jax.tree.map(np.array_equal, moved[:2], at[:2]))
        assert moved.others["LEAN"] == at.others["LEAN"]


def test_the_programs_get_them():
    asked = _request(Job(START, AHEAD, hfs(ROBOT.description), SECONDS))
    assert json.loads(json.dumps(asked))["weights"]["others"]["KP"] == 30.0


# On a toy, whose walks are off to the left by its number KP and off ahead by LEAN


def toy_walk(weights, seconds=SECONDS):
    count = round(seconds / 0.01)
    kp, lean = (float(weights.others[name]) for name in ("KP", "LEAN"))
    off = np.array([0.04 * (lean - 0.2), 0.02 * np.log(kp / 60.0) + 0.01, 0.0])
    still = jax.tree.map(lambda x: np.zeros((count, *x.shape[1:]), x.dtype), no_samples(10, 2))
    t = 0.01 * np.arange(1, count + 1)[:, None]
    start = np.array([0.0, 0.0, float(ROBOT.standing_height)])
    ahead = np.array([*AHEAD.velocity[0], 0.0])
    state = still.state._replace(position=start + t * ahead + off * t / seconds)
    force = np.full((count, 2, 3), [0.0, 0.0, 0.5 * float(ROBOT.mass * ROBOT.gravity[2])])
    return still._replace(
        period=np.array(0.01),
        initial=jax.tree.map(lambda x: x[0], still.state)._replace(position=start),
        state=state,
        command=still.command._replace(force=force),
        contact=np.ones((count, 2), bool),
        fallen=np.zeros(count, bool),
    )


def toy_walks(pool, config, robot, jobs, **options):
    return (toy_walk(job.weights) for job in jobs)


def toy_log(weights):
    return evaluate_log(CONFIG, OWN, AHEAD, log_of(toy_walk(weights)))


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A campaign of the toy, and the list of its walks."""
    WALKED.clear()
    real = walks.walk_case

    def noted(campaign, weights, case):
        WALKED.append((case, *(float(x) for x in weights.others.values())))
        return real(campaign, weights, case)

    monkeypatch.setattr(walks, "walk_case", noted)
    engine = MUJOCO_C._replace(name="toy", walk=toy_walks)
    numbers = tuple(of._replace(path="legs") for of in OTHERS)  # without a planner
    config = replace(CONFIG, others=numbers)
    options = {"plants": [hfs(), hfs()], "engine": engine}
    return Campaign(tmp_path, config, OWN, START, {"short": AHEAD}, **options), WALKED


def test_a_slope_by_walks_is_that_of_the_loss(toy):
    one, _ = toy
    log = toy_log(START).log
    moved = {}
    for of in OTHERS[:2]:
        there, step = nudged(START, [of], [-1], 0.1)
        moved[of.name] = Moved((18 + OTHERS.index(of),), step, log, toy_log(there).log)
    found, matrix = walks.slope_of_walk(one, START, 0, log, moved)

    def square(log):
        return sum(float(np.sum(x**2)) for x in residuals_of(CONFIG, OWN, AHEAD, log))

    assert float(found.loss) == pytest.approx(square(log), rel=1e-9)
    slope = np.asarray(gradient_by_steps(START, found.gradient, one.config.others))[-3:]
    for i, of in enumerate(OTHERS[:2]):
        sides = [square(toy_log(nudged(START, [of], [-1], 1e-3)[0]).log)]
        down = np.exp(-1e-3) * 30.0 if of.log else 0.5 - 1e-3
        at = START._replace(others={**START.others, of.name: np.array(down)})
        sides.append(square(toy_log(at).log))
        central = (sides[0] - sides[1]) / 2e-3
        curvature = (sides[0] + sides[1] - 2.0 * square(log)) / 1e-6
        assert slope[i] == pytest.approx(central, rel=1e-4)
        assert matrix[-3 + i, -3 + i] == pytest.approx(curvature, rel=1e-3)
    assert slope[2] == 0.0  # was not moved


def test_of_two_walks_out_of_step_only_the_size_of_the_ripple_counts():
    """With a mean of 3 and a ripple of 1 that becomes 2 and 1.2, at another frequency."""
    t = 0.01 * np.arange(1, 401)[:, None]
    before = 3.0 + np.sin(2.0 * np.pi * t / 0.25)
    after = 2.0 + 1.2 * np.sin(2.0 * np.pi * t / 0.125)
    change = changed_by(before, before, after, 50)
    np.testing.assert_allclose(change, -1.0 + 0.2 * (before - 3.0), atol=1e-9)
    assert np.sum((before + change) ** 2) == pytest.approx(np.sum(after**2), rel=1e-9)
    np.testing.assert_array_equal(changed_by(before, before, before, 50), np.zeros_like(before))


def test_walks_find_the_numbers_and_are_not_made_twice(toy):
    one, walked = toy
    budget = 24
    first = walks.tune_on_walks(POOL, one, walks=budget)
    best = first.sets[first.best].weights.others
    # off by nothing: exp(-0.5) of 60, and 0.2
    assert float(best["KP"]) == pytest.approx(60.0 * np.exp(-0.5), rel=0.05)
    assert float(best["LEAN"]) == pytest.approx(0.2, abs=0.05)
    assert first.reason
    assert len(walked) <= budget
    accepted = sum(x.accepted for x in first.sets)
    start, later = walks_needed(2, 3)
    assert len(walked) <= start + later * (accepted - 1) + 2 * (len(first.sets) - accepted)
    assert accepted > 1
    before = list(walked)
    again = walks.tune_on_walks(POOL, one, walks=budget)
    assert walked == before
    assert again.rows == first.rows


def test_a_tuning_that_is_killed_goes_on_without_a_walk_made_twice(toy, monkeypatch):
    one, walked = toy
    whole = walks.tune_on_walks(POOL, one, walks=20)
    made = sorted(walked)
    for number in (1, 5, len(made) - 1):
        walked.clear()
        other, real = replace(one, folder=one.folder / str(number)), walks.walk_case

        def killed(*inputs, real=real, number=number):
            if len(walked) == number:
                raise KeyboardInterrupt
            return real(*inputs)

        with monkeypatch.context() as patch:
            patch.setattr(walks, "walk_case", killed)
            with pytest.raises(KeyboardInterrupt):
                walks.tune_on_walks(POOL, other, walks=20)
        assert walks.tune_on_walks(POOL, other, walks=20).rows == whole.rows
        assert sorted(walked) == made


# The planner


def test_a_number_of_the_plan_is_moved_in_the_calls():
    walked, asked = trajectory_of(toy_log(START).log), []
    inputs = plan_inputs(BRIEF.walk, OWN, START, AHEAD, walked)

    def linear(of):
        asked.append(of)
        force = of.weights.others["FEEDBACK"][:, None, None] * np.ones((1, 2, 3))
        zero = np.zeros_like(force)
        return Planned(force, of.weights.others["KP"][:, None, None] + zero, zero)

    plans = [of for of in OTHERS if not of.of_legs]
    called = call_along(linear, inputs, np.ones(len(inputs.time), bool), plans)
    assert asked[0].weights.others["KP"].shape == asked[0].time.shape
    assert [of.name for of in numbers_by_walks(OTHERS)] == ["KP", "LEAN"]
    by_number = called.slopes[..., -3:]  # FEEDBACK, KP, LEAN
    np.testing.assert_allclose(by_number[..., :3, 0], 1.0, atol=1e-9)
    assert not by_number[..., 3:, 0].any()
    assert not by_number[..., 1:].any()  # of the legs
    scenario = Scenario(OWN, AHEAD, ANCHOR, PLAIN)
    grounding = fit_grounding(BRIEF, scenario, START, walked, called=called)
    options = {"walk": grounded_rollout, "others": tuple(OTHERS)}
    found, _ = least_squares_jit(BRIEF, grounding, START, PAPER_LOSS, **options)
    slope = np.asarray(gradient_by_steps(START, found.gradient, OTHERS))[-3:]
    size = 1e-6

    def loss(feedback):
        at = START._replace(others={**START.others, "FEEDBACK": np.array(feedback)})
        return float(least_squares_jit(BRIEF, grounding, at, PAPER_LOSS, **options)[0].loss)

    central = (loss(0.12 + size) - loss(0.12 - size)) / (2.0 * size) * 0.4  # of its box
    assert slope[2] == pytest.approx(central, rel=1e-3)
    assert not slope[:2].any()


# From the command line


@pytest.mark.slow  # the model of a walk of 4 s is compiled
def test_hector_tune_finds_a_number_by_walks(tmp_path, monkeypatch, capsys):
    (tmp_path / "hector.xml").write_bytes(ROBOT.description.model.read_bytes())
    robot, walker = tmp_path / "mine.toml", tmp_path / "mine.py"
    number = "[numbers.KP]\nstart = 40\nlow = 10\nhigh = 300\nscale = 'log'\n"
    robot.write_text(f"name = 'mine'\nmodel = 'hector.xml'\n{number}")
    off = '0.01 * np.log(request["weights"]["others"]["KP"] / 60.0) + 0.002'
    walker.write_text(walking_program(off, HEIGHT) + "np.savez(sys.argv[2], **log)\n")
    line = ("tune", "--walker", walker, "--robot", robot, "--walks", 12, "--seeds", 1)
    assert call(monkeypatch, *line, "--out", tmp_path / "run", "--json") == 0
    out, err = capsys.readouterr()
    assert "the slopes by KP are by walks: the first set takes 2 walks" in " ".join(err.split())
    found = json.loads(out)
    assert found["sets"]["best"]["standin"]["falls"] == 0
    best = json.loads((tmp_path / "run" / "weights" / "best.json").read_text())
    assert best["others"]["KP"] == pytest.approx(60.0 * np.exp(-0.2), rel=0.1)
