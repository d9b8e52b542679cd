"""A controller that is known by calling it: its plans along a walk, and the slope by them."""

from dataclasses import replace
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import ANCHOR, BRIEF, PLAIN, ROBOT

from hector_jax.cli.walker import _call_lines
from hector_jax.control.controller import contacts_needed, plan
from hector_jax.control.parameters import gradient_by_steps, step_names
from hector_jax.control.reference import anchor_at, named_command
from hector_jax.control.weights import nominal
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.inputs import InputError
from hector_jax.own.planner import (
    _closest,
    _convention,
    call_planner,
    called_plans,
    compare_calls,
    distance_to_log,
    plan_inputs,
)
from hector_jax.own.program import program_of
from hector_jax.own.walk_log import at_ticks, log_of, trajectory_of
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.tuning.called import Planned, call_along, call_rows
from hector_jax.tuning.curvature import least_squares_jit
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.grounded import fit_grounding, grounded_rollout
from hector_jax.tuning.loss import PAPER_LOSS
from hector_jax.tuning.rollout import Scenario
from hector_jax.walk_tuning import walks
from hector_jax.walk_tuning.campaign import Campaign

ROLLOUT = replace(BRIEF, ticks=25)
CONFIG, COMMAND, WEIGHTS = BRIEF.walk, named_command("s"), nominal()


@pytest.fixture(scope="module")
def walked():
    job = Job(WEIGHTS, COMMAND, hfs(), ROLLOUT.ticks * CONFIG.gait.tick)
    return trajectory_of(at_ticks(log_of(walk(CONFIG, ROBOT, job)), CONFIG.gait.tick))


@jax.jit
def this_controller(asked):
    """Answer with the plans of this project's controller."""

    def one(row):
        time, state, feet, weights = row
        planned = plan(
            CONFIG,
            ROBOT,
            CONFIG.parameters(weights),
            command=asked.command,
            anchor=anchor_at(ROBOT, asked.initial, 0),
            tick=jnp.round(time / CONFIG.gait.tick).astype(int),
            state=state,
            feet=feet,
            max_contacts=contacts_needed(CONFIG, 0),
        )
        return Planned(*planned.wrench, planned.touchdown.position)

    rows = asked.time, asked.state, asked.feet, asked.weights
    return jax.lax.map(one, jax.tree.map(jnp.asarray, rows), batch_size=64)


def test_the_slope_by_calls_is_that_of_the_controller(walked):
    inputs = plan_inputs(CONFIG, ROBOT, WEIGHTS, COMMAND, walked)
    called = call_along(this_controller, inputs, np.ones(len(inputs.time), bool))
    scenario = Scenario(ROBOT, COMMAND, ANCHOR, PLAIN)
    found = []
    for plans in (None, called):
        grounding = fit_grounding(ROLLOUT, scenario, WEIGHTS, walked, called=plans)
        inputs = ROLLOUT, grounding, WEIGHTS, PAPER_LOSS
        found.append(least_squares_jit(*inputs, walk=grounded_rollout))
    losses = [float(evaluation.loss) for evaluation, _ in found]
    assert losses[1] == pytest.approx(losses[0], rel=1e-9)
    exact, calls = (np.asarray(gradient_by_steps(WEIGHTS, x.gradient)) for x, _ in found)
    assert np.linalg.norm(calls - exact) < 0.03 * np.linalg.norm(exact)
    matrices = [np.asarray(matrix) for _, matrix in found]
    assert np.linalg.norm(matrices[1] - matrices[0]) < 0.05 * np.linalg.norm(matrices[0])


