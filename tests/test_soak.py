"""Load: nothing is compiled twice, and nothing grows with the iterations or beyond 6 GiB."""

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest
from model import SHORT, small_net

from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import nominal
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.network import as_effect
from hector_jax.robot.model import load_robot
from hector_jax.tuning.difftune import TuneConfig, tune
from hector_jax.tuning.rollout import RolloutConfig, Scenario

ROOT = Path(__file__).parents[1]
ROBOT = load_robot()
ANCHOR = standing_anchor(ROBOT)


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
    seen = []

    def on_iteration(iteration):
        seen.append((int(iteration.iteration), bool(iteration.accepted), sum(work.values())))
        work.clear()

    for name, net in (("straight", nets[0]), ("s", nets[1])):
        scenario = Scenario(ROBOT, named_command(name), ANCHOR, as_effect(net))
        tune(config, scenario, nominal(), on_iteration)
        work.clear()
    assert [number for number, *_ in seen].count(0) == 2
    assert len(seen) >= 4
    assert seen[0][2] > 0
    assert [count for *_, count in seen[1:]] == (len(seen) - 1) * [0]
    if rule == "gauss_newton":
        assert {accepted for _, accepted, _ in seen} == {True, False}


def held():
    """Memory that this process holds [bytes]; its open files and arrays on the device."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    counts = len(os.listdir("/proc/self/fd")), len(jax.live_arrays())
    return pages * os.sysconf("SC_PAGE_SIZE"), counts


linux = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")


@linux
@pytest.mark.slow
def test_memory_arrays_and_open_files_stay_flat_over_500_iterations():
    config = TuneConfig(rollout=RolloutConfig(ticks=30), iterations=500, rule="relative")
    after = {}

    def on_iteration(iteration):
        if iteration.iteration % 100 == 0:
            after[int(iteration.iteration)] = held()

    scenario = Scenario(ROBOT, named_command("c"), ANCHOR, last_command)
    found = tune(config, scenario, nominal(), on_iteration)
    assert len(found.iterations) == 501
    print({number: f"{memory / 2**20:.1f} MiB" for number, (memory, _) in after.items()})
    assert after[500][0] <= 1.05 * after[100][0]
    assert after[500][1] == after[100][1]


@linux
@pytest.mark.slow
def test_256_closed_loops_at_once_stay_under_6_gib():
    """With their gradients, in a process of its own."""
    ran = subprocess.run(
        [sys.executable, "-m", "benchmarks.closed_loop", "--ticks=400", "--batch=256"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout.splitlines()[-1])
    print(f"{told['memory'] / 2**30:.2f} GiB")
    assert told["memory"] < 6 * 2**30
    assert told["finite"] == 1.0
