"""The scripts that guard the tests and the numbers: planted faults and golden results."""

import ast
import json

import numpy as np
import pytest
from model import ROOT

from benchmarks import golden, mutation, table


def test_planted_faults_are_the_same_each_time_of_every_part_and_change_the_program():
    drawn = mutation.draw(ROOT, 200, seed=0)
    assert drawn == mutation.draw(ROOT, 200, seed=0)
    assert all(sum(one.part == part for one in drawn) == 50 for part in mutation.PARTS)
    for fault in drawn:
        source = (ROOT / fault.file).read_bytes()
        assert source[fault.begin : fault.end].decode() == fault.before
        planted = source[: fault.begin] + fault.after.encode() + source[fault.end :]
        assert ast.dump(ast.parse(planted)) != ast.dump(ast.parse(source))


def test_the_difference_of_two_results_is_beside_the_largest_number():
    one, missing = np.array([1.0, 100.0]), np.array([1.0, np.nan])
    assert golden.difference(one, one + [0.0, 1.0]) == pytest.approx(0.01)
    assert golden.difference(missing, missing) == 0.0
    for other in (missing, one[:1]):
        assert golden.difference(one, other) == np.inf


def test_the_page_of_performance_has_the_table_of_its_runs():
    page = table.PAGE.read_text()
    assert table.with_table(page) == page
    for path in table.RUNS.iterdir():
        run = json.loads(path.read_text())
        assert run["table"] == table.lines_of(run) != []
