"""A run on a page: what is drawn is what was walked, and a growing run is seen to grow."""

import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from browser import CHROMIUM, opened
from model import ROBOT, small_net
from pretend import call, elsewhere, instead, pretend_history, pretend_walk

from hector_jax.cli import arguments
from hector_jax.cli.flags import Tune
from hector_jax.cli.parse import as_table
from hector_jax.control.weights import expert, nominal, weights_to_vector
from hector_jax.control.weights_file import save_weights
from hector_jax.core import inputs
from hector_jax.core.files import write_json
from hector_jax.core.journal import write_rows
from hector_jax.core.tree_file import tree_hash
from hector_jax.grfm.network import save_net
from hector_jax.report import fidelity
from hector_jax.store import run as runs
from hector_jax.store.cache import robot_hash
from hector_jax.view import page as view
from hector_jax.view import pictures
from hector_jax.view.motion import motion
from hector_jax.view.page import ViewedWalk, arrows


def viewed(seed=0, **kwargs):
    walk = pretend_walk(seed, **kwargs)
    return ViewedWalk(walk, {"commanded": walk.command, "measured": walk.effect})


def pretend_run(folder):
    """The folder of a run, as far as a page reads it."""
    loss = {"euler": 1e5, "position": 2e5}
    flags, body = as_table(Tune(data=folder / "data")), robot_hash(ROBOT)
    write_json(folder / "config.json", {"flags": flags, "robot": body, "tune": {"loss": loss}})
    write_metrics(folder, 12)
    return folder


def write_metrics(folder, iterations, refused=()):
    rows = [
        runs.as_row(name, iteration)
        for name, pace in (("without", 5.0), ("with", 3.0))
        for iteration in pretend_history(iterations, pace, refused)
    ]
    write_rows(folder / "metrics.jsonl", rows)


@pytest.mark.parametrize("size", [1.0, 2.0])
def test_an_arrow_has_the_direction_of_its_force_and_the_scale_of_its_robot(size):
    """The weight is drawn five sixths of the standing height long, whatever the robot's size."""
    robot = ROBOT._replace(mass=size**3 * ROBOT.mass, standing_height=size * ROBOT.standing_height)
    weight, height = float(robot.mass * robot.gravity[2]), float(robot.standing_height)
    one = viewed(seconds=2.0, turn=np.pi / 4)
    ahead = np.zeros((200, 2, 3))
    ahead[..., 0] = weight  # in the yaw frame
    one.ground["predicted"] = one.walk.effect._replace(force=ahead)
    moved = motion(robot, *one)

    def drawn(what, source):
        ends = arrows(moved, what, source)
        return ends[:, :, 1] - ends[:, :, 0]

    effect, yaw = one.walk.effect, one.walk.state.euler[-2, 2]
    there = 5 / 6 * height * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    np.testing.assert_allclose(drawn("force", "predicted")[-1, 0], there, atol=1e-9)
    up = effect.force[..., 2] / weight * 5 / 6 * height
    np.testing.assert_allclose(drawn("force", "measured")[..., 2], up)
    up = effect.moment[..., 2] / weight * 5 / 6 / 0.24  # the weight at 0.24 heights
    np.testing.assert_allclose(drawn("moment", "measured")[..., 2], up)


def test_both_walks_stand_on_one_reference_wherever_they_began():
    one = viewed(seconds=0.5, turn=1.0)
    found = motion(ROBOT, *one)
    other = motion(ROBOT, *one._replace(walk=elsewhere(one.walk, (0.3, -0.2), 0.4)))
    for name in ("reference", "path", "qpos", "soles"):
        np.testing.assert_allclose(getattr(other, name), getattr(found, name), atol=1e-9)
    ends = arrows(other, "force", "commanded")  # wrenches are of the yaw frame in any case
    np.testing.assert_allclose(ends, arrows(found, "force", "commanded"), atol=1e-9)


def test_metrics_of_a_run_that_goes_on_are_read_and_its_newest_weights_taken(tmp_path):
    run = pretend_run(tmp_path)
    write_metrics(run, 6, refused=(3,))
    found = runs.Run(run).histories
    again = [runs.as_row(name, i) for name, history in found.items() for i in history]
    write_rows(tmp_path / "again", again)
    assert (tmp_path / "again").read_bytes() == (run / "metrics.jsonl").read_bytes()
    assert [i.accepted for i in found["with"]] == [k != 3 for k in range(7)]
    curve = runs.loss_curves(found)["with"]
    assert np.isnan(curve[3])
    assert curve[6] < curve[0] == 100.0
    for expected, words in ((nominal(), "with at iteration 6, so far"), (expert(), "with")):
        weights, told = runs.Run(run).weights("with")
        np.testing.assert_array_equal(weights_to_vector(weights), weights_to_vector(expected))
        assert told == words
        save_weights(run / "weights" / "with.json", expert())


