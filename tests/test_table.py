"""The paper's table: its figures, what has to hold, and four files that tell the same."""

import csv
import json

import numpy as np
import pytest
import table_report as table
from pretend import pretend_tuning, pretend_verdict
from table_report import PAPER, Search, Table, write_table

from hector_jax.report.report import Picture
from hector_jax.verdict import metrics


def whole(**verdicts):
    tuning = pretend_tuning(12)
    return Table(
        verdicts=verdicts,
        falls=[],
        tunings={name: {"without": tuning, "with": tuning} for name in verdicts},
        searches={name: Search(200, 187, 1.2e6, "20 generations") for name in verdicts},
        long_searches={},
        pictures=[Picture("pictures/s.png", "Snapshots.")],
        config={"flags": {"seeds": 4}},
        environment={"jax": "0.10", "commit": "abc"},
        commits=["abc"],
        command="python experiments/table.py",
    )


def test_the_papers_changes_are_those_of_its_text():
    """68.7, 29.7, 41.9 % below nominal and 19.4, 40.5, 17.0 % below expert."""
    said = {"nominal": (-68.7, -29.7, -41.9), "expert": (-19.4, -40.5, -17.0)}
    for baseline, expected in said.items():
        found = [table.paper_change(t, "with", baseline) for t in ("straight", "c", "s")]
        np.testing.assert_allclose(found, expected, atol=0.05)


def test_the_papers_total_is_the_weighted_sum_of_its_parts():
    for sets in PAPER.values():
        for euler, position, control, total in sets.values():
            assert 1e5 * euler + 2e5 * position + control == pytest.approx(total, rel=0.01)


def test_the_four_files_tell_the_same_numbers(tmp_path):
    verdict = pretend_verdict(8)
    path = write_table(tmp_path, whole(straight=verdict, c=verdict))
    assert path == tmp_path / "report.md"
    change = metrics.compare(verdict, "with", "nominal").change["L"]
    told = json.loads((tmp_path / "table.json").read_text())
    kept = told["trajectories"]["c"]["sets"]["with"]["standin"]
    assert kept["change"]["nominal"]["median"] == pytest.approx(change.value)
    assert kept["by_seed"]["L"] == verdict.scores["with"].L[:, 0].tolist()
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 4 * 4
    (row,) = [
        r for r in rows if (r["trajectory"], r["set"], r["part"]) == ("straight", "with", "L")
    ]
    assert float(row["median_nominal"]) == pytest.approx(change.value, rel=1e-5)
    assert float(row["wins_expert"]) == metrics.compare(verdict, "with", "expert").wins
    assert [r["paper_nominal"] for r in rows if r["set"] == "with" and r["part"] == "L"] == [
        "-68.705",
        "-29.6578",
    ]
    shown = f"{change.value:+.0f} [{change.low:+.0f}, {change.high:+.0f}]"
    assert shown in path.read_text()
    assert shown in (tmp_path / "table.tex").read_text().replace("$", "")
