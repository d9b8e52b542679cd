"""The table on the terminal and report.md: both tell all, and the same."""

import io
import re

import numpy as np
import pytest
from pretend import SETS, pretend_history, pretend_verdict, tuning_of
from rich.console import Console

from hector_jax.control.parameters import bounds
from hector_jax.control.weights import expert
from hector_jax.core.environment import environment
from hector_jax.report import report
from hector_jax.report.report import Picture, print_table
from hector_jax.report.run import tuning_section, write_run_report
from hector_jax.tuning.curvature import Determined, Direction
from hector_jax.tuning.status import StepStatus, Stop
from hector_jax.walk_tuning.walks import Change


def _printed(verdict, **options):
    out = io.StringIO()
    print_table(verdict, "straight", console=Console(file=out, **options))
    return out.getvalue()


WALKED = [Change("start", None, 0.0), Change("model", -12.34, -10), Change("model", -5, None)]


def _report(verdict=None, film="no film: MuJoCo cannot draw here (egl: no device)"):
    history = pretend_history(14, refused=(3, 12))
    history[12] = history[12]._replace(status=np.array(StepStatus.UNSOLVED))
    tuning = tuning_of(history, bounds()[1])
    errors = {
        name: {"force": x, "moment": x / 200, "stance": [x] * 6, "swing": [x] * 5 + [0.0]}
        for name, x in {"raw": 275.0, "linear": 119.0, "net": 73.0}.items()
    }
    return dict(
        trajectory="straight",
        verdict=verdict or pretend_verdict(),
        tunings={
            "without": tuning,
            "with": tuning._replace(stop=np.array(Stop.SMALL_STEP)),
            "best": tuning,
        },
        norms={"without": {"L_Eul": 12.0, "L_pos": 7.0, "L_ctrl": 8e5}},
        determined=Determined(
            [Direction(0.25, 0.96, {"Q_pitch": 0.9, "Q_x": -0.4})],
            18,
            {"Q_pitch": 0.9, "R_Mz": 0.1},
        ),
        errors=errors,
        pictures=[Picture("loss.png", "Loss by iteration.")],
        film=film,
        config={"traj": "straight", "seeds": 8, "choice_plants": 4, "tune": {"ridge": 0.003}},
        environment=environment(),
        command="make tune TRAJ=straight",
        run="latest",
        proposals=(),
        best_proposal="",
        cases=0,
        chosen="iteration 3",
        smooth=10.0,
        draws=4,
    )


def test_the_table_has_a_row_for_each_set_and_its_scales_in_the_header():
    text = _printed(pretend_verdict())
    head, *rows = [line for line in text.splitlines() if line.strip()][1:]
    assert head.split()[:6] == ["set", "L_Eul", "L_pos", "L_ctrl", "L", "falls"]
    assert "x1e6" in rows[0]
    assert [row.split()[0] for row in rows[2:6]] == list(SETS)
    assert "hardware stand-in" in text


def test_the_table_is_plain_and_uncut_where_there_is_no_terminal():
    text = _printed(pretend_verdict())
    assert "\x1b" not in text
    assert "…" not in text


def test_the_table_fits_a_terminal_of_80_columns():
    text = _printed(pretend_verdict(fallen={("without", 0)}), force_terminal=True, width=80)
    assert "…" not in text
    assert "without" in text


def test_a_comparison_that_falls_make_void_is_shown_with_a_mark():
    assert "does not count" not in _printed(pretend_verdict())
    text = _printed(pretend_verdict(fallen={("without", 0)}))
    row = next(line for line in text.splitlines() if line.startswith("without "))
    assert row.count("*") == 2
    assert "does not count" in text


def test_legs_that_touch_are_told_where_they_do(tmp_path):
    verdict = pretend_verdict()
    assert "touched" not in _printed(verdict)
    scores = dict(verdict.scores)
    scores["with"] = scores["with"]._replace(legs_touch=np.array([[0.03]] + [[0.0]] * 7))
    verdict = verdict._replace(scores=scores)
    line = "The legs touched each other, which is no fall: with 0.030 s in all."
    assert line in _printed(verdict)
    assert line in write_run_report(tmp_path, **_report(verdict)).read_text()


