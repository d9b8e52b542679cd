"""Weights in files of other programs: tagged numbers are read and replaced, no other byte is."""

import json

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model import QUADRUPED, ROBOT

from hector_jax.cli.main import main
from hector_jax.control.tagged_file import read_own, with_weights
from hector_jax.control.weights import expert, nominal, vector_to_weights, weight_names
from hector_jax.control.weights_file import load_weights, save_weights, weights_tree
from hector_jax.core.inputs import InputError

YAML = """\
# gains of the walking MPC, in °, \xb5m       # hector: is no tag
state_weights:
  euler: [100, 100.0, 2.5e2]   # hector: Q.euler
  position:   # hector: Q.position[0], Q.position[2], Q.position[1]
    - 200.   # x
    - 300    # z, was 250

    - 200
  rates: {q1: 1, q2: 1, q3: 1, v: [1, 1, 1]}  # hector: Q.ang_velocity, Q.velocity
# force: [9, 9, 9]   # hector: R.force[left]
force: [+5.0e-5, .5e-4, 25e-5]   # hector: R.force[left] * 0.5
force_right: [1e-4, 1e-4, 5e-4]   # hector: R.force[1]
moment: {scale: 3, all: 0.01}  # hector: -, R.moment[all][all]
"""
INI = """\
[mpc]\r
q_roll = 100 ; hector: Q.euler[0]\r
;q_roll = 90 ; hector: Q.euler[0]\r
q2 = 100.0 # hector: Q.euler[1]\r
q_rest = 250, 200 200\t300 # hector: Q.euler[2], Q.position\r
rates = 1,1,1,1,1,1 ; hector: Q.ang_velocity, Q.velocity\r
[forces]\r
left = 1e-4 1e-4 5e-4 ; hector: R.force[left]\r
right = 3e-4 3e-4 15e-4 ; hector: R.force[right] * 3\r
moment = 1e-2 1e-2 1e-2 ; hector: R.moment[all]\r
"""
JSON = """\
{"names": {"q 1.5": "2.5 # \\" 3", "on": true, "none": null},
 "q": [[100, 100, 2.5e2], [200, 200.0, 300]], "w": {"x": 1, "y": 1, "z": 1},
\t"v": [1, 1, 1], "n": -7,
 "r": {"left": {"f": [1E-4, 1e-4, 5e-4]}, "right": {"f": [1e-4, 1e-4, 5e-4]}, "m": 0.01}}"""
KEYS = """\
q = "Q.euler, Q.position"
w = "Q.ang_velocity"
v = "Q.velocity"
r.left.f = "R.force[left]"
r.right.f = "R.force[right]"
r.m = "R.moment[all][all]"
"""
HEADER = """\
#pragma once
#define Q_ROLL 100.0f /* hector: Q.euler[0] */
// #define Q_ROLL 50.0f // hector: Q.euler[0]
static const double Q[12] = {100., 250, 200, 200, 300, 1, 1, 1, 1, 1, 1, 0};//hector: Q.euler[1], \
Q.euler[2], Q.position, Q.ang_velocity, Q.velocity, -
// hector: R.force
std::array<double, 6> alpha = {1e-4, 1e-4, 5e-4,  // left, 1 of 2
    1e-4, 1e-4, 5e-4};
const double dt = 0.03; /* 1/33 */ double moment = 1e-2; // hector: -, R.moment[all][all]
"""
INFO = """\
Q
{
  scaling 1e+0
  (0,0)  100.0  ; hector: Q.euler[0]
  (1,1)  100.0  ; hector: Q.euler[1]
  (2,2)  250.0  ; hector: Q.euler[2]
  ; hector: Q.position, Q.ang_velocity, Q.velocity
  (3,3)  200
  (4,4)  200
  (5,5)  300
  (6,6)  1
  (7,7)  1
  (8,8)  1
  (9,9)  1    ; v_x
  (10,10) 1
  (11,11) 1
}
R { (0,0) 1e-4 ; hector: -, -, R.force[all][0]
  (1,1) 0.003333333333333333333 ; hector: R.force[all][1] / 0.03
  (2,2) 5e-4 ; hector: R.force[all][2]
  (3,3) 0.01 ; hector: R.moment[all][all]
}
"""
FILES = {"g.yaml": YAML, "g.ini": INI, "g.json": JSON, "g.hpp": HEADER, "task.info": INFO}
TIED = {"g.yaml": "M", "g.ini": "M", "g.json": "M", "g.hpp": "M", "task.info": "FM"}
"""Kinds of R of which a file has one number for both feet."""


