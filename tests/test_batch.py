"""Many tunings at once: each as if alone, on any number of devices; on a toy and the rigid body."""

import os
import socket
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lib import sample_weights
from model import mean_of

from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import directions, nominal, vector_to_weights, weights_to_vector
from hector_jax.core.tree import stack
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.tuning import batch, difftune
from hector_jax.tuning.batch import (
    PER_CALL,
    BatchProblem,
    BatchScenario,
    choose_rollout,
    tail_weights,
    tune_batch,
)
from hector_jax.tuning.difftune import TuneConfig, tune
from hector_jax.tuning.evaluate import Evaluation, Objective
from hector_jax.tuning.loss import PAPER_LOSS, with_alphas
from hector_jax.tuning.parallel_rollout import parallel_rollout
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout
from hector_jax.tuning.status import StepStatus, Stop
from hector_jax.tuning.variation import no_variation

ROBOT = load_robot()
ANCHOR = standing_anchor(ROBOT)
STARTS = [sample_weights(nominal(), factor, 1)[0] for factor in (1.05, 1.2, 1.5, 2.0, 3.0)]
TOY = TuneConfig(iterations=40, ridge=0.001)
RULES = (TOY, replace(TOY, rule="relative"))
NOMINAL = np.asarray(weights_to_vector(nominal()))


def vector(weights):
    return np.asarray(weights_to_vector(weights))


def toy(config, scenario, weights, loss, *, walk=None):
    """A bowl in log-weights about a point that the command moves; with a floor under it."""
    middle = np.log(NOMINAL) + 0.3 * jnp.asarray(scenario.command.yaw_rate)[0]
    away = jnp.log(weights_to_vector(weights)) - middle
    scale = loss[0].weight
    gradient = vector_to_weights(2.0 * scale * away / weights_to_vector(weights))
    loss = scale * (0.1 + away @ away)
    falls = 1.0 * (weights_to_vector(weights)[0] > 1e3)
    return Evaluation(
        loss, dict.fromkeys(("L_Eul", "L_pos", "L_ctrl"), loss), gradient, falls, jnp.asarray(1e-12)
    )


def toy_matrix(config, scenario, weights, loss, *, walk=None, others=()):
    """Thrice the curvature of the bowl in the log-steps: steps are short and so are many."""
    shared = jnp.asarray(np.pad(directions(), ((0, len(others)), (0, 0))))
    along = jnp.diag(jnp.r_[jnp.zeros(18), jnp.full(len(others), 8.0)])
    return 3.0 * loss[0].weight * (2.0 * shared @ shared.T + along)


def use(monkeypatch, evaluate, matrix=toy_matrix):
    monkeypatch.setattr(batch, "evaluate", evaluate)
    monkeypatch.setattr(batch, "gauss_newton", matrix)
    monkeypatch.setattr(difftune, "evaluate_jit", jax.jit(evaluate, static_argnums=0))
    jitted = jax.jit(matrix, static_argnums=0, static_argnames="others")
    monkeypatch.setattr(difftune, "gauss_newton_jit", jitted)


@pytest.fixture
def on_toy(monkeypatch):
    use(monkeypatch, toy)


def scenario(name="straight", loss=PAPER_LOSS, scale=1.0, effect=0, variation=None):
    scale, effect = np.asarray(scale), np.asarray(effect)
    return BatchScenario(named_command(name), ANCHOR, effect, loss, scale, variation)


def alone_on(name):
    """The same for a single tuning."""
    return Scenario(ROBOT, named_command(name), ANCHOR, last_command)


def problem(start, scenarios, tail=1.0):
    return BatchProblem(start, stack(scenarios), np.asarray(tail))


def close(one, other, **tolerances):
    jax.tree.map(partial(np.testing.assert_allclose, **tolerances), one, other)


