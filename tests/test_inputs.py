"""Whatever a person hands in is taken as it should be or refused in one line: drawn by the hundred.

Nothing is compiled: loaders and checks alone.
"""

import dataclasses
import json
from functools import partial
from typing import get_args, get_origin

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from scenes import SceneConfig

from hector_jax.cli.flags import Evaluate, Tune
from hector_jax.cli.parse import from_file
from hector_jax.control.controller import WalkConfig
from hector_jax.control.footstep import FootstepConfig
from hector_jax.control.gait import GaitConfig
from hector_jax.control.legs import LegConfig
from hector_jax.control.mpc import MpcConfig
from hector_jax.control.trajectories import load_command
from hector_jax.control.weights import expert
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import convert
from hector_jax.core.tree_file import save_tree
from hector_jax.grfm import collection, network
from hector_jax.grfm.training import TrainConfig
from hector_jax.qp import QpConfig
from hector_jax.report.video import VideoConfig
from hector_jax.robot.model import load_robot
from hector_jax.search.cmaes import SearchConfig
from hector_jax.store.nets import CollectConfig
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.rollout import RolloutConfig

ROBOT = load_robot()

hundreds = settings(
    max_examples=300,
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)

NUMBERS = st.one_of(
    st.sampled_from([0, -1, 1, 0.0, -1.0, 0.5, 1e308, -1e-308, 2**63, -(10**400), 10**400]),
    st.sampled_from([float("nan"), float("inf"), float("-inf")]),
    st.integers(-1000, 1000),
    st.floats(-1e6, 1e6),
)
WORDS = st.one_of(
    st.sampled_from(["", "weigth", "nan", "1", "../x", "papier"]), st.text(max_size=9)
)
JUNK = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, WORDS),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(WORDS, inner, max_size=3)),
    max_leaves=6,
)


def one_line(error):
    message = str(error)
    assert "\n" not in message
    assert len(message) < 1000, message
    return message


# Settings

CONFIGS = (
    GaitConfig,
    FootstepConfig,
    LegConfig,
    QpConfig,
    MpcConfig,
    WalkConfig,
    RolloutConfig,
    TuneConfig,
    SearchConfig,
    TrainConfig,
    CollectConfig,
    SceneConfig,
    VideoConfig,
)
FIELDS = [(kind, field) for kind in CONFIGS for field in dataclasses.fields(kind)]
SIGNED = {"LegConfig.landing", "FootstepConfig.feedback", "FootstepConfig.turn"}


def made(kind, **values):
    """What kind(**values) makes in a program; the types that the tests check are left aside."""
    config = object.__new__(kind)
    for field in dataclasses.fields(kind):
        default = field.default
        if default is dataclasses.MISSING:
            default = field.default_factory()
        object.__setattr__(config, field.name, values.get(field.name, default))
    config.__post_init__()
    return config


def validation_error(*value):
    """The message of a value; None if it is valid."""
    try:
        convert(*value)
    except InputError as error:
        return str(error)


@hundreds
@given(st.sampled_from(FIELDS), st.one_of(JUNK, st.lists(JUNK, max_size=5).map(tuple)))
def test_settings_are_taken_or_refused_by_field_and_value(place, value):
    kind, field = place
    try:
        made(kind, **{field.name: value})
    except ValueError as error:
        message = one_line(error)
        assert message.startswith(f"{kind.__name__}.")
        assert field.name in message
        assert "must " in message
        named = (
            (value, *value) if isinstance(value, tuple) else (value,)
        )  # or the part that is wrong
        assert any(short_repr(one) in message or repr(one)[:20] in message for one in named)
    else:
        assert validation_error(value, field.type) is None


