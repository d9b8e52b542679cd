"""Four point feet: gaits, weights without moments, the net's views, walks."""

import json
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from model import EXAMPLES
from pretend import call

from hector_jax import InputError, Job, State, Wrench, hfs, ideal, last_command, load_robot, walk
from hector_jax.cli.arguments import with_gait
from hector_jax.control import gait, named_command, standing_anchor
from hector_jax.control.controller import plan_horizon, walk_config
from hector_jax.control.footstep import Feet
from hector_jax.control.gait import GaitConfig, gait_named
from hector_jax.control.weights import direction_names, expert, nominal, weight_names
from hector_jax.control.weights_file import load_weights, save_weights, weights_tree
from hector_jax.export.export import weights_schema
from hector_jax.grfm.dataset import ACROSS, ALONG, make_dataset, partners, with_mirror
from hector_jax.grfm.gated import fit_gated
from hector_jax.grfm.network import as_effect, load_net, save_net
from hector_jax.grfm.residual import init, with_statistics
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout

FILE = EXAMPLES / "quadruped" / "robot.toml"
ROBOT = load_robot(FILE)
CONFIG = walk_config(ROBOT)
ANCHOR = standing_anchor(ROBOT)


GAITS = [("trot", [0.0, 0.5, 0.5, 0.0], 2), ("pace", [0.5, 0.0, 0.5, 0.0], 2)]
GAITS += [("crawl", [0.75, 0.25, 0.5, 0.0], 3)]  # each hind foot before the front foot of its side


@pytest.mark.parametrize(("name", "lifts", "most"), GAITS)
def test_feet_lift_in_the_order_of_the_gait(name, lifts, most):
    config = gait_named(CONFIG.gait, name)
    stands = np.asarray(gait.contact(config, jnp.arange(config.cycle)))
    lifted = (~stands & np.roll(stands, 1, axis=0)).argmax(axis=0)
    np.testing.assert_allclose((lifted - lifted[3]) % config.cycle / config.cycle, lifts)
    assert config.swing == CONFIG.gait.swing
    assert stands.sum(axis=1).max() == stands.sum(axis=1).min() == most == config.most_contacts


def test_a_gait_is_chosen_by_name_and_one_that_cannot_be_is_refused(monkeypatch, capsys):
    for wrong, words in (
        ({"pattern": "gallop"}, "must be 'walk', 'trot', 'pace' or 'crawl', got 'gallop'"),
        ({"pattern": (0.0, 0.5, 0.5)}, r"numbers in \[0, 1\), one for each of 2 or 4 feet"),
        ({"pattern": "trot", "stance": 16}, "one has to stand at each tick"),
        ({"pattern": (0.0, 0.33, 0.5, 0.5)}, "whole number of ticks"),
    ):
        with pytest.raises(InputError, match=words):
            GaitConfig(**wrong)
    assert walk_config(with_gait(ROBOT, "own")).gait == CONFIG.gait
    assert walk_config(with_gait(ROBOT, "crawl")).gait == gait_named(CONFIG.gait, "crawl")
    words = f"walk --robot {FILE} --world srbm --seconds 0.3 --json --gait stand"
    assert call(monkeypatch, *words.split()) == 0
    out, told = capsys.readouterr()
    assert "straight is not walked: all feet stand" in told
    assert json.loads(out)["L"] < 1.0


def test_a_foot_of_each_pair_lands_beside_its_own_hips():
    """Two feet of a trot, of either pair and side, land at once: as far apart as they stand."""
    still = jax.tree.map(np.zeros_like, named_command("straight"))._replace(duration=np.ones(2))
    rows = np.zeros(3), ANCHOR.position, *np.zeros((2, 3))
    state = State(*(jnp.asarray(row) + 0.01 for row in rows))
    feet = Feet(jnp.asarray(ROBOT.foot_ahead)[:, None] * jnp.eye(3)[0], jnp.zeros(4))
    now = {"anchor": ANCHOR, "tick": jnp.asarray(3), "state": state, "feet": feet}
    plan = jax.jit(partial(plan_horizon, CONFIG, ROBOT, CONFIG.footstep.parameters, command=still))
    front, hind = np.asarray(plan(**now)[-1].position)[[0, 3]]
    ahead, aside = float(np.ptp(ROBOT.foot_ahead)), 2 * CONFIG.footstep.width
    assert ahead > 0.3
    np.testing.assert_allclose(front - hind, [ahead, aside, 0.0], atol=0.01)