def test_a_folder_gets_film_and_pictures_instead(monkeypatch, capsys, tmp_path):
    filmed = []
    instead(monkeypatch, pictures, "write_film", lambda *film, strip: filmed.append((*film, strip)))
    instead(monkeypatch, arguments, "walk_once", lambda *_: pretend_walk(seconds=0.3))
    monkeypatch.setattr(inputs, "find_spec", lambda name: None)  # needs no viser
    run, out = pretend_run(tmp_path / "run"), tmp_path / "out"
    flags = ["--world", "srbm", "--sets", "nominal", "expert"]
    assert call(monkeypatch, "view", run, "--out", out, *flags) == 0
    assert "no net at" in capsys.readouterr().err
    [(film, _, shown, strip)] = filmed
    assert (film.name, strip.name) == ("film.mp4", "film.png")
    assert list(shown) == ["before: nominal", "after: expert"]
    drawn = {"losses.png", "path.png", "tracking.png", "wrenches.png"}
    assert {file.name for file in out.iterdir()} == drawn


@pytest.fixture(params=["127.0.0.1", "::1"])
def page(request):
    """A server of the page, and where it listens."""
    pytest.importorskip("viser", reason="viser, of the extra view, is not installed")
    try:
        port = view._free_port(request.param, 0)
    except inputs.InputError:
        pytest.skip(f"this machine has no {request.param}")
    server = view._server(request.param, port)
    yield server, view._in_url(request.param), port
    server.stop()


def test_the_page_answers_its_own_origins_only_and_no_client_opens_a_tunnel(page, monkeypatch):
    import viser._viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    def opens(origin, port=page[2]):
        protocol = f"viser-v{viser.__version__}"
        try:
            with connect(f"ws://{page[1]}:{port}", origin=origin, subprotocols=[protocol]) as one:
                return bool(one.recv())
        except InvalidStatus as refusal:
            return refusal.response.status_code != 403

    own = [f"http://{name}:{page[2]}" for name in ("localhost", "127.0.0.1", "[::1]")]
    assert all(map(opens, [None, *own]))
    foreign = "https://evil.example", f"http://evil.example:{page[2]}", "http://localhost:1", "null"
    assert not any(map(opens, foreign))
    opened = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *_: opened.append(1))
    assert page[0].request_share_url() is None  # what a client's message calls
    assert not opened


@pytest.mark.parametrize("own", [True, False])
def test_only_the_net_of_the_run_predicts(monkeypatch, capsys, tmp_path, own):
    drawn, net = [], small_net()
    instead(monkeypatch, arguments, "walk_once", lambda *_: pretend_walk(seconds=0.3))
    instead(monkeypatch, fidelity, "curves", lambda *args: drawn.append(args[2]) or {})
    instead(monkeypatch, pictures, "of_view", lambda *args: None)
    run = pretend_run(tmp_path / "run")
    save_net(run / "data" / "grfm.npz", net, robot=ROBOT, about={})
    path = run / "config.json"
    write_json(path, json.loads(path.read_text()) | {"net": tree_hash(net) if own else "another"})
    words = ["--world", "srbm", "--sets", "nominal", "expert", "--out", tmp_path / "out"]
    assert call(monkeypatch, "view", run, *words) == 0
    assert [list(effects) for effects in drawn] == [["residual"] if own else []] * 2
    assert ("grfm.npz is not the net of this run" in capsys.readouterr().err) != own


def until(seconds, seen):
    end = time.monotonic() + seconds
    while not seen():
        assert time.monotonic() < end, f"not seen within {seconds} s"
        time.sleep(1.0)


def shows_both(picture):
    """Whether both robots are in the scene: their colours, on what is not one plain plane."""
    scene = picture[:, :800].astype(int)
    red, green, blue = scene[..., 0], scene[..., 1], scene[..., 2]
    before = (blue > green + 40) & (green > red + 20)
    after = (green > red + 30) & (green > blue)
    return before.sum() > 50 and after.sum() > 50 and scene.std() > 15.0


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_a_browser_shows_the_run_until_it_is_interrupted(tmp_path):
    pytest.importorskip("viser", reason="viser, of the extra view, is not installed")
    run = pretend_run(tmp_path / "run")
    save_weights(run / "weights" / "with.json", expert())
    words = [sys.executable, "-m", "hector_jax.cli.main", "view", run]
    words += "--seconds 0.5 --port 0 --sets expert with".split()  # blue and green
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as page:
        try:
            told = next(line for line in page.stderr if line.startswith("open http"))
            with opened(told.split()[1], tmp_path / "profile") as tab:
                until(300, lambda: shows_both(tab.picture()))
                words = tab.text()
                for expected in ("before: expert", "after: with", "Pause", "loss on the model"):
                    assert expected in words
                write_metrics(run, 20)  # the run goes on
                until(60, lambda: "with: iteration 20" in tab.text())
        finally:
            page.send_signal(signal.SIGINT)
        out, err = page.communicate(timeout=60)
    assert page.returncode == 130
    *said, last = err.splitlines()  # from after the address on, as far as the pipe was not yet read
    assert (out, last) == ("", "hector: interrupted")
    assert all(line.startswith(("walking in hfs", "  before: ", "  after: ")) for line in said)
