"""Four legs as data and four point feet: what is found and read, gaits, nets, walks."""

import json
import re
import tomllib
from dataclasses import replace
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from model import EXAMPLES, QUADRUPED
from pretend import call
from published import converted, proposed, replaced

from hector_jax import InputError, Job, State, Wrench, hfs, ideal, last_command, load_robot, walk
from hector_jax.cli.arguments import with_gait
from hector_jax.control import gait, named_command, standing_anchor
from hector_jax.control.controller import plan_horizon, walk_config
from hector_jax.control.footstep import Feet
from hector_jax.control.gait import GaitConfig, gait_named
from hector_jax.control.weights import direction_names, expert, nominal, weight_names
from hector_jax.control.weights_file import load_weights, save_weights, weights_tree
from hector_jax.core.trajectory import FEET
from hector_jax.export.export import weights_schema
from hector_jax.grfm.dataset import ACROSS, ALONG, make_dataset, partners, with_mirror
from hector_jax.grfm.gated import fit_gated
from hector_jax.grfm.network import as_effect, load_net, save_net
from hector_jax.grfm.residual import init, with_statistics
from hector_jax.importing.elements import read_file
from hector_jax.importing.remarks import remarks
from hector_jax.importing.survey import survey_file
from hector_jax.robot.model import robot_of
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


MODEL = FILE.with_name("quadruped.xml")
LEGS = FEET[4]
TABLE = FILE.read_text()


def changed(folder, *changes):
    path = folder / "quadruped.xml"
    path.write_text(replaced(MODEL.read_text(), *changes))
    return path


def test_the_example_is_what_its_model_is_converted_to(tmp_path):
    assert proposed(MODEL).survey.forwards == (False, False)
    path = converted(MODEL, tmp_path / "out")
    assert tomllib.loads(path.read_text()) == tomllib.loads(TABLE)
    robot = load_robot(path)
    for name in robot._fields[:-2]:
        np.testing.assert_allclose(getattr(robot, name), getattr(QUADRUPED, name), atol=1e-12)


@pytest.mark.parametrize("ahead", [0.0, 0.3])
def test_an_anchor_may_be_anywhere_on_its_axis(tmp_path, ahead):
    """Also where the anchors of the hind legs are ahead of those of the front legs."""

    def found(roll, pitch):
        hips = ((rf'(<joint name="{end}_\w+_roll")', x) for end, x in roll.items())
        changes = [(hip, rf'\1 pos="{x} 0 0"') for hip, x in hips]
        for side, x in (("left", ahead), ("right", -ahead)):
            pose = f'axis="{x} 0.95 0" pos="{x * pitch} {0.95 * pitch} 0"'
            changes.append((rf'(<joint name="\w+_{side}_pitch")', rf"\1 {pose}"))
        return proposed(changed(tmp_path, *changes))

    own, got = found({}, 0.0), found({"front": -0.3, "hind": 0.3}, 0.06)
    assert got.error is None
    assert got.table["joints"] == own.table["joints"]
    assert got.table["standing"] == pytest.approx(own.table["standing"], abs=2e-4)
    for name in ("standing_height", "foot_ahead"):
        values = (getattr(x.robot, name) for x in (got, own))
        np.testing.assert_allclose(*values, atol=1e-4)


def test_springs_are_told_and_are_part_of_the_load(tmp_path):
    knee = '<joint range="-2.7227 -0.83776"'
    for stiffness in (0, 60, 300):
        spring = (knee, f'{knee} stiffness="{stiffness}" springref="-1.5"')
        proposal = proposed(changed(tmp_path, spring))
        lines = [line for line in remarks(proposal.robot) if "springs turn" in line]
        text = f"front_left_knee ({stiffness} N m/rad, standing {stiffness / 2:.3g} of 45.4 N m)"
        assert [text in line for line in lines] == [True] * (stiffness > 0)
        assert ("standing takes" in (proposal.error or "")) == (stiffness == 300)
    hip = ('<joint axis="1 0 0"', '<joint axis="1 0 0" stiffness="5"')
    (line,) = [x for x in remarks(proposed(changed(tmp_path, hip)).robot) if "springs" in x]
    assert "hind_right_roll (5 N m/rad, standing 0 of 23.7 N m)" in line


