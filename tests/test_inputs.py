"""Whatever a person hands in is taken as it should be or refused in one line: drawn by the hundred.

Nothing is compiled: loaders and checks alone.
"""

import dataclasses
import json
from functools import partial
from pathlib import Path
from typing import get_args, get_origin

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from model import ROBOT
from scenes import SceneConfig

from hector_jax import QpConfig, RolloutConfig, TuneConfig, expert
from hector_jax.cli.flags import Evaluate, Tune
from hector_jax.cli.parse import from_file
from hector_jax.control import FootstepConfig, GaitConfig, LegConfig, MpcConfig, WalkConfig
from hector_jax.control.trajectories import load_command
from hector_jax.control.weights_file import load_weights
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.journal import check_settings
from hector_jax.core.tree_file import save_tree
from hector_jax.grfm import network
from hector_jax.grfm.training import TrainConfig
from hector_jax.store import collection
from hector_jax.store.nets import CollectConfig
from hector_jax.view.video import VideoConfig

QUIET = {"database": None, "deadline": None, "suppress_health_check": list(HealthCheck)}
hundreds = settings(max_examples=300, derandomize=True, **QUIET)

ODD = [0, -1, 1, 0.0, -1.0, 0.5, 1e308, -1e-308, 2**63, -(10**400), 10**400]
ODD += [float("nan"), float("inf"), float("-inf")]
NUMBERS = st.one_of(st.sampled_from(ODD), st.integers(-1000, 1000), st.floats(-1e6, 1e6))
ODD_WORDS = st.sampled_from(["", "weigth", "nan", "1", "../x", "papier"])
WORDS = st.one_of(ODD_WORDS, st.text(max_size=9))
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


CONFIGS = (GaitConfig, FootstepConfig, LegConfig, QpConfig, MpcConfig, WalkConfig, VideoConfig)
CONFIGS += (RolloutConfig, TuneConfig, TrainConfig, CollectConfig, SceneConfig)
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


def refused_settings():
    """By field: what is no number of its range, no word that it knows, and of another type."""
    for kind in CONFIGS:
        for field in dataclasses.fields(kind):
            numeric = {int, float} & {field.type, *get_args(field.type)}
            numbers = [float("inf"), 10**400, -1e9] if numeric else [3]
            if f"{kind.__name__}.{field.name}" in SIGNED:
                numbers.remove(-1e9)
            for value in (float("nan"), *numbers, "weigth", [], {}):
                value = (value,) * 5 if get_origin(field.type) is tuple else value
                yield kind, field.name, value
    for names in (("weigth",), ("",), ("friction", "kp"), ("foot_height",)):
        yield TuneConfig, "others", names


def test_settings_are_refused_by_field_and_value():
    assert made(MpcConfig, horizon=np.int64(5), friction=np.float64(0.5)).horizon == 5
    for kind, name, value in refused_settings():
        with pytest.raises(InputError) as caught:
            made(kind, **{name: value})
        message = one_line(caught.value)
        assert message.startswith(f"{kind.__name__}.{name}")
        assert "must " in message
        parts = (value, *value) if isinstance(value, tuple) else (value,)
        assert any(short_repr(one) in message or repr(one)[:20] in message for one in parts)


def test_settings_that_differ_late_are_told_by_what_differs():
    before = MpcConfig()
    now = dataclasses.replace(before, max_force=before.max_force + 1)
    with pytest.raises(InputError) as caught:
        check_settings(Path("x"), {"mpc": str(before)}, {"mpc": str(now)})
    for one in (before, now):
        assert f"max_force={one.max_force}" in str(caught.value)
    assert len(str(caught.value)) < 250


def edited(part, entry, value):
    tree = {"Q": {}, "R": {"force": [[1e-4] * 3] * 2, "moment": [[1e-4] * 3] * 2}, "others": {}}
    tree["Q"] |= {n: [1.0, 2.0, 3.0] for n in ("euler", "position", "ang_velocity", "velocity")}
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
    ("weights.json", edited("R", "force", [[1, 1, 1], [1]]), "R.force must be 2 x 3 numbers, got"),
    ("weights.json", edited("others", "friction", 2), "others.friction must be a number from 0.1"),
    ("weights.json", '{"Q": 1, "Q": 2}', ""),
    ("weights.json", "[" * 100_000, ""),
    ("tune.toml", "sedes = 3", "unknown field 'sedes'; did you mean 'seeds'?"),
    ("tune.toml", 'config = "other.toml"', "config stands on the line only"),
    ("tune.toml", "seeds = 3.0", "seeds must be a whole number from 1 to 10000, got 3.0"),
    ("tune.toml", "video = 1", "video must be true or false, got 1"),
    ("tune.toml", "seeds = 1\nseeds = 2", "not valid TOML: "),
    ("tune.toml", "\udcff\udcfe", "not a text file"),
    ("tune.json", "[]", "no `flags` in it"),
    ("evaluate.toml", 'world = "standing"', "did you mean 'standin'"),
    ("course.toml", 'name = "mine"', "missing field 'segment'"),
    ("course.toml", 'name = "s"\nsegment = [{seconds = 1}]', "built-in trajectory"),
    ("course.toml", HEAD + "vx = 0.3", "segment 1: unknown field 'vx'; did you mean 'v_x'"),
    ("course.toml", HEAD + "v_x = nan", "segment 1: v_x must be a number from -10 to 10, got nan"),
    ("course.toml", HEAD + f"v_x = 0x{'f' * 9000}", "too many digits"),
    ("course.toml", HEAD + "[[segment]]\nseconds = 600", "at most 600 s together, got 601"),
    ("course.toml", None, "No such file"),
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


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("inputs")


