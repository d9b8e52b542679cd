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
from model import ANCHOR, ROBOT, mean_of, vector

from hector_jax import TuneConfig, last_command, named_command, tune
from hector_jax.control.weights import directions, nominal, vector_to_weights, weights_to_vector
from hector_jax.core.tree import stack
from hector_jax.tuning import batch, difftune
from hector_jax.tuning.batch import PER_CALL, BatchProblem, BatchScenario, tail_weights, tune_batch
from hector_jax.tuning.evaluate import Evaluation, Objective
from hector_jax.tuning.loss import PAPER_LOSS, with_alphas
from hector_jax.tuning.parallel_rollout import parallel_rollout
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout
from hector_jax.tuning.status import StepStatus, Stop
from hector_jax.tuning.variation import no_variation

STARTS = [sample_weights(nominal(), factor, 1)[0] for factor in (1.05, 1.2, 1.5, 2.0, 3.0)]
TOY = TuneConfig(iterations=40, ridge=0.001)
CONFIGS = (TOY, replace(TOY, rule="relative"), replace(TOY, others=("turn_lead",)))
NOMINAL = np.asarray(weights_to_vector(nominal()))


def toy(config, scenario, weights, loss, *, walk=None):
    """A bowl in log-weights about a point that the command moves; with a floor under it.

    Where the lead of turns is tuned, another bowl in it, about 1.2.
    """
    middle = np.log(NOMINAL) + 0.3 * jnp.asarray(scenario.command.yaw_rate)[0]
    away = jnp.log(weights_to_vector(weights)) - middle
    scale = loss[0].weight
    gradient = vector_to_weights(2.0 * scale * away / weights_to_vector(weights))
    loss = scale * (0.1 + away @ away)
    if "turn_lead" in weights.others:
        lead = weights.others["turn_lead"] - 1.2
        loss, gradient = loss + 1e6 * lead**2, gradient._replace(others={"turn_lead": 2e6 * lead})
    falls = 1.0 * (weights_to_vector(weights)[0] > 1e3)
    return Evaluation(
        loss, dict.fromkeys(("L_Eul", "L_pos", "L_ctrl"), loss), gradient, falls, jnp.asarray(1e-12)
    )


def toy_matrix(config, scenario, weights, loss, *, walk=None, others=()):
    """Thrice the curvature of the bowl in the log-steps: steps are short and so are many."""
    shared = jnp.asarray(np.pad(directions(), ((0, len(others)), (0, 0))))
    along = jnp.diag(jnp.r_[jnp.zeros(18), jnp.full(len(others), 8.0)])
    return 3.0 * loss[0].weight * (2.0 * shared @ shared.T + along)


def toy_slope(config, scenario, weights, loss, *, others, walk=None):
    seen = toy(config, scenario, weights, loss)
    return seen, toy_matrix(config, scenario, weights, loss, others=others)


@pytest.fixture
def on_toy(monkeypatch):
    monkeypatch.setattr(batch, "evaluate", toy)
    monkeypatch.setattr(batch, "least_squares", toy_slope)
    monkeypatch.setattr(difftune, "evaluate_jit", jax.jit(toy, static_argnums=0))
    monkeypatch.setattr(difftune, "least_squares_jit", toy_slope)


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


@pytest.mark.parametrize("config", CONFIGS)
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
        if config.others:
            assert abs(alone.weights.others["turn_lead"] - 1.2) < 0.2
    assert len(set(counts)) > 1 or config.rule != "gauss_newton"  # some ended before others
    assert max(counts) > PER_CALL
    assert found.history.iteration.shape[1] <= config.iterations + 1


def test_how_many_walk_side_by_side_does_not_matter_and_a_start_that_falls_keeps_itself(on_toy):
    bad = nominal()._replace(Q=nominal().Q._replace(euler=np.array([2e3, 1.0, 1.0])))
    asked = stack([problem(w, [scenario("c")]) for w in (*STARTS, bad)])
    one, two, every = (tune_batch(TOY, ROBOT, asked, last_command, lanes=n) for n in (1, 2, 0))
    close(one, two, rtol=1e-9, atol=1e-12)
    close(one, every, rtol=1e-9, atol=1e-12)
    assert [stop == Stop.BAD_START for stop in one.stop] == [False] * 5 + [True]
    assert one.history.status[5, 0] == StepStatus.FELL
    np.testing.assert_array_equal(vector(one.weights)[5], vector(bad))