@pytest.mark.parametrize(
    ("kind", "field"), FIELDS, ids=[f"{k.__name__}.{f.name}" for k, f in FIELDS]
)
def test_no_setting_takes_a_nan_a_word_or_a_number_below_its_range(kind, field):
    name = f"{kind.__name__}.{field.name}"
    numeric = {int, float} & {field.type, *get_args(field.type)}
    wrong = [float("nan"), float("inf"), -1e9, 10**400] if numeric else [float("nan"), 3]
    for value in [*wrong, "weigth", [], {}]:
        if name in SIGNED and value == -1e9:
            continue
        value = (value,) * 5 if get_origin(field.type) is tuple else value
        if validation_error(value, field.type) is None and field.type is bool:
            continue
        with pytest.raises(ValueError, match=name):
            made(kind, **{field.name: value})


def test_defaults_and_numpy_numbers_are_taken():
    for kind in CONFIGS:
        assert made(kind) == kind()
    assert made(MpcConfig, horizon=np.int64(5), friction=np.float64(0.5)).horizon == 5


# One case a line: of each kind of fault one, for each loader


def edited(part, entry, value):
    """The text of a file of weights with another entry."""
    tree = {
        "Q": {n: [1.0, 2.0, 3.0] for n in ("euler", "position", "ang_velocity", "velocity")},
        "R": {n: [[1e-4, 1e-4, 1e-4]] * 2 for n in ("force", "moment")},
        "others": {},
    }
    tree[part][entry] = value
    return json.dumps(tree)


LOADERS = {
    "weights.json": load_weights,
    "tune.toml": partial(from_file, Tune),
    "tune.json": partial(from_file, Tune),
    "evaluate.toml": partial(from_file, Evaluate),
    "course.toml": load_command,
}
HEAD = 'name = "mine"\n[[segment]]\nseconds = 1.0\n'
REFUSED = [
    ("weights.json", '{"Q": {}, "R": {}}', 'missing weight "Q.euler"'),
    ("weights.json", edited("Q", "eular", [1, 1, 1]), "weight 'Q.eular'; did you mean 'Q.euler'"),
    ("weights.json", edited("Q", "euler", [1, -1, 1]), "Q.euler[1] must be a number from 1e-12"),
    ("weights.json", edited("Q", "euler", [1, 1, True]), "Q.euler[2] must be a number"),
    ("weights.json", edited("Q", "euler", [1, float("nan"), 1]), "got nan"),
    ("weights.json", edited("Q", "euler", [1, 1]), "Q.euler must be 3 numbers, got"),
    ("weights.json", edited("R", "force", [[1, 1, 1], [1]]), "R.force must be 2 x 3 numbers, got"),
    ("weights.json", edited("others", "frition", 1), "did you mean 'others.friction'"),
    ("weights.json", edited("others", "friction", 2), "others.friction must be a number from 0.1"),
    ("weights.json", edited("others", "kp", [9, 9, 9]), "others.kp must be 5 numbers, got"),
    ("weights.json", "", ""),
    ("weights.json", "\udc80", ""),
    ("weights.json", '{"Q": 1, "Q": 2}', ""),
    ("weights.json", "[" * 100_000, ""),
    ("tune.toml", "sedes = 3", "unknown field 'sedes'; did you mean 'seeds'?"),
    ("tune.toml", 'config = "other.toml"', "config stands on the line only"),
    ("tune.toml", 'seeds = "3"', "seeds must be a whole number from 1 to 10000, got '3'"),
    ("tune.toml", "seeds = 3.0", "seeds must be a whole number from 1 to 10000, got 3.0"),
    ("tune.toml", "video = 1", "video must be true or false, got 1"),
    ("tune.toml", "seeds = ", "not valid TOML: "),
    ("tune.toml", "seeds = 1\nseeds = 2", "not valid TOML: "),
    ("tune.toml", "\udcff\udcfe", "not a text file"),
    ("tune.json", "[]", "no `flags` in it"),
    ("tune.json", '{"flags": {"seeds": null}}', "seeds must be a whole number"),
    ("tune.json", "[" * 100_000, "not valid"),
    ("evaluate.toml", 'world = "standing"', "did you mean 'standin'"),
    ("evaluate.toml", "seconds = 0", "seconds must be a number from 0.01 to 600, got 0"),
    ("evaluate.toml", "seconds = nan", "seconds must be a number from 0.01 to 600, got nan"),
    ("evaluate.toml", f"seconds = 1{400 * '0'}", "from 0.01 to 600, got 1000"),
    ("course.toml", "", "missing field 'name'"),
    ("course.toml", 'name = "mine"', "missing field 'segment'"),
    ("course.toml", "name = 3\nsegment = [{seconds = 1}]", "name must be text, got 3"),
    ("course.toml", 'name = "s"\nsegment = [{seconds = 1}]', "built-in trajectory"),
    ("course.toml", HEAD + "vx = 0.3", "segment 1: unknown field 'vx'; did you mean 'v_x'"),
    ("course.toml", HEAD + "v_x = nan", "segment 1: v_x must be a number from -10 to 10, got nan"),
    ("course.toml", HEAD + f"v_x = 0x{'f' * 9000}", "too many digits"),
    ("course.toml", HEAD + "[[segment]]\nv_x = 1.0", "segment 2: missing field 'seconds'"),
    ("course.toml", HEAD + "[[segment]]\nseconds = -1", "segment 2: seconds must be"),
    ("course.toml", HEAD + "[[segment]]\nseconds = 600", "at most 600 s together, got 601"),
    *((name, None, "No such file") for name in ("tune.toml", "course.toml")),
]


