"""The paper's table: its figures, what has to hold, and four files that tell the same."""

import csv
import json
import re

import numpy as np
import pytest
import table_report as table
from pretend import pretend_score, pretend_tuning, pretend_verdict
from table_report import PAPER, Fall, Search, Table, write_table

from hector_jax.report.report import Picture
from hector_jax.tuning.loss import PAPER_LOSS
from hector_jax.verdict import metrics


def judged(seeds=4, fell=(), **levels):
    """A verdict of sets whose losses are `levels` on every plant, but for a little."""
    wobble = 1 + 0.01 * np.arange(seeds)
    scores = {
        name: [pretend_score(level * w, (name, i) in fell) for i, w in enumerate(wobble)]
        for name, level in levels.items()
    }
    return metrics.make_verdict(PAPER_LOSS, range(seeds), {"s": scores})


GOOD = {"nominal": 5e6, "expert": 4e6, "search_200": 2e6, "without": 3e6, "with": 1.5e6}


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


def test_the_ranking_is_by_the_median_of_the_paired_ratio():
    assert table.ranking(judged(**GOOD)) == ["with", "search_200", "without", "expert", "nominal"]


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


def test_every_fall_is_shown_and_the_comparison_marked(tmp_path):
    fell = {("with", 1), ("with", 3)}
    told = whole(s=judged(fell=fell, **GOOD))._replace(
        falls=[Fall("s", "with", i, 1.25 + i, 0.262, 0.1, -0.5) for i in (1, 3)]
    )
    text = write_table(tmp_path, told).read_text()
    assert "2 of 20 walks ended in a fall" in text
    assert "| s: with | 1 | 2.25 | 26.2 | 5.7 | -28.6 |" in text
    assert "| s: with | 3 | 4.25 |" in text
    assert re.search(r"s: `with` against `without` .*\d\] \\\*", text)
    assert "$^{*}$" in (tmp_path / "table.tex").read_text()
    assert json.loads((tmp_path / "table.json").read_text())["falls"][1]["seed"] == 3


def test_the_latex_table_is_well_formed(tmp_path):
    write_table(tmp_path, whole(straight=judged(**GOOD, my_own=1e6), s=judged(**GOOD)))
    text = (tmp_path / "table.tex").read_text()
    body = [line for line in text.splitlines() if not line.startswith("%")]
    assert body[0].startswith(r"\begin{tabular}{l")
    assert body[-1] == r"\end{tabular}"
    columns = len(re.search(r"\{tabular\}\{(\w+)\}", text).group(1))
    for line in body[1:-1]:
        if line == r"\hline":
            continue
        assert line.endswith(r" \\")
        wide = re.match(r"\\multicolumn\{(\d+)\}", line)
        cells = int(wide.group(1)) if wide else len(re.findall(r"(?<!\\)&", line)) + 1
        assert cells == columns, line
        assert len(re.findall(r"(?<!\\)\$", line)) % 2 == 0, line
        depth = np.cumsum([(c == "{") - (c == "}") for c in re.sub(r"\\.", "", line)])
        assert depth.min() >= 0
        assert depth[-1] == 0
        outside = re.sub(r"(?<!\\)\$.*?(?<!\\)\$", "", line)
        assert not re.search(r"(?<!\\)[_%#^]", outside), line
    assert r"my\_own" in text
    assert text.count(r"\textbf") == 8