def test_the_mean_of_scenarios_is_tuned_by_the_mean_of_their_matrices(on_toy):
    """Of losses of their own, divided by their own scales, as a tuning on their mean objective."""
    config = replace(TOY, iterations=39)
    heavy = with_alphas({"L_Eul": 3e5, "L_pos": 0.0})
    cases = ("straight", PAPER_LOSS, 0.5), ("c", heavy, 4.0)
    asked = stack([problem(STARTS[2], [scenario(*case) for case in cases])])
    found = tune_batch(config, ROBOT, asked, last_command)

    def divided(name, loss, k):
        def slope(weights):
            seen, matrix = difftune.model_slope(replace(config, loss=loss), alone_on(name), weights)
            return Evaluation(*jax.tree.map(lambda x: x / k, seen[:3]), *seen[3:]), matrix / k

        return Objective(slope)

    alone = difftune.descend(config, STARTS[2], mean_of([divided(*case) for case in cases]))
    ours = jax.tree.map(lambda x: x[0], found)
    close(ours.weights, alone.weights, rtol=1e-9)
    close(ours.precision, alone.precision, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("tail", "expected"),
    [(1.0, [0.25] * 4), (0.625, [0.2, 0.4, 0.4, 0.0]), (0.0, [0.0, 1.0, 0.0, 0.0])],
)
def test_the_tail_is_the_mean_over_the_worst_share(tail, expected):
    found = tail_weights(jnp.array([2.0, 9.0, 5.0, 1.0]), jnp.asarray(tail))
    np.testing.assert_allclose(found, expected)


DEVICES = """
import numpy as np, jax, pytest
from functools import partial
from experiments.lib import all_devices
from hector_jax.core.runtime import setup_jax
setup_jax()
all_devices()
import test_batch as t
t.batch.evaluate, t.batch.least_squares = t.toy, t.toy_slope
# an odd number of problems: one device has one more to do
asked = t.stack([t.problem(w, [t.scenario("s")]) for w in t.STARTS[:3]])
tuned = partial(t.tune_batch, t.TOY, t.ROBOT, asked, t.last_command)
assert len(jax.devices()) == 2
# a program of another batch size may round otherwise
close = partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-12)
jax.tree.map(close, tuned(devices=jax.local_devices()[:1]), tuned())
if len(jax.local_devices()) > 1:
    with pytest.raises(ValueError, match="lanes must be 1 where a CPU is several devices, got 2"):
        tuned(lanes=2)
"""


def start_process(local_devices=1, **environment):
    """A process that compares the tunings of one device with those of all."""
    here = Path(__file__).parent
    own = (here, here.parent, here.parent / "experiments", os.environ.get("PYTHONPATH", ""))
    count = f" --xla_force_host_platform_device_count={local_devices}"
    shared = {"JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join(map(str, own))}
    environment |= shared | {"XLA_FLAGS": os.environ["XLA_FLAGS"] + count}
    words = [sys.executable, "-c", DEVICES]
    return subprocess.Popen(words, env={**os.environ, **environment}, stderr=subprocess.PIPE)


def check_end(process):
    _, told = process.communicate(timeout=300)
    assert process.returncode == 0, told[-2000:]


def test_two_devices_give_the_numbers_of_one():
    check_end(start_process(local_devices=2))


@pytest.mark.slow  # two processes that wait for each other
def test_two_hosts_give_the_numbers_of_one():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        hosts = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{free.getsockname()[1]}"}
    hosts["JAX_NUM_PROCESSES"] = "2"
    for process in [start_process(**hosts, JAX_PROCESS_ID=str(i)) for i in range(2)]:
        check_end(process)


@pytest.mark.long
@pytest.mark.slow  # minutes of compilation
def test_on_the_rigid_body_a_batch_is_its_single_tunings():
    """With the ticks of a walk in turn, and with all of them at once."""
    config, names = TuneConfig(rollout=RolloutConfig(ticks=40), iterations=2), ("straight", "s")
    asked = stack([problem(STARTS[0], [scenario(name)]) for name in names])
    alone = [tune(config, alone_on(name), STARTS[0]) for name in names]
    for walk, bar in ((rollout, 1e-9), (parallel_rollout, 1e-7)):
        found = tune_batch(config, ROBOT, asked, last_command, lanes=0, walk=walk)
        for i, one in enumerate(alone):
            ours = jax.tree.map(lambda x, i=i: x[i], found)
            assert float(ours.loss) == pytest.approx(float(one.loss), rel=1e-9)
            np.testing.assert_allclose(vector(ours.weights), vector(one.weights), rtol=bar)
            np.testing.assert_allclose(ours.precision, one.precision, rtol=1e-6, atol=1e-9)


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
        ({"tail": [1.5]}, r"BatchProblem.tail must be from 0 to 1, got 1.5"),
        ({"tail": []}, "stacked, one per problem"),
        ({"effect": 3}, r"BatchScenario.effect must be below 1, got 3..3"),
        ({"scale": 0.0}, "BatchScenario.scale must be positive"),
        ({"variation": no_variation()._replace(delay=np.asarray(0.02))}, "from 0 to a tick of 0.0"),
    ],
)
def test_impossible_problems_are_refused(wrong, told):
    tail, options = wrong.get("tail", [1.0]), {k: v for k, v in wrong.items() if k != "tail"}
    asked = stack([problem(nominal(), [scenario(**options)])])._replace(tail=np.asarray(tail))
    with pytest.raises(ValueError, match=told):
        tune_batch(TOY, ROBOT, asked, last_command)