def test_the_table_goes_without_baselines_that_were_not_walked():
    whole = pretend_verdict(2)
    text = _printed(whole._replace(scores={"mine.json": whole.scores["with"]}))
    assert "against" not in text
    assert "Change of L" not in text
    both = _printed(whole._replace(scores={n: whole.scores[n] for n in ("nominal", "with")}))
    assert "against nominal" in both
    assert "against expert" not in both


def test_one_plant_is_told_in_the_singular_and_without_an_interval():
    one = pretend_verdict(1)
    for text in (
        _printed(one),
        report.render("verdict.md.j2", verdict=one),
        " ".join(report.legend(one)),
    ):
        assert "1 plants" not in text
        assert "seeds 0" not in text
        assert "[9" not in text
        assert re.search(r"[+-]\d+ \[", text) is None
    assert "means over 1 plant (seed 0)." in report.legend(one)[0]
    assert "interval" not in report.legend(one)[1]


def test_walks_on_several_trajectories_are_not_counted_as_plants(tmp_path):
    verdict = pretend_verdict(4, {("with", 0)}, scenes=("straight", "c", "s"))
    first, second, *_ = report.legend(verdict)
    assert first.endswith("; means over 4 plants and 3 trajectories (seeds 0-3).")
    assert "median over plants and trajectories of the paired ratio" in second
    assert "intervals redraw the plants" in second
    text = write_run_report(tmp_path, **_report(verdict)).read_text()
    assert "the robot fell in 3 of 12 walks (4 plants, 3 trajectories)." in text
    assert "| 3 / 12 |" in text
    assert "12 plants" not in text
    text = write_run_report(tmp_path, **_report(pretend_verdict(4, {("with", 0)}))).read_text()
    assert "the robot fell on 1 of 4 plants." in text
    assert "| 1 / 4 |" in text
    assert "trajectories" not in text


@pytest.mark.parametrize(
    ("number", "power"), [(0.0, 0), (0.5, 0), (12.0, 0), (7e5, 3), (2e6, 6), (0.02, -3)]
)
def test_scales_are_powers_of_a_thousand(number, power):
    assert report.column("L", number).power == power


@pytest.mark.parametrize(
    ("numbers", "texts"),
    [
        ([1.234e6, 2.345e6, 1.1e8], ["1.23", "2.35", "110.00"]),
        ([1.234e6, 3e9], ["1.23", "3000.00"]),
        ([0.0512, 0.71, 5.2], ["0.0512", "0.7100", "5.2000"]),
        ([0.0, 2.345e6, 12.1e6], ["0.00", "2.35", "12.10"]),
        ([1e-9, 2.5, 2.6], ["0.0000", "2.5000", "2.6000"]),
    ],
)
def test_a_row_of_falls_leaves_the_others_their_digits(numbers, texts):
    column = report.column("L", *numbers)
    assert [column.text(x) for x in numbers] == texts


def test_the_report_tells_everything_that_was_promised(tmp_path):
    path = write_run_report(tmp_path, **_report())
    assert "| `Q_pitch` against `Q_x` | 25.0 | 96 |" in path.read_text()
    text = path.read_text()
    assert path == tmp_path / "report.md"
    for section in ("Verdict", "Tuning", "GRFM-Net on held-out", "Pictures", "What was run"):
        assert f"## {section}" in text
    for words in (
        "hardware stand-in",
        "![Loss by iteration.](loss.png)",
        "No film: MuJoCo cannot draw here (egl: no device)",
        "14 iterations, 2 refused: loss or gradient not finite (iteration 3); "
        "QP residual (iteration 12)",
        "ended because: the step became too small to gain",
        "`Q_roll`",
        "2 (m g)^2",
        "another value may be as good: `R_Mz`.",
        "ended because: 14 iterations",
        "make tune TRAJ=straight",
        "the paper's footnote".capitalize(),
    ):
        assert words in text, words


def test_the_report_opens_with_errors_falls_and_what_to_do_next(tmp_path):
    verdict = pretend_verdict(fallen={("expert", 0)})
    lines = report.first_lines(verdict, "latest")
    assert len(lines) == 3
    of = report.plain_errors(verdict, "with")
    assert lines[0].startswith(f"with is {of['plane']:.1f} cm off, ")
    assert f"{of['pitch']:.1f} degrees in pitch (RMS); nominal " in lines[0]
    assert lines[1].endswith("the tuning has not seen: with 0, nominal 0, expert 1.")
    assert all(f"`hector {name} latest`" in lines[2] for name in ("view", "export"))
    text = write_run_report(tmp_path, **_report(verdict)).read_text()
    assert text.split("\n\n")[1:4] == lines
    assert text.split("\n\n")[4].startswith("| RMS error | in the plane [cm] |")