def places(tree, at=()):
    """Where something can be changed in nested dictionaries and lists."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield (*at, key)
        if isinstance(value, dict | list):
            yield from places(value, (*at, key))


def changed(data, tree):
    """The tree with one thing replaced, renamed, taken away or put in."""
    tree = json.loads(json.dumps(tree))
    at = data.draw(st.sampled_from([*places(tree)]))
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
    other = content[:begin] + put + content[begin + length :]
    assume(other != content)
    return other


def spoilt(data, tree, write=json.dumps):
    """A file's bytes with a fault in what they say, or in themselves."""
    if data.draw(st.booleans()):
        return write(changed(data, tree)).encode(errors="surrogatepass")
    return torn(data, write(tree).encode())


def taken(load, path, content):
    """What comes of a file; None where it is refused, in one line that begins with its name."""
    path.write_bytes(content)
    try:
        return load(path)
    except ValueError as error:
        message = one_line(error)
    assert message.startswith((str(path.parent), "cannot read"))
    return None


def as_toml(tree):
    """JSON as TOML, but for null, of which there is none."""
    value = partial(json.dumps, separators=(", ", " = "))
    lines = (f"{json.dumps(name)} = {value(x)}" for name, x in tree.items())
    return "\n".join(lines).replace("NaN", "nan").replace("Infinity", "inf")


@hundreds
@given(st.data())
def test_weights_files_are_taken_or_refused_in_one_line(folder, data):
    sound = json.loads(edited("others", "friction", 0.5))
    found = taken(load_weights, folder / "weights.json", spoilt(data, sound))
    if found is not None:
        for leaf, like in zip([*found.Q, *found.R], [*expert().Q, *expert().R], strict=True):
            assert leaf.shape == like.shape
            assert np.all(np.isfinite(leaf) & (leaf > 0))


PIECE = {"seconds": 1.0, "v_x": 0.3, "v_y": 0.1, "yaw_rate": -0.5}
COURSE = {"name": "mine", "segment": [PIECE, {"seconds": 2, "v_x": 0.0}]}


@hundreds
@given(st.data())
def test_trajectories_are_taken_or_refused_in_one_line(folder, data):
    found = taken(load_command, folder / "course.toml", spoilt(data, COURSE, as_toml))
    if found is not None:
        rows = len(found.command.duration)
        assert found.command.velocity.shape == (rows, 2)
        assert np.all(np.abs(found.command.velocity) <= 10.0)
        assert np.all(np.abs(found.command.yaw_rate) <= 10.0)
        assert found.seconds == pytest.approx(float(np.sum(found.command.duration)))
        assert 0.05 <= found.seconds <= 600.0


@pytest.fixture(scope="module")
def sound(folder):
    """The bytes of a small net of zeros, and of a walk in which nothing moves."""
    like = network.empty_params("paper", (3,), WalkConfig())
    network.save_net(folder / "sound-net.npz", like, robot=ROBOT, about={})
    shape = lambda x: [1, 5][: x.ndim] + list(x.shape[2:])  # noqa: E731
    still = jax.tree.map(
        lambda x: np.zeros([s or n for s, n in zip(x.shape, shape(x), strict=True)]),
        collection.walks_like(ROBOT),
    )
    save_tree(folder / "sound-walk.npz", still, kind="walks", robot=ROBOT, about={})
    return [(folder / f"sound-{name}.npz").read_bytes() for name in ("net", "walk")]


@hundreds
@given(st.data())
def test_nets_are_taken_or_refused_in_one_line(folder, sound, data):
    load = lambda path: network.load_net(path, ROBOT)  # noqa: E731
    found = taken(load, folder / "net.npz", torn(data, sound[0]))
    if found is not None:
        params, variant, _ = found
        assert variant == "paper"
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))


@hundreds
@given(st.data())
def test_collected_walks_are_taken_or_refused_in_one_line(folder, sound, data):
    tree = {"walks": 1, "settings": {"controller": "mine"}}
    card, shard = json.dumps(tree).encode(), sound[1]
    if data.draw(st.booleans()):
        shard = torn(data, shard)
    else:
        card = spoilt(data, tree)
    (folder / "walk-00000.npz").write_bytes(shard)
    load = lambda path: collection.load_walks(path.parent, ROBOT)  # noqa: E731
    found = taken(load, folder / "card.json", card)
    if found is not None:
        run = found.trajectory
        assert run.state.euler.shape[:2] == run.fallen.shape == run.residual.shape
        assert len(jax.tree.leaves(found.job)[0]) == len(run.fallen)
