"""Pictures: what is drawn is what was measured, with names and units, whatever a run can bring."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from pictures import PICTURES, draw_method, draw_race
from PIL import Image
from pretend import elsewhere, pretend_history, pretend_walk

from hector_jax import PAPER_LOSS, State
from hector_jax.report import plots
from hector_jax.report.plots.style import SETS, looks_of

FOUR = ("nominal", "expert", "without", "with")


@pytest.fixture(scope="module")
def walks():
    made = (pretend_walk(i, 0.02 + 0.01 * i, seconds=1.0, turn=0.5) for i in range(4))
    return dict(zip(FOUR, made, strict=True))


def lines(axes):
    """Data of an axes' lines by their label."""
    return {line.get_label(): np.asarray(line.get_xydata()) for line in axes.lines}


def test_errors_and_paths_do_not_depend_on_where_a_walk_began(tmp_path, drawn, walks):
    one = walks["with"]
    pair = {"with": one, "nominal": elsewhere(one, (0.4, -1.0), 2.0)}
    plots.save_tracking(tmp_path / "a.png", pair)
    caption = plots.save_path(tmp_path / "b.png", pair)
    assert "one reference" in caption
    for axes in [*drawn[0].axes, *drawn[1].axes]:
        found = lines(axes)
        np.testing.assert_allclose(found["with (tuned, net)"], found["nominal"], atol=1e-9)
    reference = lines(drawn[1].axes[0])["reference"]
    np.testing.assert_allclose(reference[0], one.reference.position[0, :2], atol=1e-9)


def test_the_errors_are_along_and_across_the_heading_in_centimetres_and_degrees(tmp_path, drawn):
    walk = pretend_walk(error=0.0, seconds=1.0, turn=1.0)
    yaw = walk.reference.euler[:, 2]
    left = 0.02 * np.stack([-np.sin(yaw), np.cos(yaw), 0 * yaw], axis=1)
    state = State(walk.state.euler + [0.0, 0.1, 0.0], walk.state.position + left, *walk.state[2:])
    plots.save_tracking(tmp_path / "a.png", {"with": walk._replace(state=state)})
    found = {axes.get_ylabel(): axes.lines[0].get_ydata() for axes in drawn[0].axes}
    assert [label.split(" [")[1] for label in found] == ["cm]"] * 3 + ["deg]"] * 3
    expected = [0.0, 2.0, 0.0, 0.0, np.rad2deg(0.1), 0.0]
    for values, level in zip(found.values(), expected, strict=True):
        np.testing.assert_allclose(values, level, atol=1e-9)


def test_lines_end_at_a_fall(tmp_path, drawn, walks):
    fallen = walks | {"without": pretend_walk(2, seconds=1.0, fall_at=0.6)}
    plots.save_tracking(tmp_path / "tracking.png", fallen)
    plots.save_path(tmp_path / "path.png", fallen)
    for axes in [*drawn[0].axes, *drawn[1].axes]:
        up = np.isfinite(lines(axes)["without (tuned, no net)"][:, 1])
        assert up.tolist() == [True] * 60 + [False] * 40


def test_sets_are_not_drawn_alike_and_stay_apart_in_grey():
    every = looks_of([*SETS, *(f"mine {i}" for i in range(5))])
    assert len({look.color for look in every.values()}) == len(every)
    names = ("with", "expert", "without", "nominal")  # from dark to light
    greys = [np.dot(to_rgb(every[name].color), (0.299, 0.587, 0.114)) for name in names]
    assert np.diff(greys).min() > 0.12


def test_the_loss_by_iteration_shows_refused_steps_that_are_no_numbers(tmp_path, drawn):
    histories = {"without": pretend_history(12), "with": pretend_history(8, refused=(3, 5))}
    plots.save_losses(tmp_path / "loss.png", PAPER_LOSS, histories)
    whole = drawn[0].axes[0]
    kept = [0, 1, 2, 4, 6, 7, 8]
    expected = [histories["with"][i].evaluation.loss / 1e6 for i in kept]
    np.testing.assert_allclose(lines(whole)["with (tuned, net)"], np.c_[kept, expected])
    crosses = [line.get_xdata().tolist() for line in whole.lines if line.get_marker() == "x"]
    assert [3, 5] in crosses
    (legend,) = drawn[0].legends
    assert "refused step" in [text.get_text() for text in legend.get_texts()]


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_same_picture_gives_the_same_bytes(tmp_path, walks, ending):
    one, other = (tmp_path / f"{name}.{ending}" for name in ("one", "other"))
    for path in (one, other):
        plots.save_path(path, walks)
    assert one.read_bytes() == other.read_bytes()


def test_pictures_of_the_pages_are_there_and_small_and_diagram_and_race_are_drawn_again(tmp_path):
    for name, (path, _) in PICTURES.items():
        assert 10_000 < path.stat().st_size < (1_000_000 if name == "film" else 400_000)
    with Image.open(PICTURES["film"][0]) as film:
        assert (film.n_frames, film.width >= 720) == (49, True)  # four seconds
    draw_method(tmp_path / "method.svg")
    draw_race(tmp_path / "race.png")
    assert "<svg" in (tmp_path / "method.svg").read_text()
    assert (tmp_path / "race.png").stat().st_size > 10_000
