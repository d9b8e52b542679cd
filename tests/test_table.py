"""The paper's table: its figures, what has to hold, and four files that tell the same."""

import csv
import json
import re

import numpy as np
import pytest
import table_report as table
from pretend import pretend_score, pretend_tuning, pretend_verdict
from table_report import PAPER, Fall, Search, Table, summaries, write_table

from hector_jax.report.report import Picture
from hector_jax.tuning.loss import PAPER_LOSS
from hector_jax.verdict import metrics
from hector_jax.verdict.metrics import BASELINES


def judged(seeds=4, fell=(), **levels):
    """A verdict of sets whose losses are `levels` on every plant, but for a little."""
    wobble = 1 + 0.01 * np.arange(seeds)
    scores = {
        name: [pretend_score(level * w, (name, i) in fell) for i, w in enumerate(wobble)]
        for name, level in levels.items()
    }
    return metrics.make_verdict(PAPER_LOSS, range(seeds), {"s": scores})


def with_losses(score, **losses):
    return score._replace(losses=score.losses | losses)


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


def test_the_order_is_held_against_that_of_an_earlier_table(tmp_path):
    write_table(tmp_path, whole(s=judged(**GOOD, mine=1e6)))
    earlier = table.load_earlier(tmp_path / "table.json", range(4, 8))
    assert earlier.plants == "seeds 0-3"
    assert table.load_earlier(tmp_path / "table.json", range(4), "even") == earlier
    with pytest.raises(ValueError, match=r"table.json: a table of the same plants, seeds 0-3"):
        table.load_earlier(tmp_path / "table.json", range(4))
    assert table.swapped_sets({"s": judged(**GOOD)}, earlier) == {"s": []}
    other = judged(**GOOD | {"with": 2.5e6})
    assert table.swapped_sets({"s": other}, earlier) == {"s": [("with", "search_200")]}
    assert table.swapped_sets({"c": judged(**GOOD)}, earlier) == {"c": None}
    for verdict, words in ((judged(**GOOD), "the same"), (other, "`with` and `search_200`")):
        text = write_table(tmp_path, whole(s=verdict)._replace(earlier=earlier)).read_text()
        assert "The order of the sets, against that on seeds 0-3" in text
        assert re.search(rf"^- s: .*{words}$", text, re.MULTILINE)
        (swapped,) = json.loads((tmp_path / "table.json").read_text())["swapped"].values()
        assert swapped == ([] if words == "the same" else [["with", "search_200"]])


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"trajectories": {"s": 1}}'])
def test_a_file_that_is_no_table_is_refused(tmp_path, content):
    path = tmp_path / "table.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ValueError, match="table.json"):
        table.load_earlier(path, range(4))


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


def test_the_report_tells_everything_that_was_promised(tmp_path):
    text = write_table(tmp_path, whole(s=judged(**GOOD))).read_text()
    for words in (
        "hardware stand-in",
        "s: `with` against `search_200`",
        "| s: with | 1.47e3 | 286 | 1.02e6 | 2.05e8 |",
        "![Snapshots.](pictures/s.png)",
        "None of the 20 walks ended in a fall.",
        "| s: `search_200` | 200 | 187 | 1.200 | 20 generations |",
        "ended because: 12 iterations",
        "were made at `abc`",
        "python experiments/table.py",
    ):
        assert words in text, words
    for block in text.split("\n\n"):
        counts = {row.count("|") for row in block.splitlines() if row.startswith("|")}
        assert len(counts) <= 1, block


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


def test_a_set_that_falls_at_once_leaves_files_that_can_be_read(tmp_path):
    verdict = judged(fell={("with", i) for i in range(4)}, **GOOD)
    lost = with_losses(verdict.scores["with"], L_ctrl=np.zeros((4, 1)))._replace(
        rms_euler=np.full((4, 1, 3), np.nan),
        rms_position=np.full((4, 1, 3), np.nan),
    )
    scores = verdict.scores | {"with": lost}
    write_table(tmp_path, whole(s=verdict._replace(scores=scores)))
    json.loads((tmp_path / "table.json").read_text(), parse_constant=lambda x: pytest.fail(x))


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


def test_words_are_escaped_for_latex():
    assert table.tex(r"a_b & 5% #1 {x} ~^$ \n") == (
        r"a\_b \& 5\% \#1 \{x\} \textasciitilde{}\textasciicircum{}\$ \textbackslash{}n"
    )


def test_baselines_are_not_told_against_themselves():
    found = summaries({"s": judged(**GOOD)})
    assert list(found["s", "nominal"].against) == ["expert"]
    assert list(found["s", "with"].against) == [*BASELINES, "without", "search_200"]
