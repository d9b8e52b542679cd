"""Files: what is written comes back, and what was tampered with does not."""

import json
import os
import pickle
from typing import NamedTuple

import jax
import numpy as np
import pytest

from hector_jax.control.weights import expert, nominal
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core import environment, files, tree_file
from hector_jax.core.environment import code_hash
from hector_jax.core.files import WriteError
from hector_jax.core.tree_file import load_tree, read_card, save_tree, tree_hash


class Leaf(NamedTuple):
    """Two arrays."""

    force: np.ndarray
    flag: np.ndarray


class Tree(NamedTuple):
    """NamedTuples and dictionaries mixed, as in network parameters."""

    leaf: Leaf
    table: dict


TREE = Tree(
    Leaf(np.arange(6.0).reshape(2, 3), np.array([True, False])),
    {"Dense_0": {"kernel": np.ones((3, 4), np.float32)}, "count": np.array(3)},
)
ROBOT = Leaf(np.array([12.0, 9.81]), np.array(0.25))


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "tree.npz"
    save_tree(path, TREE, kind="thing", robot=ROBOT, about={"units": "N"})
    return path


def test_a_tree_comes_back_as_it_was_written(saved):
    tree, card = load_tree(saved, TREE, kind="thing", robot=ROBOT)
    assert jax.tree.structure(tree) == jax.tree.structure(TREE)
    for got, expected in zip(jax.tree.leaves(tree), jax.tree.leaves(TREE), strict=True):
        assert got.dtype == expected.dtype
        np.testing.assert_array_equal(got, expected)
    assert card["about"] == {"units": "N"}
    assert card["arrays"]["leaf.force"] == {"shape": [2, 3], "dtype": "float64"}
    assert read_card(saved) == card


def test_the_same_tree_makes_the_same_bytes(saved, tmp_path):
    again = tmp_path / "again.npz"
    save_tree(again, TREE, kind="thing", robot=ROBOT, about={"units": "N"})
    assert again.read_bytes() == saved.read_bytes()


def test_truncated_files_are_refused_by_name(saved):
    data = saved.read_bytes()
    for length in np.linspace(0, len(data) - 1, 16).astype(int):
        saved.write_bytes(data[:length])
        with pytest.raises(ValueError, match="tree.npz: cut or changed"):
            load_tree(saved, TREE, kind="thing")


def test_flipped_bytes_are_refused_by_name(saved):
    data = saved.read_bytes()
    rng = np.random.default_rng(0)
    for place in rng.choice(len(data), 200, replace=False):
        flipped = bytearray(data)
        flipped[place] ^= 1 << rng.integers(8)
        saved.write_bytes(bytes(flipped))
        with pytest.raises(ValueError, match="tree.npz: cut or changed"):
            load_tree(saved, TREE, kind="thing")


def test_another_kind_robot_format_layout_or_shape_is_refused(saved, monkeypatch):
    with pytest.raises(ValueError, match="tree.npz: holds thing, expected net"):
        load_tree(saved, TREE, kind="net")
    other = ROBOT._replace(force=np.array([13.0, 9.81]))
    with pytest.raises(ValueError, match="tree.npz: made for robot"):
        load_tree(saved, TREE, kind="thing", robot=other)
    with pytest.raises(ValueError, match="tree.npz: another layout of thing.*count"):
        load_tree(saved, TREE._replace(table={"Dense_0": TREE.table["Dense_0"]}), kind="thing")
    narrow = TREE._replace(leaf=TREE.leaf._replace(force=np.zeros((2, 4))))
    with pytest.raises(ValueError, match=r"tree.npz: leaf.force has shape \(2, 3\)"):
        load_tree(saved, narrow, kind="thing")
    monkeypatch.setattr(tree_file, "FORMAT", 2)
    with pytest.raises(ValueError, match="tree.npz: file format 1, this version reads 2"):
        load_tree(saved, TREE, kind="thing")