@pytest.fixture(params=FILES)
def path(request, tmp_path):
    path = tmp_path / request.param
    path.write_bytes(FILES[request.param].encode("latin-1"))  # not in UTF-8
    (tmp_path / "g.hector.toml").write_text(KEYS)
    return path


def written(path, weights):
    return with_weights(path, read_own(path), weights_tree(weights))[0]


def same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_the_numbers_of_each_format_are_read_and_the_same_ones_change_no_byte(path):
    same(load_weights(path), expert())
    assert written(path, expert()).encode(errors="surrogateescape") == path.read_bytes()


positive = st.floats(1e-12, 1e12)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(positive, min_size=24, max_size=24))
def test_what_is_written_is_read_exactly_and_only_digits_differ(path, numbers):
    shared = {}
    for i, name in enumerate(weight_names()):  # one number where the file has one
        kind = name[2:3] if name.startswith("R_") else ""
        if kind and kind in TIED[path.name]:
            key = "M" if kind == "M" and path.name != "g.ini" else name[:4]
            numbers[i] = shared.setdefault(key, numbers[i])
    weights = jax.tree.map(np.asarray, vector_to_weights(np.array(numbers)))
    text = written(path, weights)
    other = path.with_stem("other")
    other.write_bytes(text.encode(errors="surrogateescape"))
    other.with_suffix(".hector.toml").write_text(KEYS)
    same(load_weights(other), weights)
    assert with_weights(other, text, weights_tree(weights)) == (text, [])
    letters = str.maketrans("", "", "0123456789.+-eE")
    assert text.translate(letters) == read_own(path).translate(letters)
    back, _ = with_weights(other, text, weights_tree(expert()))
    assert len(back.splitlines()) == len(read_own(path).splitlines())


def test_yaml_reads_the_numbers_as_numbers(tmp_path):
    (tmp_path / "a.yaml").write_text(YAML)
    small = nominal()._replace(Q=jax.tree.map(lambda x: 0 * x + 1e-7, nominal().Q))
    text = written(tmp_path / "a.yaml", small)
    assert "euler: [1.0e-07, 1.0e-07, 1.0e-07]   # hector" in text


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("Q.euler\n", "Q.eular\n", "g.yaml:3: unknown weight 'Q.eular'; did you mean 'Q.euler'"),
        ("[100, 100.0,", "[100,", "g.yaml:3: Q.euler takes 3 numbers, found 2"),
        ("[100, 100.0,", "[100, nan,", "g.yaml:3: Q.euler takes 3 numbers, found 2"),
        ("[100, 100.0,", "[100, -100.0,", "g.yaml:3: Q.euler must be a number from 1e-12 to"),
        ("[100, 100.0,", "[100, 1e999999999,", "g.yaml:3: Q.euler takes 3 numbers, found 2"),
        ("[100, 100.0,", "[100, 1e300,", "g.yaml:3: Q.euler must be a number from -1e.99 to"),
        ("    - 200\n", "", "g.yaml:4: .* takes 3 numbers, found 2"),
        ("R.force[1]", "R.force[left]", r"g.yaml:12: R.force\[left\] is that of .*g.yaml:11 too"),
        ("R.force[1]", "R.force[both]", "g.yaml:12: R.force.both.: unknown index 'both'"),
        ("R.force[1]", "R.force[2]", "g.yaml:12: R.force.2.: unknown index '2'"),
        ("R.force[1]", "R.force[1][1][1]", "g.yaml:12: R.force.* expected at most 2 of"),
        ("R.force[1]", "R.force[1][2], -, -", r"g.yaml: no tag has R.force\[1\]\[0\]"),
        ("* 0.5", "* 0", "g.yaml:11: the factor of .* must be a number from 1e-12"),
        ("   # hector: Q.euler\n", "\n", 'g.yaml: missing weight "Q.euler"'),
        ("# hector: R", "#", 'g.yaml: missing weight "R.force"'),
        ("hector:", "", "g.yaml: no JSON, and no number has a tag, as in `# hector: Q.euler"),
    ],
)
def test_a_wrong_tag_or_number_is_one_line_with_its_place(tmp_path, old, new, told):
    (tmp_path / "g.yaml").write_text(YAML.replace(old, new))
    with pytest.raises(InputError, match=told) as found:
        load_weights(tmp_path / "g.yaml")
    assert len(str(found.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        (KEYS.replace("r.left.f", "r.left.g"), r"g.hector.toml: r.left .*g.json has no 'g' there"),
        (KEYS + "n = 3", "g.hector.toml: n must be a table.*, got 3|g.hector.toml: n must be"),
        (KEYS + 'names = "Q.euler[0]"', r"names: Q.euler\[0\] takes 1 number, found 0"),
        (
            KEYS.replace('"Q.velocity"', '"Q.euler"'),
            "g.json:2: Q.euler is that of .*g.json:3 too|to",
        ),
        ("q = [", "g.hector.toml: not valid TOML"),
    ],
)
def test_wrong_keys_of_a_json_file_are_one_line(tmp_path, keys, told):
    (tmp_path / "g.json").write_text(JSON)
    (tmp_path / "g.hector.toml").write_text(keys)
    with pytest.raises(InputError, match=told) as found:
        load_weights(tmp_path / "g.json")
    assert len(str(found.value).splitlines()) == 1


