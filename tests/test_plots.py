"""Pictures: what is drawn is what was measured, with names and units, whatever a run can bring."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from pretend import elsewhere, pretend_history, pretend_walk

from hector_jax.control.weights import weight_names
from hector_jax.core.trajectory import State
from hector_jax.grfm.nets import History
from hector_jax.report import plots
from hector_jax.report.fidelity import Drift
from hector_jax.report.motion import motions
from hector_jax.report.plots import save_distances, style
from hector_jax.report.plots.style import SETS, label_of, looks_of
from hector_jax.robot.model import load_robot
from hector_jax.tuning.loss import PAPER_LOSS

FOUR = ("nominal", "expert", "without", "with")


@pytest.fixture(scope="module")
def walks():
    return {
        name: pretend_walk(i, 0.02 + 0.01 * i, seconds=1.0, turn=0.5) for i, name in enumerate(FOUR)
    }


def lines(axes):
    """Data of an axes' lines by their label."""
    return {line.get_label(): np.asarray(line.get_xydata()) for line in axes.lines}


def legend_of(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


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


def test_below_a_film_stand_the_distances_and_where_the_axes_are(tmp_path, drawn, walks):
    pair = motions(load_robot(), {name: walks[name] for name in ("nominal", "with")})
    box = save_distances(tmp_path / "a.png", pair, 800, 132)
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (800, 132)
        inside = np.asarray(picture.convert("RGB"))[box[1] : box[3], box[0] : box[2]]
    for colour in style.rgb_of(pair):
        assert (np.abs(inside.astype(int) - colour).sum(axis=-1) < 30).any()
    away = (walks["with"].state.position - walks["with"].reference.position)[:, :2]
    found = lines(drawn[0].axes[0])
    rms = 100 * np.sqrt(np.mean(np.sum(away**2, axis=1)))
    np.testing.assert_allclose(
        found[f"with (tuned, net): {rms:.1f} cm RMS"][:, 1], 100 * np.linalg.norm(away, axis=1)
    )


def test_the_four_sets_of_most_pictures_stay_apart_in_grey():
    looks = looks_of(FOUR)
    names = ("with", "expert", "without", "nominal")  # from dark to light
    greys = [np.dot(to_rgb(looks[name].color), (0.299, 0.587, 0.114)) for name in names]
    assert np.diff(greys).min() > 0.12
    assert len({look.marker for look in looks.values()}) == len(FOUR)


def test_a_legend_begins_with_the_names_of_the_tables():
    for name in (*FOUR, "shared_mean", "search_2000", "mine"):
        assert label_of(name).split(" (")[0] == name


def test_the_path_of_a_straight_walk_is_a_flat_picture(tmp_path):
    plots.save_path(tmp_path / "path.png", {"with": pretend_walk(seconds=4.0)})
    with Image.open(tmp_path / "path.png") as picture:
        assert picture.height < picture.width / 2


@pytest.mark.parametrize("pairs", [1, 2])
def test_a_straight_path_has_room_for_its_legend_and_labels(tmp_path, drawn, pairs):
    """Also with the many names of four feet."""
    walk = pretend_walk(seconds=4.0)
    more = {name: np.repeat(getattr(walk, name), pairs, axis=1) for name in ("contact", "feet")}
    names = ("nominal", "expert", "with", "best")
    plots.save_path(tmp_path / "path.png", dict.fromkeys(names, walk._replace(**more)))
    (figure,) = drawn
    (axes,) = figure.axes
    for text in (axes.xaxis.label, axes.yaxis.label, *figure.legends):
        box = text.get_window_extent()
        assert box.y0 >= 0.0
        assert box.y1 <= figure.bbox.y1


def test_the_loss_by_iteration_shows_refused_steps_that_are_no_numbers(tmp_path, drawn):
    histories = {"without": pretend_history(12), "with": pretend_history(8, refused=(3, 5))}
    plots.save_losses(tmp_path / "loss.png", PAPER_LOSS, histories)
    whole = drawn[0].axes[0]
    kept = [0, 1, 2, 4, 6, 7, 8]
    expected = [histories["with"][i].evaluation.loss / 1e6 for i in kept]
    np.testing.assert_allclose(lines(whole)["with (tuned, net)"], np.c_[kept, expected])
    crosses = [line.get_xdata().tolist() for line in whole.lines if line.get_marker() == "x"]
    assert [3, 5] in crosses
    assert "refused step" in legend_of(drawn[0])


def test_bars_are_the_weights_over_the_nominal_ones(tmp_path, drawn):
    nominal = np.geomspace(1e-4, 100, len(weight_names()))
    sets = {"nominal": nominal, "without": 2 * nominal, "with": nominal / 4}
    plots.save_weight_bars(tmp_path / "few.png", weight_names(), sets)
    plots.save_weight_bars(tmp_path / "all.png", weight_names(), sets | {"expert": 3 * nominal})
    tops = [bar.get_y() + bar.get_height() for bar in drawn[0].axes[0].patches]
    np.testing.assert_allclose(tops, [2.0] * 24 + [0.25] * 24)
    np.testing.assert_allclose(lines(drawn[1].axes[0])["expert"][:, 1], 3.0)


def test_wrenches_are_those_of_the_left_foot(tmp_path, drawn, walks):
    walk = walks["with"]
    curves = {"commanded": walk.command, "measured": walk.effect}
    assert "left foot" in plots.save_wrenches(tmp_path / "a.png", 0.01, curves)
    up = drawn[0].axes[2]
    assert up.get_ylabel() == "$F_z$ [N]"
    found = {step.get_label(): step.get_data().values for step in up.patches}
    np.testing.assert_array_equal(found["measured"], walk.effect.force[:40, 0, 2])
    assert legend_of(drawn[0]) == ["measured", "commanded"]


def test_the_epoch_of_the_least_error_on_the_validation_walks_is_marked(tmp_path, drawn):
    falling = np.geomspace(300.0, 60.0, 50)
    held = np.r_[falling[:30] + 5, falling[29] + np.arange(5.0, 25.0)]
    plots.save_training(tmp_path / "net.png", History(falling, falling / 300, held, falling / 250))
    force, moment = drawn[0].axes
    assert lines(force)["least"].tolist() == [[30.0, held[29]]]
    assert "N$^2$" in force.get_ylabel()
    assert "(N m)$^2$" in moment.get_ylabel()
    plots.save_training(tmp_path / "net.png", History(falling, 0 * falling, held, 0 * falling))
    assert len(drawn[1].axes) == 1  # point feet have no moments


def test_open_loop_errors_have_a_row_for_each_world(tmp_path, drawn):
    time = np.linspace(0.01, 0.4, 40)
    names = ("raw", "linear", "paper", "residual", "gated", "measured", "mine")
    found = {n: Drift(time, 0.1 * time**2 / i, time / i) for i, n in enumerate(names, 1)}
    plots.save_open_loop(tmp_path / "a.png", {"hfs": found, "hardware stand-in": found})
    rows = [axes.get_title() for axes in drawn[0].axes]
    assert rows == ["hfs"] * 2 + ["hardware stand-in"] * 2
    np.testing.assert_allclose(lines(drawn[0].axes[0])["measured"][:, 1], 10 * time**2 / 6)
    assert len(set(legend_of(drawn[0]))) == len(names)


@pytest.mark.parametrize("span", [1.3, 3.0, 20.0, 500.0])
def test_a_logarithmic_axis_has_a_few_numbers_whatever_it_spans(span):
    axes = Figure(figsize=(4, 3)).subplots()
    axes.plot([0, 1], [0.8, 0.8 * span])
    plots.style.log_axis(axes, "y")
    low, high = axes.get_ylim()
    ticks = [y for y in axes.get_yticks() if low <= y <= high]
    assert 3 <= len(ticks) <= 10
    assert "e" not in "".join(label.get_text() for label in axes.get_yticklabels())


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_same_picture_gives_the_same_bytes(tmp_path, walks, ending):
    pictures = []
    for i in range(2):
        path = tmp_path / f"{i}.{ending}"
        plots.save_path(path, walks)
        pictures.append(path.read_bytes())
    assert pictures[0] == pictures[1]


def test_no_two_sets_are_drawn_alike():
    every = looks_of([*SETS, *(f"mine {i}" for i in range(5))])
    colors = [look.color for look in every.values()]
    assert len(set(colors)) == len(colors)