@pytest.mark.parametrize(("name", "text", "fault"), REFUSED)
def test_a_wrong_file_is_one_line_with_file_field_and_value(tmp_path, name, text, fault):
    if text is not None:
        (tmp_path / name).write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(InputError) as caught:
        LOADERS[name](tmp_path / name)
    message = one_line(caught.value)
    assert str(tmp_path / name) in message
    assert fault in message


# Files


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("inputs")


def places(tree, at=()):
    """Where something can be changed in nested dictionaries and lists."""
    yield at
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in inner:
        if isinstance(value, dict | list):
            yield from places(value, (*at, key))
        else:
            yield (*at, key)


def changed(data, tree):
    """The tree with one thing replaced, renamed, taken away or put in."""
    tree = json.loads(json.dumps(tree))
    at = data.draw(st.sampled_from([place for place in places(tree) if place]))
    holder = tree
    for key in at[:-1]:
        holder = holder[key]
    how = data.draw(st.sampled_from(["replace", "replace", "rename", "remove", "add"]))
    if how == "replace" or isinstance(holder, list):
        holder[at[-1]] = data.draw(JUNK)
    elif how == "add":
        holder[data.draw(WORDS)] = data.draw(JUNK)
    else:
        value = holder.pop(at[-1])
        if how == "rename":
            holder[at[-1][:-1] + data.draw(WORDS)] = value
    return tree


PRINTABLE = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=8).map(str.encode)


def torn(data, content):
    """The bytes cut, or a stretch of them replaced."""
    begin = data.draw(st.integers(0, len(content)))
    length = data.draw(st.integers(0, 20))
    put = data.draw(st.one_of(PRINTABLE, PRINTABLE, st.binary(max_size=8)))
    return content[:begin] + put + content[begin + length :]


def refused_or(load, path):
    """What comes of a file; None where it is refused, in one line that begins with its name."""
    try:
        return load(path)
    except ValueError as error:
        message = one_line(error)
    assert message.startswith((str(path.parent), "cannot read"))
    return None


@pytest.fixture(scope="module")
def sound_weights(folder):
    path = folder / "sound.json"
    save_weights(path, expert())
    return path.read_bytes()


@hundreds
@given(st.data())
def test_weights_files_are_taken_or_refused_in_one_line(folder, sound_weights, data):
    path = folder / "weights.json"
    if data.draw(st.booleans()):
        path.write_text(json.dumps(changed(data, json.loads(sound_weights))))
    else:
        path.write_bytes(torn(data, sound_weights))
    found = refused_or(load_weights, path)
    if found is not None:
        for leaf, like in zip(jax.tree.leaves(found), jax.tree.leaves(expert()), strict=True):
            assert leaf.shape == like.shape
            assert np.all(np.isfinite(leaf) & (leaf > 0))


