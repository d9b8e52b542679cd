"""The table on the terminal and report.md: both tell all, and the same."""

import io
import re

import numpy as np
from pretend import SETS, pretend_history, pretend_verdict, tuning_of
from rich.console import Console

from hector_jax.control.parameters import bounds
from hector_jax.control.weights import nominal
from hector_jax.core.environment import environment
from hector_jax.report import report
from hector_jax.report.report import Picture, print_tables
from hector_jax.report.run import write_run_report
from hector_jax.tuning.curvature import Determined, Direction
from hector_jax.tuning.status import StepStatus, Stop
from hector_jax.walk_tuning.walks import WalkedSet, WalkTuning


def printed(verdict, **options):
    out = io.StringIO()
    print_tables(verdict, console=Console(file=out, **options))
    return out.getvalue()


def written(folder, verdict=None, **others):
    history = pretend_history(14, refused=(3, 12))
    history[12] = history[12]._replace(status=np.array(StepStatus.UNSOLVED))
    direction = Direction(0.25, 0.96, {"Q_pitch": 0.9, "Q_x": -0.4})
    tuning, small = tuning_of(history, bounds()[1]), np.array(Stop.SMALL_STEP)
    contents = {
        "trajectory": "straight",
        "verdict": verdict or pretend_verdict(),
        "tunings": {"without": tuning, "with": tuning._replace(stop=small), "best": tuning},
        "norms": {"without": {"L_Eul": 12.0, "L_pos": 7.0, "L_ctrl": 8e5}},
        "determined": Determined([direction], 18, {"Q_pitch": 0.9, "R_Mz": 0.1}),
        "errors": errors(),
        "pictures": [Picture("loss.png", "Loss by iteration.")],
        "film": "no film: MuJoCo cannot draw here (egl: no device)",
        "config": {"traj": "straight", "seeds": 8, "tune": {"ridge": 0.003}},
        "environment": environment(),
        "command": "make tune TRAJ=straight",
        "run": "latest",
        "elsewhere": "",
        "walks": None,
        "smooth": 10.0,
        "draws": 4,
    }
    return write_run_report(folder, **contents | others).read_text()


def tuned_on_walks():
    """Five sets in four cases, of which some fall."""
    losses = [1e6 * np.ones(4), 0.9e6 * np.ones(4), 0.81e6 * np.ones(4), np.full(4, np.inf)]
    losses[2][3] = np.inf
    rows = zip([*losses, 1.1e6 * np.ones(4)], (True, True, False, False, False), strict=True)
    return WalkTuning([WalkedSet(nominal(), *row) for row in rows], None, "4 iterations")


def errors(**more):
    """Of the commands, of a linear map and of the net."""
    return {
        name: {"force": x, "moment": x / 200, "stance": [x] * 6, "swing": [x] * 5 + [0.0], **more}
        for name, x in {"raw": 275.0, "linear": 119.0, "net": 73.0}.items()
    }


def test_the_table_has_a_row_for_each_set_and_marks_a_comparison_that_falls_make_void():
    text = printed(pretend_verdict())  # plain and uncut, as there is no terminal
    head, *rows = [line for line in text.splitlines() if line.strip()][1:]
    assert head.split()[:6] == ["set", "plane", "height", "pitch", "L", "falls"]
    assert rows[0].split()[:4] == ["[cm]", "[cm]", "[deg]", "x1e6"]
    assert [row.split()[0] for row in rows[2:6]] == list(SETS)
    assert "hardware stand-in" in text
    for words in ("does not count", "touched", "\x1b", "…"):
        assert words not in text
    fallen = pretend_verdict(fallen={("without", 0)})
    row = next(line for line in printed(fallen).splitlines() if line.startswith("without "))
    assert row.count("*") == 2
    assert "does not count" in printed(fallen)
    assert "…" not in printed(fallen, force_terminal=True, width=80)


def test_walks_are_not_counted_as_plants_and_one_plant_has_no_interval(tmp_path):
    verdict = pretend_verdict(4, {("with", 0)}, scenes=("straight", "c", "s"))
    first, second, *_ = report.legend(verdict)
    seeds = "seeds 0-3; those below 32 served development"
    assert first.endswith(f"; means over 4 plants and 3 trajectories ({seeds}).")
    assert "of the paired ratio, of each plant the median over its trajectories; below" in second
    assert second.endswith("; no interval from fewer than 6 plants.")
    text = written(tmp_path, verdict)
    assert "the robot fell in 3 of 12 walks (4 plants, 3 trajectories)." in text
    assert "| 3 / 12 |" in text
    assert "12 plants" not in text
    one = pretend_verdict(1)
    first, second, *_ = report.legend(one)
    assert "means over 1 plant (seed 0; " in first
    assert "[95 % interval]" not in second
    fresh = report.legend(pretend_verdict(6)._replace(seeds=np.arange(32, 38)))
    assert "(seeds 32-37)." in fresh[0]
    assert "paired ratio [95 % interval]; below zero is better." in fresh[1]
    for text in (printed(one), report.render("verdict.md.j2", verdict=one)):
        assert not re.search(r"1 plants|seeds 0|\d \[[+-]?\d", text)


