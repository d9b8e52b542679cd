"""A process that walks robot after robot keeps the programs of few of them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import EXAMPLES

from hector_jax import Job, load_robot, named_command, nominal, walk, walk_config
from hector_jax.robot.description import HECTOR
from hector_jax.sim import programs
from hector_jax.sim.programs import ROBOTS, by_robot, make_room
from hector_jax.sim.world import ideal


def live():
    return len(jax.devices()[0].client.live_executables())


@by_robot
def program(description):
    return jax.jit(lambda x: x + len(description.name))


@jax.jit
def shared(robot, x):
    return x + len(robot.name)


def test_the_programs_of_one_robot_too_many_free_those_of_the_others(monkeypatch):
    monkeypatch.setattr(programs, "_present", {})  # other tests have walked with robots
    counts = []
    for i in range(4 * ROBOTS):
        description = replace(HECTOR, name="r" * (i + 1))
        make_room(description)
        make_room(description)
        for compiled in (program(description), lambda x, d=description: shared(d, x)):
            assert compiled(jnp.zeros(3))[0] == i + 1
        assert program(description) is program(description)
        counts.append(live())
    assert max(counts[ROBOTS:]) <= counts[ROBOTS - 1]


@pytest.mark.slow
def test_walks_of_robot_after_robot_free_the_programs_of_the_last(monkeypatch):
    monkeypatch.setattr(programs, "_present", {})
    monkeypatch.setattr(programs, "ROBOTS", 1)
    robots = [load_robot(EXAMPLES / x / "robot.toml") for x in ("strider", "humanoid")]
    counts, walks = [], []
    for robot in (*robots, *robots):
        job = Job(nominal(robot), named_command("straight"), ideal(robot.description), 0.05)
        walks.append(walk(walk_config(robot), robot, job))
        counts.append(live())
    assert max(counts[2:]) <= max(counts[:2]) + 2
    np.testing.assert_array_equal(walks[0].state.position, walks[2].state.position)