@pytest.mark.parametrize("config", RULES, ids=lambda config: config.rule)
def test_each_tuning_of_a_batch_is_that_of_a_single_one(on_toy, config):
    names = ["straight", "c", "s", "c", "s"]
    asked = [problem(w, [scenario(n)]) for w, n in zip(STARTS, names, strict=True)]
    found = tune_batch(config, ROBOT, stack(asked), last_command)
    counts = []
    for i, (start, name) in enumerate(zip(STARTS, names, strict=True)):
        alone = tune(config, alone_on(name), start)
        counts.append(len(alone.iterations))
        ours = jax.tree.map(lambda x, i=i: x[i], found)
        history = jax.tree.map(lambda x, n=counts[-1]: x[:n], ours.history)
        close(ours._replace(history=history), alone, rtol=1e-9, atol=1e-12)
        after = jax.tree.map(lambda x, n=counts[-1]: x[n:], ours.history)
        assert not any(np.any(leaf) for leaf in jax.tree.leaves(after))
    assert len(set(counts)) > 1 or config.rule != "gauss_newton"  # some ended before others
    assert max(counts) > PER_CALL
    assert found.history.iteration.shape[1] <= config.iterations + 1


def test_a_batch_tunes_other_numbers_as_a_single_tuning_does(monkeypatch):
    def leaning(config, scenario, weights, loss, *, walk=None):
        """The bowl, and another in the lead of turns, about 1.2."""
        found, lead = toy(config, scenario, weights, loss), weights.others["turn_lead"]
        gradient = found.gradient._replace(others={"turn_lead": 2e6 * (lead - 1.2)})
        return found._replace(loss=found.loss + 1e6 * (lead - 1.2) ** 2, gradient=gradient)

    use(monkeypatch, leaning)
    config = replace(TOY, others=("turn_lead",))
    asked = stack([problem(start, [scenario("c")]) for start in STARTS[:2]])
    found = tune_batch(config, ROBOT, asked, last_command)
    for i, start in enumerate(STARTS[:2]):
        alone = tune(config, alone_on("c"), start)
        assert abs(alone.weights.others["turn_lead"] - 1.2) < 0.2
        close(jax.tree.map(lambda x, i=i: x[i], found.weights), alone.weights, rtol=1e-9)


def test_how_many_walk_side_by_side_does_not_matter(on_toy):
    asked = stack([problem(w, [scenario("c")]) for w in STARTS])
    one, *others = (tune_batch(TOY, ROBOT, asked, last_command, lanes=lanes) for lanes in (1, 2, 0))
    for other in others:
        close(one, other, rtol=1e-9, atol=1e-12)


def test_a_start_that_falls_keeps_itself_and_says_so(on_toy):
    bad = nominal()._replace(Q=nominal().Q._replace(euler=np.array([2e3, 1.0, 1.0])))
    asked = stack([problem(w, [scenario("c")]) for w in (STARTS[0], bad)])
    found = tune_batch(TOY, ROBOT, asked, last_command)
    assert found.stop[1] == Stop.BAD_START
    assert found.history.status[1, 0] == StepStatus.FELL
    np.testing.assert_array_equal(vector(found.weights)[1], vector(bad))
    assert found.stop[0] != Stop.BAD_START


def test_a_batch_has_loss_weights_of_its_own_and_scales_its_losses(on_toy):
    heavy = with_alphas({"L_Eul": 3e5, "L_pos": 0.0})
    asked = [
        problem(STARTS[0], [scenario(loss=a, scale=k)])
        for a, k in ((PAPER_LOSS, 1.0), (heavy, 2.0))
    ]
    found = tune_batch(TOY, ROBOT, stack(asked), last_command)
    first = found.history.evaluation.loss[:, 0]
    assert first[1] == pytest.approx(1.5 * first[0])


