"""The scripts that guard the tests and the numbers: planted faults and golden results."""

import ast
from pathlib import Path

import numpy as np
import pytest

from benchmarks import golden, mutation

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