def as_toml(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {as_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    return json.dumps(value) if isinstance(value, str | bool) else str(value)  # None is no TOML


COURSE = {
    "name": "mine",
    "segment": [
        {"seconds": 1.0, "v_x": 0.3, "v_y": 0.1, "yaw_rate": -0.5},
        {"seconds": 2, "v_x": 0.0},
    ],
}


@hundreds
@given(st.data())
def test_trajectories_are_taken_or_refused_in_one_line(folder, data):
    path = folder / "course.toml"
    if data.draw(st.booleans()):
        tree = changed(data, COURSE)
        text = "\n".join(f"{json.dumps(key)} = {as_toml(value)}" for key, value in tree.items())
        path.write_bytes(text.encode(errors="surrogatepass"))
    else:
        path.write_bytes(
            torn(data, "\n".join(f"{k} = {as_toml(v)}" for k, v in COURSE.items()).encode())
        )
    found = refused_or(load_command, path)
    if found is not None:
        rows = len(found.command.duration)
        assert found.command.velocity.shape == (rows, 2)
        assert np.all(np.abs(found.command.velocity) <= 10.0)
        assert np.all(np.abs(found.command.yaw_rate) <= 10.0)
        assert found.seconds == pytest.approx(float(np.sum(found.command.duration)))
        assert 0.05 <= found.seconds <= 600.0


def spoilt(data, path):
    """A sound file of ours with other bytes."""
    content = path.read_bytes()
    other = torn(data, content)
    assume(other != content)
    path.write_bytes(other)


@pytest.fixture(scope="module")
def net(folder):
    """A small net of zeros."""
    path = folder / "sound-net.npz"
    like = network.empty_params("paper", (3,), WalkConfig())
    network.save_net(path, like, robot=ROBOT, about={})
    return path


@hundreds
@given(st.data())
def test_nets_are_taken_or_refused_in_one_line(folder, net, data):
    path = folder / "net.npz"
    path.write_bytes(net.read_bytes())
    spoilt(data, path)
    found = refused_or(lambda path: network.load_net(path, ROBOT), path)
    if found is not None:
        params, variant, _ = found
        assert variant == "paper"
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))


@pytest.fixture(scope="module")
def walks(folder):
    """A collection of one walk in which nothing moves."""
    home = folder / "walks"
    shape = lambda x: [1, 5][: x.ndim] + list(x.shape[2:])  # noqa: E731
    like = collection.walks_like(load_robot())
    still = jax.tree.map(
        lambda x: np.zeros([s or n for s, n in zip(x.shape, shape(x), strict=True)]), like
    )
    save_tree(home / "walk-00000.npz", still, kind="walks", robot=ROBOT, about={})
    card = {"walks": 1, "settings": {"controller": "mine"}}
    (home / "card.json").write_text(json.dumps(card))
    return {path.name: path.read_bytes() for path in home.iterdir()}


@hundreds
@given(st.data())
def test_collected_walks_are_taken_or_refused_in_one_line(folder, walks, data):
    home = folder / "spoilt"
    home.mkdir(exist_ok=True)
    for name, content in walks.items():
        (home / name).write_bytes(content)
    if data.draw(st.booleans()):
        spoilt(data, home / "walk-00000.npz")
    elif data.draw(st.booleans()):
        card = home / "card.json"
        card.write_text(json.dumps(changed(data, json.loads(card.read_text()))))
    else:
        (home / "card.json").write_bytes(torn(data, walks["card.json"]))
    found = refused_or(lambda path: collection.load_walks(path.parent, ROBOT), home / "card.json")
    if found is not None:
        run = found.trajectory
        assert run.state.euler.shape[:2] == run.fallen.shape == run.residual.shape
        assert len(jax.tree.leaves(found.job)[0]) == len(run.fallen)


@pytest.mark.parametrize("value", [("weigth",), ("",), ("friction", "kp"), ("foot_height",)])
def test_what_cannot_be_tuned_is_refused_by_field_and_value(value):
    with pytest.raises(InputError) as caught:
        made(TuneConfig, others=value)
    message = one_line(caught.value)
    assert message.startswith("TuneConfig.others must be ")
    assert short_repr(value) in message