def test_an_unwritable_folder_is_one_line_with_its_name(tmp_path):
    (tmp_path / "wall").write_text("a file, no folder")
    with pytest.raises(WriteError, match="cannot write .*wall/tree.npz"):
        save_tree(tmp_path / "wall" / "tree.npz", TREE, kind="thing")


def test_files_have_the_rights_that_the_umask_leaves(tmp_path):
    before = os.umask(0o027)
    try:
        files.write_file(tmp_path / "file", b"data")
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o640


def test_a_robot_is_known_by_its_numbers():
    same = jax.tree.map(lambda x: np.array(x, copy=True), ROBOT)
    other = ROBOT._replace(flag=np.array(0.2501))
    assert tree_hash(ROBOT) == tree_hash(same)
    assert tree_hash(ROBOT) != tree_hash(other)
    near = ROBOT._replace(flag=np.array(0.25 + 1e-15))
    assert tree_hash(ROBOT) != tree_hash(near)
    assert tree_hash(ROBOT, 9) == tree_hash(near, 9)
    assert tree_hash(ROBOT, 9) != tree_hash(other, 9)


def test_json_has_null_for_what_is_no_number(tmp_path):
    odd = {"a": (1.0, np.nan), "b": [{"c": -np.inf}], "d": "nan", "e": np.float64("nan")}
    files.write_json(tmp_path / "odd.json", odd)
    told = json.loads((tmp_path / "odd.json").read_text())
    assert told == {"a": [1.0, None], "b": [{"c": None}], "d": "nan", "e": None}
    assert "\n" not in files.as_json(odd)


def test_weights_come_back_as_they_were_written(tmp_path):
    path = tmp_path / "weights.json"
    others = {"friction": np.array(0.3), "kp": np.arange(1.0, 6.0)}
    for weights in (nominal(), expert(), nominal()._replace(others=others)):
        save_weights(path, weights)
        again = load_weights(path)
        assert jax.tree.structure(again) == jax.tree.structure(weights)
        jax.tree.map(np.testing.assert_array_equal, again, weights)


@pytest.fixture
def edited(tmp_path, monkeypatch):
    """Changes the text of a module of the package, as far as `code_hash` can see."""
    source = environment._source

    def edit(module, before, after):
        text = source(module).read_text()
        assert before in text
        (tmp_path / "edited.py").write_text(text.replace(before, after))
        other = lambda name: tmp_path / "edited.py" if name == module else source(name)  # noqa: E731
        monkeypatch.setattr(environment, "_source", other)
        environment.code_hash.cache_clear()

    yield edit
    monkeypatch.undo()
    environment.code_hash.cache_clear()


@pytest.mark.parametrize(
    ("module", "before", "after", "same"),
    [
        ("control.footstep", "stance / 2 * state.velocity", "stance / 3 * state.velocity", False),
        ("control.footstep", "    points = (", "    # a comment\n    points = (", True),
        ("control.footstep", "Next touchdown of each foot", "Another docstring", True),
        ("core.console", "_QUIET = 15.0", "_QUIET = 16.0", True),
        ("export.export", "TOLERANCE = 1e-6", "TOLERANCE = 1e-7", True),
    ],
)
def test_a_result_holds_for_the_code_that_computes_it(edited, module, before, after, same):
    hashes = (environment.code_hash("sim.walk"), code_hash("tuning.difftune", "grfm.network"))
    edited(module, before, after)
    again = (environment.code_hash("sim.walk"), code_hash("tuning.difftune", "grfm.network"))
    assert [a == b for a, b in zip(hashes, again, strict=True)] == [same, same]


def test_a_renamed_pickle_is_refused(tmp_path):
    path = tmp_path / "tree.npz"
    path.write_bytes(pickle.dumps({"a": 1}) * 20)
    with pytest.raises(ValueError, match="tree.npz: cut or changed"):
        load_tree(path, TREE, kind="thing")


def test_objects_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="[Oo]bject"):
        save_tree(tmp_path / "tree.npz", {"a": np.array([None])}, kind="thing")
    assert list(tmp_path.iterdir()) == []
