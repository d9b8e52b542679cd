"""Load: nothing is compiled twice, and nothing grows with the iterations or beyond 6 GiB."""

import json
import os
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest
from model import ANCHOR, ROBOT, ROOT, SHORT, small_net
from pretend import python

from hector_jax import RolloutConfig, Scenario, as_effect, last_command, named_command, nominal
from hector_jax.tuning.difftune import TuneConfig, tune


@pytest.fixture
def work():
    """How often JAX traced, lowered or compiled anything since the counter was cleared."""
    counter = Counter()

    def hear(event, seconds, **more):
        if event.startswith("/jax/core/compile/"):
            counter[event] += 1

    jax.monitoring.register_event_duration_secs_listener(hear)
    yield counter
    jax.monitoring.unregister_event_duration_listener(hear)


@pytest.mark.parametrize("rule", ["gauss_newton", "relative"])
def test_nothing_is_compiled_after_the_first_iteration(work, rule):
    """By either kind of rule, to the end, on another trajectory and with another net."""
    nets = [jax.tree.map(np.asarray, small_net(seed)) for seed in range(2)]
    # the footsteps of a short walk are so rough that some steps are refused
    config = TuneConfig(rollout=SHORT, rule=rule, others=("footstep_feedback", "turn_lead"))
    counts, accepted = [], set()

    def on_iteration(iteration):
        counts.append(sum(work.values()))
        accepted.add(bool(iteration.accepted))
        work.clear()

    for name, net in (("straight", nets[0]), ("s", nets[1])):
        scenario = Scenario(ROBOT, named_command(name), ANCHOR, as_effect(net))
        tune(config, scenario, nominal(), on_iteration)
        work.clear()
    assert counts[0] > 0
    assert len(counts) >= 4
    assert not any(counts[1:])
    assert rule == "relative" or accepted == {True, False}


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
@pytest.mark.slow
def test_memory_arrays_and_open_files_stay_flat_over_500_iterations():
    config = TuneConfig(rollout=RolloutConfig(ticks=30), iterations=500, rule="relative")
    pages, counts = [], []

    def on_iteration(iteration):
        if iteration.iteration in (100, 500):
            pages.append(int(Path("/proc/self/statm").read_text().split()[1]))
            counts.append((len(os.listdir("/proc/self/fd")), len(jax.live_arrays())))

    scenario = Scenario(ROBOT, named_command("c"), ANCHOR, last_command)
    found = tune(config, scenario, nominal(), on_iteration)
    assert len(found.iterations) == 501
    assert pages[1] <= 1.05 * pages[0]
    assert counts[1] == counts[0]


@pytest.mark.long
@pytest.mark.slow
def test_256_closed_loops_at_once_stay_under_6_gib():
    """With their gradients, in a process of its own."""
    ran = python("-m", "benchmarks.closed_loop", "--ticks=400", "--batch=256", cwd=ROOT)
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout.splitlines()[-1])
    assert told["memory"] < 6 * 2**30
    assert told["finite"] == 1.0