def test_weights_that_have_no_place_in_the_file_are_refused(path):
    more = expert()._replace(others={"friction": np.array(0.5)})
    with pytest.raises(InputError, match=f"{path.name}: no tag has others.friction"):
        written(path, more)
    unlike = expert()
    unlike.R.moment[0, 0] = 0.02
    with pytest.raises(InputError, match=r"R.moment.* is one number, the weights are 0.01, 0.02"):
        written(path, unlike)


def test_four_point_feet_and_other_numbers_have_tags(tmp_path):
    (tmp_path / "dog.yaml").write_text(
        "q: [9, 9, 9, 5, 5, 5, 1, 1, 1, 1, 1, 1] "
        "# hector: Q.euler, Q.position, Q.ang_velocity, Q.velocity\n"
        "alpha: 1e-6 # hector: R.force[all][all]\n"
        "mu: 0.6 # hector: others.friction\nkp: [1, 2, 3] # hector: others.kp\n"
    )
    found = load_weights(tmp_path / "dog.yaml", QUADRUPED)
    assert found.R.force.tolist() == [[1e-6] * 3] * 4
    assert found.others["kp"].tolist() == [1.0, 2.0, 3.0]
    assert float(found.others["friction"]) == 0.6


def test_commands_take_the_file_and_write_a_copy(path, monkeypatch, capsys):
    def call(*words):
        monkeypatch.setattr("sys.argv", ["hector", *map(str, words)])
        return main()

    folder, before = path.parent, path.read_bytes()
    save_weights(folder / "tuned.json", nominal(ROBOT))
    assert call("export", folder / "tuned.json", "--into", path, "--json") == 0
    copy = folder / "export" / path.name
    assert json.loads(capsys.readouterr().out) == {"file": str(copy)}
    assert path.read_bytes() == before
    same(load_weights(copy), nominal())
    line = ("walk", "--world", "srbm", "--seconds", "0.1", "--json", "--weights")
    assert call(*line, copy) == 0
    found = capsys.readouterr().out
    assert call(*line, folder / "tuned.json") == 0
    other = capsys.readouterr().out
    assert found == other
    assert call("export", "shipped", "--into", path, "--out", folder) == 2
    assert "would be overwritten" in capsys.readouterr().err
    assert path.read_bytes() == before