def test_point_feet_have_weights_of_forces_alone(tmp_path):
    weights = expert(ROBOT)
    names = weight_names(weights)
    assert len(names) == 24
    assert names[12:15] == ("R_Fx_front_left", "R_Fy_front_left", "R_Fz_front_left")
    assert direction_names(weights)[12:] == ("R_Fx", "R_Fy", "R_Fz")
    save_weights(tmp_path / "w.json", weights)
    jax.tree.map(np.testing.assert_array_equal, load_weights(tmp_path / "w.json", ROBOT), weights)
    jsonschema.validate(weights_tree(weights), weights_schema(ROBOT))
    with pytest.raises(InputError, match="missing weight"):
        load_weights(tmp_path / "w.json")  # HECTOR's
    save_weights(tmp_path / "two.json", nominal())
    with pytest.raises(InputError, match="R.force must be 4 x 3 numbers"):
        load_weights(tmp_path / "two.json", ROBOT)


@pytest.fixture(scope="module")
def data():
    """Samples of two walks on the rigid body whose ground answers a little less than commanded."""
    config = RolloutConfig(walk=CONFIG, ticks=60, lead=10)
    scenario = Scenario(ROBOT, named_command("s"), ANCHOR, last_command)
    walk_ = jax.jit(partial(rollout, config, scenario))
    walks = [walk_(weights) for weights in (nominal(ROBOT), expert(ROBOT))]
    walks = jax.tree.map(lambda *x: np.stack(x), *walks)
    rng = np.random.default_rng(0)
    push = lambda x: 0.9 * x + rng.normal(size=x.shape)  # noqa: E731
    walks = walks._replace(effect=Wrench(push(walks.effect.force), walks.effect.moment))
    return make_dataset(ROBOT, walks)[0]


@pytest.fixture(scope="module")
def nets(data):
    residual = with_statistics(init(jax.random.key(0), 4, 3), data)
    return jax.tree.map(np.asarray, {"gated": fit_gated(data), "residual": residual})


@pytest.mark.parametrize("variant", ["residual", "gated"])
def test_a_net_of_four_feet_is_fitted_stored_and_read(tmp_path, data, variant, nets):
    params = nets[variant]
    save_net(tmp_path / "net.npz", params, robot=ROBOT, about={})
    again, name, _ = load_net(tmp_path / "net.npz", ROBOT)
    assert name == variant
    jax.tree.map(np.testing.assert_array_equal, again, params)
    window = jax.tree.map(lambda x: jnp.asarray(x[7]), data.window)
    effect = jax.jit(as_effect(params))(window)
    assert effect.wrench.force.shape == effect.wrench.moment.shape == (4, 3)
    assert np.any(effect.wrench.force)
    assert not np.any(effect.wrench.moment)
    assert variant == "gated" or not params.moment  # point feet have no moment, so no net for it
    with pytest.raises(InputError):
        load_net(tmp_path / "net.npz", load_robot())


def test_a_mirrored_window_of_four_feet_has_the_mirrored_effect(data, nets):
    both, count = with_mirror(data), len(data.walk)
    phi = jax.jit(as_effect(nets["residual"]))
    for i in (0, 20, 37):
        here, there = (
            phi(jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), both.window)) for k in (i, count + i)
        )
        same = partial(np.testing.assert_allclose, atol=1e-9)
        same(here.wrench.force[partners(4)] * ALONG, there.wrench.force)
        same(here.wrench.moment[partners(4)] * ACROSS, there.wrench.moment)
        same(here.legs.force * ALONG, there.legs.force)
        same(here.legs.torque * ACROSS, there.legs.torque)


@pytest.mark.slow
def test_the_quadruped_stands_on_all_feet_and_crawls():
    robot = with_gait(ROBOT, "stand")
    still = jax.tree.map(np.zeros_like, named_command("straight"))._replace(duration=np.ones(2))
    job = Job(nominal(robot), still, hfs(robot.description), 1.0)
    found = walk(walk_config(robot), robot, job)
    assert not found.fallen.any()
    assert found.contact.all()
    assert np.abs(found.state.position[-1] - found.initial.position).max() < 5e-3
    robot = with_gait(ROBOT, "crawl")
    job = Job(nominal(robot), named_command("straight"), ideal(robot.description), 4.0)
    assert not walk(walk_config(robot), robot, job).fallen.any()


@pytest.mark.slow
def test_the_quadruped_walks_twelve_seconds_in_hfs():
    """A trot and a pace at 0.25 sqrt(g h), ahead and in a turn of 0.5 rad/s."""
    straight = jax.tree.map(np.asarray, named_command("straight"))
    fast = 0.25 * float(np.sqrt(ROBOT.gravity[2] * ROBOT.standing_height))  # [m/s]
    for name, turn in product(("trot", "pace"), (0.0, 0.5)):
        robot, velocity = with_gait(ROBOT, name), np.tile([fast, 0.0], (2, 1))
        command = straight._replace(velocity=velocity, yaw_rate=np.full(2, turn))
        job = Job(nominal(robot), command, hfs(robot.description), 12.0)
        found = walk(walk_config(robot), robot, job)
        assert not found.fallen.any(), (name, turn)
        turned = found.state.euler[-1, 2] - found.initial.euler[2]
        assert turned == pytest.approx(12 * turn, abs=0.2), (name, turn)