def test_the_mean_of_scenarios_is_tuned_by_the_mean_of_their_matrices(on_toy):
    """Of losses that are divided by their own scales, as one tuning on their mean objective."""
    names, scales, config = ("straight", "c"), np.array([0.5, 4.0]), replace(TOY, iterations=39)
    several = [scenario(name, scale=k) for name, k in zip(names, scales, strict=True)]
    found = tune_batch(config, ROBOT, stack([problem(STARTS[2], several)]), last_command)
    each = [difftune.model_objective(config, alone_on(name)) for name in names]

    def divided(objective, k):
        def evaluate(weights):
            seen = objective.evaluate(weights)
            return Evaluation(*jax.tree.map(lambda x: x / k, seen[:3]), *seen[3:])

        return Objective(evaluate, lambda weights: objective.matrix(weights) / k)

    mean = mean_of([divided(o, k) for o, k in zip(each, scales, strict=True)])
    alone = difftune.descend(config, STARTS[2], mean)
    ours = jax.tree.map(lambda x: x[0], found)
    close(ours.weights, alone.weights, rtol=1e-9)
    close(ours.precision, alone.precision, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("tail", "expected"),
    [
        (1.0, [0.25, 0.25, 0.25, 0.25]),
        (0.5, [0.0, 0.5, 0.5, 0.0]),
        (0.625, [0.2, 0.4, 0.4, 0.0]),
        (0.25, [0.0, 1.0, 0.0, 0.0]),
        (0.0, [0.0, 1.0, 0.0, 0.0]),
    ],
)
def test_the_tail_is_the_mean_over_the_worst_share(tail, expected):
    found = tail_weights(jnp.array([2.0, 9.0, 5.0, 1.0]), jnp.asarray(tail))
    np.testing.assert_allclose(found, expected)


def test_a_gpu_walks_the_ticks_of_few_rollouts_at_once():
    config = RolloutConfig(ticks=350, lead=50)
    assert choose_rollout("gpu", config, 8) is parallel_rollout
    assert choose_rollout("gpu", config, 9) is rollout
    assert choose_rollout("cpu", config, 1) is rollout


TWO_DEVICES = """
import sys, numpy as np, jax
from functools import partial
from hector_jax.core.runtime import setup_jax
setup_jax()
import test_batch as t
if sys.argv[1] == "toy":
    t.batch.evaluate, t.batch.gauss_newton = t.toy, t.toy_matrix
config, asked = t.shared_case(sys.argv[1])
assert len(jax.devices()) == 2
one, two = (
    t.tune_batch(config, t.ROBOT, asked, t.last_command, devices=jax.devices()[:n]) for n in (1, 2)
)
# a program of another batch size may round otherwise
jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-12), one, two)
print("same", one.stop.tolist())
"""


def shared_case(kind):
    """An odd number of problems: one device has one more to do."""
    asked = stack([problem(w, [scenario("s")]) for w in STARTS[:3]])
    short = TuneConfig(rollout=RolloutConfig(ticks=40), iterations=2)
    return (TOY if kind == "toy" else short), asked