NAMED = [  # names of the legs in the file, and what is told
    (LEGS, ""),
    (("lf", "rf", "lh", "rh"), ""),
    (("FL", "FR", "RL", "RR"), ""),
    (("a", "b", "c", "d"), ""),
    (LEGS[2:] + LEGS[:2], "hind_left_roll is front, hind_right_roll is front, front_left_roll is "),
    (("FR", "FL", "RL", "RR"), "names, FR_roll is left, FL_roll is right: "),
    (("RR", "RL", "FR", "FL"), "RR_roll is front, .* FL_roll is hind, RR_roll is left, FR_roll"),
]


@pytest.mark.parametrize(("names", "told"), NAMED)
def test_names_of_other_places_are_told(tmp_path, names, told):
    path, new = changed(tmp_path), dict(zip(LEGS, names, strict=True))
    path.write_text(re.sub("|".join(LEGS), lambda x: new[x[0]], path.read_text()))
    lines = [line for line in remarks(proposed(path).robot) if "places" in line]
    assert len(lines) == bool(told)
    assert all(re.search(told, line) and "looks along -x" in line for line in lines)


def test_legs_are_found_in_any_order_and_by_any_name(tmp_path):
    text = MODEL.read_text()
    for i, leg in enumerate(LEGS):
        text = text.replace(leg, f"part{i}")
    front, middle, hind = (text.index(f'<body name="part{i}_hip"') for i in (0, 2, 3))
    end = text.index("    </body>\n  </worldbody>")
    text = text[:front] + text[hind:end] + text[middle:hind] + text[front:middle] + text[end:]
    path = tmp_path / "turned.xml"
    path.write_text(text)
    found = survey_file(read_file(path))
    names = [[found.model.joint(j).name for j in leg] for leg in found.legs]
    assert names == [[f"part{i}_{joint}" for joint in ("roll", "pitch", "knee")] for i in range(4)]
    assert proposed(path).wrong == ()


def test_motors_without_armature_get_one_by_their_torque_and_are_told(tmp_path):
    proposal = proposed(changed(tmp_path, (' armature="0.01"', "")))
    expected = 2e-4 * QUADRUPED.torque_limit[:3]
    assert proposal.table["joints"]["armature"] == pytest.approx(expected, rel=5e-3)
    assert remarks(QUADRUPED) == []
    model = tmp_path / "robot.xml"
    text = QUADRUPED.description.model.read_text().replace('armature="0.01"', 'armature="0"')
    model.write_text(text)
    (line,) = remarks(robot_of(replace(QUADRUPED.description, model=model)))
    assert line.startswith("joint 'front_left_roll' has no armature")


def test_hind_knees_that_bend_the_other_way_are_told_and_stand(tmp_path, monkeypatch, capsys):
    knees = (r'(?=<joint name="hind_\w+_knee")<joint', '<joint range="0.83776 2.7227"')
    path = changed(tmp_path, knees, ("-0.5236 4.5379", "-4.5379 0.5236"))
    proposal = proposed(path)
    assert (proposal.wrong, proposal.survey.forwards) == ((), (False, True))
    angles = proposal.table["standing"]
    for joint in ("pitch", "knee"):
        front, hind = (angles[f"{pair}_left_{joint}"] for pair in ("front", "hind"))
        assert hind == pytest.approx(-front, abs=1e-3)
    assert call(monkeypatch, "robot", path) == 0
    assert "knees bend backwards in front and forwards behind" in capsys.readouterr().out


def test_a_shank_without_a_foot_stands_on_a_point_that_is_guessed_from_its_inertia(tmp_path):
    bare = ('size="0.012"', 'size="0.012" contype="0" conaffinity="0"')  # 0.202 m long
    proposal = proposed(changed(tmp_path, ('<geom class="foot"/>', ""), bare))
    assert proposal.error is None
    assert any("guessed" in line for line in proposal.guesses)
    for sole in proposal.soles:
        assert sole.guessed
        assert len(sole.contacts) == 1
        assert np.linalg.norm(sole.contacts) == pytest.approx(0.202, abs=0.005)


def test_pairs_that_are_not_alike_are_refused(tmp_path):
    toe = r'<body pos="0 0 -0.2"><joint name="\1_toe"/><geom size="0.01"/></body>'
    hind = (r'(?s)(hind_\w+)_calf".*?<geom class="foot"/>', rf"\g<0>{toe}")
    error = proposed(changed(tmp_path, hind)).error
    assert "2 pairs of chains of [4, 3] hinges end as low as legs" in error