def test_the_report_names_the_iteration_that_was_taken_and_the_errors_of_touchdowns(tmp_path):
    plain = write_run_report(tmp_path, **_report()).read_text()
    assert "touchdown" not in plain
    assert "`best` minimises the mean of L / L(start) over 4 drawn models" in plain
    assert "cost 11 times as much, plus 0.003 / 2 times the squared log-steps" in plain
    assert "the iteration that walks best on 4 plants drawn around the hfs" in plain
    report = _report()
    errors = {name: one | {"touchdown": [9.0, 4.0]} for name, one in report["errors"].items()}
    text = write_run_report(tmp_path, **(report | {"errors": errors})).read_text()
    assert text.count("- taken: iteration 3\n") == 1
    assert "| touchdown, sideways [cm^2] | 4 | 4 | 4 |" in text


def test_the_report_has_the_weight_of_each_term_of_the_loss(tmp_path):
    verdict = pretend_verdict()
    weighed = (*verdict.loss[:2], verdict.loss[2]._replace(weight=0.623))  # a robot's own
    text = write_run_report(tmp_path, **_report(verdict._replace(loss=weighed))).read_text()
    assert "This run: 1e5, 2e5, 0.623." in text
    assert "| alpha_3 L_ctrl |" in text


def test_every_table_of_the_report_is_well_formed(tmp_path):
    report = _report(pretend_verdict(fallen={("with", 1)})) | {
        "proposals": WALKED,
        "best_proposal": "set 1",
        "cases": 6,
    }
    text = write_run_report(tmp_path, **report).read_text()
    for block in text.split("\n\n"):
        rows = [row for row in block.splitlines() if row.startswith("|")]
        assert len({row.count("|") for row in rows}) <= 1, block
    assert "void: the falls differ" in text
    assert "\n*" not in text.replace("\n*Loss", "")


def test_the_report_says_below_only_where_the_loss_is_below(tmp_path):
    verdict = pretend_verdict()
    swapped = {"nominal": "with", "with": "nominal"}
    scores = {name: verdict.scores[swapped.get(name, name)] for name in SETS}
    text = write_run_report(tmp_path, **_report(verdict._replace(scores=scores))).read_text()
    assert "(`with`), the loss is 174" in text
    assert "% above nominal" in text


def test_the_film_is_linked_where_there_is_one(tmp_path):
    text = write_run_report(
        tmp_path, **_report(film=Picture("film.mp4", "Before and after."))
    ).read_text()
    assert "[Before and after.](film.mp4)" in text


def test_the_report_says_what_was_tuned_beside_the_weights():
    others = {"turn_lead": np.array(2.0), "kp": np.full(5, 60.0)}
    history = pretend_history(12, turn_lead=0.5, kp=others["kp"])
    end = expert()._replace(others=others)
    text = tuning_section("with", tuning_of(history, end))
    assert "- ended because: 12 iterations" in text
    assert "- L on the model: " in text
    assert "- turn_lead: 0.5 at the start, 2.0 at the end" in text
    assert text.count("`turn_lead`") == 1  # at a bound at the end


def test_a_tuning_on_walks_shows_each_set_and_its_falls(tmp_path):
    report = _report() | {"proposals": WALKED, "best_proposal": "set 1", "cases": 6}
    text = write_run_report(tmp_path, **report).read_text()
    assert "Each weight set was walked 6 times" in text
    assert "the one that walks best there is `best`: set 1." in text
    assert "| 0, start |  | +0.0 |" in text
    assert "| 1, model | -12.3 | -10.0 |" in text
    assert "| 2, model | -5.0 | fell |" in text
    assert "Tuning on walks" not in write_run_report(tmp_path, **_report()).read_text()


def test_a_report_says_what_changes_of_the_command_cost_in_best(tmp_path):
    words = "changes of the command between switches of stance cost 4 times as much"
    assert words in write_run_report(tmp_path, **_report() | {"smooth": 3.0}).read_text()