@pytest.mark.parametrize("kind", ["toy", pytest.param("rigid body", marks=pytest.mark.slow)])
def test_two_devices_give_the_numbers_of_one(kind):
    here = Path(__file__).parent
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    root = here.parent
    own = map(str, (here, root, root / "experiments"))
    paths = os.pathsep.join([*own, os.environ.get("PYTHONPATH", "")])
    ran = subprocess.run(
        [sys.executable, "-c", TWO_DEVICES, kind],
        env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    assert ran.stdout.startswith("same")


TWO_HOSTS = """
from experiments.lib import all_devices
from hector_jax.core.runtime import setup_jax
setup_jax()
all_devices()
import jax, numpy as np
import test_batch as t
t.batch.evaluate, t.batch.gauss_newton = t.toy, t.toy_matrix
config, asked = t.shared_case("toy")
assert jax.process_count() == 2 and len(jax.devices()) == 2 * len(jax.local_devices())
found = t.tune_batch(config, t.ROBOT, asked, t.last_command)
alone = t.tune_batch(config, t.ROBOT, asked, t.last_command, devices=jax.local_devices()[:1])
jax.tree.map(np.testing.assert_array_equal, found, alone)
print("same")
"""


@pytest.mark.slow  # two processes that wait for each other
def test_two_hosts_give_the_numbers_of_one():
    here = Path(__file__).parent
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    root = here.parent
    own = map(str, (here, root, root / "experiments"))
    paths = os.pathsep.join([*own, os.environ.get("PYTHONPATH", "")])
    shared = {"JAX_PLATFORMS": "cpu", "PYTHONPATH": paths, "JAX_COORDINATOR_ADDRESS": address}
    hosts = [
        subprocess.Popen(
            [sys.executable, "-c", TWO_HOSTS],
            env={**os.environ, **shared, "JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": str(i)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(2)
    ]
    for host in hosts:
        told, wrong = host.communicate(timeout=300)
        assert told.strip().endswith("same"), wrong[-2000:]


@pytest.mark.slow  # minutes of compilation
def test_on_the_rigid_body_a_batch_is_its_single_tunings():
    config = TuneConfig(rollout=RolloutConfig(ticks=40), iterations=2)
    names = ("straight", "s")
    asked = stack([problem(nominal(), [scenario(name)]) for name in names])
    found = tune_batch(config, ROBOT, asked, last_command)
    for i, name in enumerate(names):
        alone = tune(config, alone_on(name), nominal())
        ours = jax.tree.map(lambda x, i=i: x[i], found)
        np.testing.assert_allclose(vector(ours.weights), vector(alone.weights), rtol=1e-9)
        np.testing.assert_allclose(ours.precision, alone.precision, rtol=1e-6, atol=1e-9)


def test_several_scenarios_are_tuned_between_their_optima(on_toy):
    asked = [problem(nominal(), [scenario("straight"), scenario("c")], tail) for tail in (1.0, 0.0)]
    config = TuneConfig(iterations=60, rule="relative")  # a worst case has no smooth minimum
    found = tune_batch(config, ROBOT, stack(asked), last_command)
    between = 0.3 * 0.25 * np.pi / 2
    logs = np.log(vector(found.weights) / vector(nominal()))
    np.testing.assert_allclose(logs, between, atol=0.03)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"tail": np.array([1.5])}, r"BatchProblem.tail must be from 0 to 1, got 1.5"),
        ({"tail": np.zeros(0)}, "stacked, one per problem"),
        ({"effect": 3}, r"BatchScenario.effect must be below 1, got 3..3"),
        ({"scale": 0.0}, "BatchScenario.scale must be positive"),
        (
            {"variation": no_variation()._replace(delay=np.asarray(0.02))},
            "Variation.delay must be from 0 to a tick of 0.01 s, got 0.02",
        ),
    ],
)
def test_impossible_problems_are_refused(wrong, told):
    tail = wrong.pop("tail", np.ones(1))
    asked = stack([problem(nominal(), [scenario(**wrong)])])._replace(tail=tail)
    with pytest.raises(ValueError, match=told):
        tune_batch(TOY, ROBOT, asked, last_command)


@pytest.mark.slow
def test_a_batch_with_all_ticks_at_once_is_that_of_ticks_in_turn():
    config = TuneConfig(rollout=RolloutConfig(ticks=40), iterations=2)
    asked = stack([problem(w, [scenario("s"), scenario("c")]) for w in STARTS[:2]])
    in_turn, at_once = (
        tune_batch(config, ROBOT, asked, last_command, lanes=0, walk=walk)
        for walk in (rollout, parallel_rollout)
    )
    np.testing.assert_allclose(at_once.loss, in_turn.loss, rtol=1e-9)
    np.testing.assert_allclose(vector(at_once.weights), vector(in_turn.weights), rtol=1e-7)
