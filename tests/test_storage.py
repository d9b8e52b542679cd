"""Files: what is written comes back, and what was tampered with does not."""

import pickle
from functools import partial

import jax
import numpy as np
import pytest

from hector_jax.core import tree_file
from hector_jax.core.trajectory import Wrench
from hector_jax.core.tree_file import load_tree, read_card, save_tree, tree_hash

TREE = {
    "leaf": Wrench(np.arange(6.0).reshape(2, 3), np.array([True, False])),
    "table": {"Dense_0": {"kernel": np.ones((3, 4), np.float32)}, "count": np.array(3)},
}
ROBOT = Wrench(np.array([12.0, 9.81]), np.array(0.25))


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "tree.npz"
    save_tree(path, TREE, kind="thing", robot=ROBOT, about={"units": "N"})
    return path


def test_a_tree_comes_back_as_it_was_written(saved):
    tree, card = load_tree(saved, TREE, kind="thing", robot=ROBOT)
    jax.tree.map(partial(np.testing.assert_array_equal, strict=True), tree, TREE)
    assert card["about"] == {"units": "N"}
    assert card["arrays"]["leaf.force"] == {"shape": [2, 3], "dtype": "float64"}
    assert read_card(saved) == card
    again = saved.with_name("again.npz")
    save_tree(again, TREE, kind="thing", robot=ROBOT, about={"units": "N"})
    assert again.read_bytes() == saved.read_bytes()


def test_files_that_are_cut_or_changed_are_refused_by_name(saved):
    data, rng = saved.read_bytes(), np.random.default_rng(0)
    wrong = [data[:length] for length in np.linspace(0, len(data) - 1, 16).astype(int)]
    for place in rng.choice(len(data), 200, replace=False):
        flipped = bytearray(data)
        flipped[place] ^= 1 << rng.integers(8)
        wrong.append(bytes(flipped))
    for content in (*wrong, pickle.dumps({"a": 1}) * 20):
        saved.write_bytes(content)
        with pytest.raises(ValueError, match="tree.npz: cut or changed"):
            load_tree(saved, TREE, kind="thing")


OTHER_ROBOT = ROBOT._replace(force=np.array([13.0, 9.81]))
SMALLER = TREE | {"table": {"Dense_0": TREE["table"]["Dense_0"]}}
WIDER = TREE | {"leaf": TREE["leaf"]._replace(force=np.zeros((2, 4)))}


@pytest.mark.parametrize(
    ("like", "kind", "robot", "format", "fault"),
    [
        (TREE, "net", None, 1, "holds thing, expected net"),
        (TREE, "thing", OTHER_ROBOT, 1, "made for another robot"),
        (SMALLER, "thing", None, 1, "another layout of thing.*count"),
        (WIDER, "thing", None, 1, r"leaf.force has shape \(2, 3\)"),
        (TREE, "thing", None, 2, "file format 1, this version reads 2"),
    ],
)
def test_a_file_of_something_else_is_refused(saved, monkeypatch, like, kind, robot, format, fault):
    monkeypatch.setattr(tree_file, "FORMAT", format)
    with pytest.raises(ValueError, match=f"tree.npz: {fault}"):
        load_tree(saved, like, kind=kind, robot=robot)


def test_a_robot_is_known_by_its_numbers_to_nine_digits():
    other, near = (ROBOT._replace(moment=np.array(0.25 + x)) for x in (1e-4, 1e-15))
    assert tree_hash(ROBOT) == tree_hash(jax.tree.map(np.copy, ROBOT))
    assert len({tree_hash(robot) for robot in (ROBOT, other, near)}) == 3
    assert tree_hash(ROBOT, 9) == tree_hash(near, 9) != tree_hash(other, 9)
