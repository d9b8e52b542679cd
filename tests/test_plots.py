"""Pictures: each is written, says what it shows, and survives what a run can bring."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image
from pretend import pretend_history, pretend_verdict, pretend_walk

from hector_jax.control.weights import WEIGHT_NAMES
from hector_jax.evaluation import plots
from hector_jax.evaluation.fidelity import Drift
from hector_jax.evaluation.plots.style import looks_of
from hector_jax.grfm.training import History
from hector_jax.tuning.loss import LossConfig


@pytest.fixture(scope="module")
def walks():
    return {
        name: pretend_walk(i, 0.02 + 0.01 * i, seconds=1.0, turn=0.5)
        for i, name in enumerate(("nominal", "expert", "without", "with"))
    }


def _has_ink(path):
    with Image.open(path) as picture:
        grey = np.asarray(picture.convert("L"))
    return picture.width > 700 and 0.01 < np.mean(grey < 200) < 0.5


def test_the_loss_by_iteration_shows_refused_steps_that_are_no_numbers(tmp_path):
    path = tmp_path / "loss.png"
    histories = {"without": pretend_history(12), "with": pretend_history(8, refused=(3, 5))}
    assert "refused" in plots.losses(path, LossConfig(), histories)
    assert _has_ink(path)


def test_tracking_and_path_are_drawn_up_to_a_fall(tmp_path, walks):
    fallen = walks | {"without": pretend_walk(2, seconds=1.0, fall_at=0.6)}
    assert plots.tracking(tmp_path / "tracking.png", fallen)
    assert plots.path_from_above(tmp_path / "path.png", fallen)
    assert _has_ink(tmp_path / "tracking.png")
    assert _has_ink(tmp_path / "path.png")


def test_the_four_sets_of_most_pictures_stay_apart_in_grey():
    names = ("with", "expert", "without", "nominal")
    looks = looks_of(names)
    greys = [np.dot(to_rgb(looks[name].color), (0.299, 0.587, 0.114)) for name in names]
    assert np.diff(greys).min() > 0.12
    assert len({look.marker for look in looks.values()}) == len(names)


def test_the_collective_figure_names_the_few_sets_that_its_panels_show(tmp_path, walks):
    more = {name: walks["expert"] for name in ("searched", "shared_mean", "ceiling")} | walks
    caption = plots.collective(tmp_path / "more.png", more, None)
    assert caption == plots.collective(tmp_path / "few.png", walks, None)
    assert "nominal, expert, tuned without net, tuned with net" in caption


def test_the_path_of_a_straight_walk_is_a_flat_picture(tmp_path):
    plots.path_from_above(tmp_path / "path.png", {"with": pretend_walk(seconds=4.0)})
    with Image.open(tmp_path / "path.png") as picture:
        assert picture.height < picture.width / 2


@pytest.mark.parametrize("turn", [0.0, 0.8])
def test_the_collective_figure_goes_with_and_without_snapshots(tmp_path, turn):
    """A straight path lies across, a bent one stands beside the panels."""
    names = ("nominal", "searched", "mine", "with")
    walks = {name: pretend_walk(i, seconds=2.0, turn=turn) for i, name in enumerate(names)}
    strip = tmp_path / "strip.png"
    Image.new("RGB", (600, 200), "grey").save(strip)
    heights = {}
    for name, snapshots in {"with.png": strip, "without.png": None}.items():
        caption = plots.collective(tmp_path / name, walks, snapshots)
        assert caption.startswith("Snapshots; ") is (snapshots is not None)
        assert _has_ink(tmp_path / name)
        with Image.open(tmp_path / name) as picture:
            heights[name] = picture.height
    assert heights["with.png"] > heights["without.png"]


def test_changes_are_drawn_for_sets_that_only_one_trajectory_has_and_with_falls(tmp_path):
    one, other = pretend_verdict(8), pretend_verdict(8, fallen={("with", 1)})
    other.scores["mine"] = other.scores["with"]
    paper = {("c", "with_ten", "nominal"): -68.7}
    path = tmp_path / "changes.png"
    assert "cross" in plots.changes(path, {"c": one, "s": other}, paper)
    assert _has_ink(path)


def test_weights_are_drawn_with_and_without_the_expert(tmp_path):
    nominal = np.geomspace(1e-4, 100, len(WEIGHT_NAMES))
    sets = {"nominal": nominal, "without": 2 * nominal, "with": nominal / 3}
    for name, some in {"few.png": sets, "all.png": sets | {"expert": 3 * nominal}}.items():
        assert "nominal" in plots.weights(tmp_path / name, WEIGHT_NAMES, some)
        assert _has_ink(tmp_path / name)


def test_wrenches_are_drawn_for_the_foot_that_is_asked_for(tmp_path, walks):
    walk = walks["with"]
    curves = {"commanded": walk.command, "measured": walk.effect, "predicted": walk.effect}
    left = plots.wrenches(tmp_path / "left.png", 0.01, curves)
    right = plots.wrenches(tmp_path / "right.png", 0.01, curves, foot=1)
    assert "left foot" in left
    assert "right foot" in right
    assert _has_ink(tmp_path / "left.png")
    assert (tmp_path / "left.png").read_bytes() != (tmp_path / "right.png").read_bytes()


def test_the_training_of_a_net_is_drawn(tmp_path):
    falling = np.geomspace(300.0, 60.0, 50)
    assert plots.training(
        tmp_path / "net.png", History(falling, falling / 300, falling + 5, falling / 250)
    )
    assert _has_ink(tmp_path / "net.png")


def test_open_loop_errors_are_drawn_for_each_world(tmp_path):
    time = np.linspace(0.01, 0.4, 40)
    names = ("raw", "linear", "paper", "residual", "gated", "measured")
    found = {n: Drift(time, 0.1 * time**2 / i, time / i) for i, n in enumerate(names, 1)}
    for worlds in ({"hfs": found}, {"hfs": found, "hardware stand-in": found}):
        path = tmp_path / f"{len(worlds)}.png"
        assert "RMS" in plots.open_loop(path, worlds)
        assert _has_ink(path)


def test_tuning_while_walking_is_drawn_with_walks_that_ended_early(tmp_path):
    times = 0.4 * np.arange(1, 21)
    curves = {
        (name, "nominal"): {arm: 1e5 * np.ones((2, 20)) for arm in ("fixed", "until", "carried")}
        for name in ("straight", "s")
    }
    assert "median" in plots.while_walking(tmp_path / "loss.png", 4.0, times, curves)
    ratios = np.exp(np.linspace(0.0, 1.0, 20)[:, None] * np.linspace(-1, 1, len(WEIGHT_NAMES)))
    courses = {"straight": ratios, "c": ratios[:7], "s": ratios}
    assert "6 weights" in plots.weight_courses(
        tmp_path / "weights.png", 4.0, times, WEIGHT_NAMES, courses
    )
    assert _has_ink(tmp_path / "loss.png")
    assert _has_ink(tmp_path / "weights.png")


def test_pictures_of_batches_are_drawn(tmp_path):
    rng = np.random.default_rng(0)
    names = ("expert", "straight alone", "c alone", "s alone", "mean of all", "worst of all")
    columns = ("straight", "c", "s", "unseen")
    plots.ratios(tmp_path / "a.png", columns, {n: rng.uniform(0.3, 1.4, 4) for n in names})
    losses = {n: 1e6 * rng.gamma(4.0, 0.5, 20) for n in names[:5]}
    losses["nominal"] = np.r_[losses.pop("expert")[:19], 4e7]  # a fall
    plots.by_plant(tmp_path / "b.png", losses)
    prices = np.geomspace(0.01, 100, 9)
    falling = 1e6 * np.stack([3 * prices**-0.4, 0.4 + 0.05 * prices**0.3], axis=1)
    worlds = {"rigid body": falling, "hfs": 1.3 * falling}
    worlds["rigid body"][0] = np.nan
    plots.front(tmp_path / "c.png", prices, worlds, {"nominal": (3e6, 5e5), "expert": (2e6, 6e5)})
    curves = 1e6 * (1 + np.exp(-np.arange(30) / 8) * rng.uniform(0.5, 20, (12, 1)))
    curves[2, 4] = curves[3, 20:] = np.nan
    assert "in order" in plots.starts(tmp_path / "d.png", curves)
    for name in "abcd":
        assert _has_ink(tmp_path / f"{name}.png")


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_same_picture_gives_the_same_bytes(tmp_path, walks, ending):
    pictures = []
    for i in range(2):
        path = tmp_path / f"{i}.{ending}"
        plots.path_from_above(path, walks)
        pictures.append(path.read_bytes())
    assert pictures[0] == pictures[1]