def test_between_plans_the_last_one_is_kept(walked):
    inputs = plan_inputs(CONFIG, ROBOT, WEIGHTS, COMMAND, walked)
    asked = []

    def linear(asked_for):
        asked.append(asked_for)
        force = asked_for.state.position[:, None] * np.ones((1, 2, 1))
        moment = np.log(asked_for.weights.Q.euler)[:, None] * np.ones((1, 2, 1))
        return Planned(force, moment, asked_for.feet.position)

    made = np.arange(len(inputs.time)) % 3 == 1
    called = call_along(linear, inputs, made)
    numbers = len(step_names(WEIGHTS))
    assert asked[0].time.shape == ((1 + 12 + 6 + numbers) * made.sum(),)
    slopes = called.slopes[np.flatnonzero(made)[0]]
    np.testing.assert_allclose(slopes[:, :3, 3:6], np.stack([np.eye(3)] * 2), atol=1e-9)
    np.testing.assert_allclose(slopes[:, 3:6, 18:21], np.stack([np.eye(3)] * 2), atol=1e-9)
    np.testing.assert_allclose(slopes[0, 6:, 12:15], np.eye(3), atol=1e-9)
    assert not np.any(slopes[:, :3, 6:])
    last = jax.tree.map(lambda x: x[2], walked.command)
    tick = jax.tree.map(lambda x: x[2], called)  # of no plan
    now = {"state": jax.tree.map(lambda x: x[2], inputs.state), "last": last}
    feet = jax.tree.map(lambda x: x[2], inputs.feet)
    kept = tick.plan(feet=feet, steps=np.zeros(numbers), disturbance=None, **now)
    np.testing.assert_array_equal(kept.wrench.force, last.force * inputs.contact[2][:, None])
    np.testing.assert_array_equal(kept.touchdown.position, feet.position)


PROGRAM = """
import sys
import numpy as np
asked = np.load(sys.argv[1])
rows = asked["contact"].shape
plans = dict.fromkeys(("force", "moment", "touchdown"), np.zeros((*rows, 3)))
plans["force"] = asked["weights.R.force"]
"""


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("", ""),
        ("plans['force'] = np.full((*rows, 3), np.nan)", ""),
        ("del plans['moment']", "its plans: moment is missing"),
        (
            "plans['force'] = np.full((*rows, 3), np.inf)",
            "its plans: force must hold numbers",
        ),
        ("plans['force'] = plans['force'][:4]", r"its plans: force must .* float64 of \(4, 2, 3\)"),
        ("open(sys.argv[2], 'w').write('x'); sys.exit(0)", "its plans: not a log"),
        ("sys.exit(3)", "ended with code 3"),
        ("sys.exit(0)", r"ended with code 0, but wrote no plans\.npz"),
    ],
)
def test_a_program_plans_or_is_told_what_is_wrong(walked, tmp_path, change, told):
    path = tmp_path / "mine.py"
    path.write_text(f"{PROGRAM}{change}\nnp.savez(sys.argv[2], **plans)\n")
    inputs = plan_inputs(CONFIG, ROBOT, WEIGHTS, COMMAND, walked)
    weights = jax.tree.map(lambda x: np.stack([x] * len(inputs.time)), WEIGHTS)
    asked = inputs._replace(weights=weights)
    call = partial(call_planner, program_of(path, 20.0), asked)
    if told:
        with pytest.raises(InputError, match=f"{path}: {told}"):
            call()
    else:
        assert np.array_equal(call().force, weights.R.force) == (not change)


def answers(walked, change=lambda x: x):
    """Answer with the wrenches of a walk, changed, which no weight and no state moves."""

    def call(asked):
        at = np.round(asked.time / CONFIG.gait.tick).astype(int)
        wrench = np.concatenate(walked.command, axis=-1)[at]
        force, moment = np.split(change(wrench), 2, axis=-1)
        step = asked.state.velocity[:, None] * np.ones((1, 2, 1))
        return Planned(force, moment, step)

    return call


@pytest.mark.parametrize(
    ("change", "fit"),
    [
        (lambda x: x, ()),
        (lambda x: -x, ("reversed",)),
        (lambda x: x[:, ::-1], ("left and right exchanged",)),
        (lambda x: -x[:, ::-1], ("left and right exchanged", "reversed")),
        (lambda x: 1.2 * x, ()),
    ],
)
def test_another_convention_of_the_plans_is_found(walked, change, fit):
    inputs = plan_inputs(CONFIG, ROBOT, WEIGHTS, COMMAND, walked)
    calls = compare_calls(answers(walked, change), CONFIG, ROBOT, inputs, walked)
    assert calls.convention == fit
    assert calls.parity.plans == len(inputs.time)
    assert calls.unused_weights == step_names(WEIGHTS)
    assert (calls.memory, calls.jumps, calls.touchdowns_follow) == (0.0, 0.0, True)