def test_scales_are_powers_of_a_thousand_and_falls_leave_the_others_their_digits():
    for numbers, power, texts in (
        ([1.234e6, 2.345e6, 1.1e8], 6, ["1.23", "2.35", "110.00"]),
        ([0.0512, 0.71, 5.2], 0, ["0.0512", "0.7100", "5.2000"]),
        ([0.0, 2.345e6, 12.1e6], 6, ["0.00", "2.35", "12.10"]),
        ([0.02], -3, ["20.0"]),
    ):
        column = report.column("L", *numbers)
        assert (column.power, [column.text(x) for x in numbers]) == (power, texts)


PROMISED = """
## Verdict
## Tuning
## GRFM-Net on held-out
## Pictures
## What was run
hardware stand-in
![Loss by iteration.](loss.png)
No film: MuJoCo cannot draw here (egl: no device)
| `Q_pitch` against `Q_x` | 25.0 | 96 |
2 refused: loss or gradient not finite (iteration 3); QP residual (iteration 12)
ended because: the step became too small to gain
ended because: 14 iterations
`Q_roll`
2 (m g)^2
another value may be as good: `R_Mz`.
make tune TRAJ=straight
This run: 1e5, 2e5,
`best` first minimises the mean of L / L(start) over 4 drawn models
cost 11 times as much, plus 0.003 / 2 times the squared log-steps
the robot fell on 1 of 8 plants.
"""
OF_WALKS = """
This run: 1e5, 2e5, 0.623.
| touchdown, sideways [cm^2] | 4 | 4 | 4 |
[Before and after.](film.mp4)
Each weight set walked 4 times (all trajectories, on each plant)
`best` is set 1, the last accepted one or set 0
; it ended because: 4 iterations.
| 0 | +0.0 | 0 | accepted |
| 1 | -10.0 | 0 | accepted |
| 2 | -19.0 | 1 | refused |
| 3 |  | 4 | refused |
| 4 | +10.0 | 0 | refused |
void: the falls differ
The legs touched each other, which is no fall: with 0.030 s in all.
"""


def test_the_report_tells_what_was_promised_and_what_is_particular_to_a_run(tmp_path):
    verdict = pretend_verdict(fallen={("with", 1)})
    text = written(tmp_path, verdict)
    for words in PROMISED.strip().splitlines():
        assert words in text
    for words in ("touchdown", "Tuning on walks"):
        assert words not in text
    weighed = (*verdict.loss[:2], verdict.loss[2]._replace(weight=0.623))  # a robot's own
    touch = verdict.scores["with"]._replace(legs_touch=np.array([[0.03]] + [[0.0]] * 7))
    verdict = verdict._replace(scores=verdict.scores | {"with": touch}, loss=weighed)
    assert OF_WALKS.strip().splitlines()[-1] in printed(verdict)
    more = {"film": Picture("film.mp4", "Before and after."), "walks": tuned_on_walks()}
    more |= {"errors": errors(touchdown=[9.0, 4.0]), "begun_with": "with"}
    text = written(tmp_path, verdict, **more)
    for words in OF_WALKS.strip().splitlines():
        assert words in text
    for block in text.split("\n\n"):  # every table is well formed
        rows = [row for row in block.splitlines() if row.startswith("|")]
        assert len({row.count("|") for row in rows}) <= 1, block
    assert "\n*" not in text.replace("\n*Loss", "")


def test_the_report_opens_with_errors_falls_and_the_next_step_and_says_below_where_it_is(tmp_path):
    verdict = pretend_verdict(fallen={("expert", 0)})
    lines = report.first_lines(verdict, "latest")
    of = report.plain_errors(verdict, "with")
    assert lines[0].startswith(f"with is {of['plane']:.1f} cm off, ")
    assert f"{of['pitch']:.1f} degrees in pitch (RMS); nominal " in lines[0]
    assert lines[1].endswith("the tuning has not seen: with 0, nominal 0, expert 1.")
    assert all(f"`hector {name} latest`" in lines[2] for name in ("view", "export"))
    assert written(tmp_path, verdict).split("\n\n")[1:4] == lines
    verdict = pretend_verdict(scenes=("c", "s"))
    of = verdict.scores["with"]
    far = of.rms_position * np.array([1.0, 3.0])[:, None]
    fallen = of.fallen | (np.arange(8)[:, None] < [0, 2])
    found = {"with": of._replace(rms_position=far, fallen=fallen)}
    _, _, worse, after = report.first_lines(verdict._replace(scores=verdict.scores | found), "x")
    assert worse.startswith("Worse on s: 6.7 cm off in the plane, nominal 2.2; 2 falls, nominal 0.")
    assert worse.endswith(" Tune for it alone, or keep nominal there.")
    alone = verdict._replace(scores=verdict.scores | found).of_scene("s")
    assert report.first_lines(alone, "x")[2].endswith("nominal 0. Keep nominal there.")
    assert after.startswith("Next")
    verdict = pretend_verdict()
    swapped = {"nominal": verdict.scores["with"], "with": verdict.scores["nominal"]}
    text = written(tmp_path, verdict._replace(scores=verdict.scores | swapped))
    assert "(`with`), the loss is 174" in text
    assert "% above nominal" in text
