"""The scripts that guard the tests and the numbers: planted faults and golden results."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import golden, mutation
from benchmarks.measuring import Check, compare, last_run

ROOT = Path(__file__).parents[1]


def test_planted_faults_are_the_same_each_time_and_of_every_part():
    drawn = mutation.draw(ROOT, 200, seed=0)
    assert drawn == mutation.draw(ROOT, 200, seed=0)
    assert {part: sum(one.part == part for one in drawn) for part in mutation.PARTS} == {
        part: 50 for part in mutation.PARTS
    }


def test_a_planted_fault_changes_the_program_and_leaves_it_one():
    for fault in mutation.draw(ROOT, 200, seed=0):
        source = (ROOT / fault.file).read_bytes()
        assert source[fault.begin : fault.end].decode() == fault.before
        planted = source[: fault.begin] + fault.after.encode() + source[fault.end :]
        assert ast.dump(ast.parse(planted)) != ast.dump(ast.parse(source))


@pytest.mark.parametrize(
    ("before", "now", "expected"),
    [
        ([1.0, 100.0], [1.0, 101.0], 0.01),
        ([1.0], [1.0, 1.0], np.inf),
        ([1.0, np.nan], [1.0, np.nan], 0.0),
        ([1.0, np.nan], [1.0, 2.0], np.inf),
    ],
)
def test_the_difference_of_two_results_is_beside_the_largest_number(before, now, expected):
    assert golden.difference(np.array(before), np.array(now)) == pytest.approx(expected)


def test_times_are_compared_with_the_last_run_on_such_a_machine(tmp_path):
    machine = {"platform": "Linux", "cores": 2, "device": "cpu", "quick": False}
    runs = [
        ("01", machine, "realtime", 1.0),
        ("02", machine, "batch", 3.0),
        ("03", {**machine, "cores": 64}, "realtime", 0.5),
    ]
    for name, its, section, value in runs:
        checks = [Check("tick", value, "ms"), Check("worst error", 1e-9, "N")]
        text = json.dumps({"machine": its, "sections": {section: {"checks": checks}}})
        (tmp_path / f"{name}.json").write_text(text)
    assert last_run(tmp_path, machine) == {"realtime": {"tick": 1.0}, "batch": {"tick": 3.0}}
    assert compare(1.11, 1.0) == "1.11 of the last run SLOWER"
    assert compare(1.09, 1.0) == "1.09 of the last run"
    assert compare(1.0, None) == ""