def test_a_planner_that_is_asked_with_other_units_of_its_cost_or_other_angles_is_told(walked):
    rows = np.arange(1, 24)
    logged = np.concatenate(walked.command, axis=-1)[1:][rows]
    for told in ("0.5 times R", "the angles yaw, pitch, roll"):
        turned, factor = told.startswith("the"), 1.0 if told.startswith("the") else 2.0
        weights = WEIGHTS._replace(R=jax.tree.map(lambda x, k=factor: k * x, WEIGHTS.R))
        inputs = plan_inputs(CONFIG, ROBOT, weights, COMMAND, walked)

        def call(asked, turned=turned):
            euler = asked.state.euler[:, ::-1] if turned else asked.state.euler
            return this_controller(asked._replace(state=asked.state._replace(euler=euler)))

        plans = {"logged": logged, "called": call_rows(call, inputs, rows)[..., :6], "least": 0.2}
        words, distance = _convention(call, CONFIG, inputs, rows, **plans)
        assert words == (f"if it is asked with {told}",)
        assert distance < 0.2


@pytest.mark.parametrize(("axes", "into"), [*product(("heading", "trunk"), (True, False))])
def test_axes_of_the_wrenches_are_found(axes, into):
    """Of a robot that turns and leans, with forces that no other convention explains."""
    rng = np.random.default_rng(0)
    euler = np.stack([*rng.normal(size=(2, 30)) * 0.2, np.linspace(0.5, 2.5, 30)], axis=1)
    logged = rng.normal(size=(30, 2, 6))
    angles = euler * [0.0, 0.0, 1.0] if axes == "heading" else euler
    R = np.asarray(jax.vmap(rotation_from_euler)(angles))
    R = R if into else np.swapaxes(R, 1, 2)
    turned = np.einsum("nij,nfpj->nfpi", R, logged.reshape(30, 2, 2, 3)).reshape(30, 2, 6)
    text = f"turned {'into' if into else 'out of'} the {axes}'s axes"
    found, distance = _closest(logged, turned, euler, np.ones((30, 2), bool))
    assert found == (text,)
    assert distance < 1e-12


def test_a_memory_and_jumps_of_a_planner_are_told(walked):
    inputs = plan_inputs(CONFIG, ROBOT, WEIGHTS, COMMAND, walked)

    def warm(asked):
        """Each row begins with the one before it, as a new process does at each call."""
        plans = answers(walked)(asked)
        before = np.concatenate([plans.force[:1], plans.force[:-1]])
        jump = 30.0 * (asked.state.velocity[:, :1, None] % 2e-3 > 1e-3)
        return plans._replace(force=plans.force + 0.1 * before + jump)

    found = compare_calls(warm, CONFIG, ROBOT, inputs, walked)
    assert found.memory > 0.1
    assert found.jumps > 0.1
    text = "\n".join(_call_lines(found))
    assert "the plan has a memory, such as a warm start or a filter" in text
    assert "of the plans jump when" in text


def test_a_plan_that_is_not_solved_is_not_used(walked):
    inputs = plan_inputs(CONFIG, ROBOT, WEIGHTS, COMMAND, walked)
    at = inputs.time[[3, 7]]

    def call(asked):
        plans = answers(walked)(asked)
        lost = np.isin(asked.time, at) & ((asked.time < 0.05) | (np.arange(len(asked.time)) > 24))
        return plans._replace(force=np.where(lost[:, None, None], np.nan, plans.force))

    called = call_along(call, inputs, np.ones(24, bool))
    assert [*np.flatnonzero(~called.made)] == [3]
    assert np.isfinite(called.slopes).all()
    assert np.isfinite(called.values).all()
    never = lambda asked: Planned(*np.full((3, *asked.contact.shape, 3), np.nan))  # noqa: E731
    with pytest.raises(InputError, match="the planner solves no plan of a walk"):
        called_plans(never, CONFIG, inputs)


def test_a_planner_that_is_not_that_of_the_walk_is_noticed_before_a_tuning(walked):
    inputs = plan_inputs(CONFIG, ROBOT, WEIGHTS, COMMAND, walked)
    away = [
        distance_to_log(answers(walked, lambda x, k=k: k * x), CONFIG, inputs, walked)
        for k in (1.0, -1.0)
    ]
    assert away[0] == 0.0
    assert away[1] == pytest.approx(2.0 * np.abs(walked.command.force[1:]).max(), rel=1e-6)


def test_a_walk_of_which_a_planner_gives_no_plans_has_no_slope(walked, tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("raise SystemExit('no solver')")
    config = replace(TuneConfig(), rollout=ROLLOUT)
    planner = program_of(path, 20.0)
    one = Campaign(tmp_path, config, ROBOT, WEIGHTS, {"s": COMMAND}, planner=planner)
    error = walks.slope_of_walk(one, WEIGHTS, 0, log_of(walked))
    assert str(error) == f"{path}: ended with code 1: no solver"
