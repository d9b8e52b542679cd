"""A net is reused only for its own walks and controller; a tuning has its scale, and its depth."""

import traceback
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import jax
import numpy as np
import pytest
from model import ROBOT
from pretend import HandsOver, call
from synthetic import synthetic_walk

from hector_jax import InputError, TuneConfig, named_command
from hector_jax.cli import tune
from hector_jax.control import mpc, nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.grfm import dataset
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.grfm.training import TrainConfig
from hector_jax.store import nets, tunings
from hector_jax.store.collection import collect
from hector_jax.store.nets import CollectConfig
from hector_jax.store.setup import Setup
from hector_jax.tuning.evaluate import Evaluation

ONCE = TrainConfig("linear")  # the command's variant here: its fit takes no time


def gather(folder, draw=0, **others):
    """Toy walks with the card of those that a command would collect, but for `others`."""
    walk = lambda jobs: (synthetic_walk(10 * draw + job.seed, 12) for job in jobs)  # noqa: E731
    settings = nets.collection_settings(CollectConfig(), ROBOT) | others
    collect(folder, draw_jobs(draw, 5), walk, robot=ROBOT, settings=settings)


def ground(folder):
    return nets.load_or_train(ThreadPoolExecutor(1), ROBOT, folder, "linear")


def test_no_walk_is_in_two_parts(tmp_path):
    gather(tmp_path)
    parts = nets.samples(ROBOT, tmp_path)
    walks = [set(np.unique(part.walk)) for part in parts[:3]]
    assert all(walks)
    assert sum(map(len, walks)) == len(set.union(*walks)) == 5
    net = nets.train_net(ONCE, ROBOT, tmp_path, tmp_path / "net.npz")
    assert set(np.asarray(nets.held_out_walks(ROBOT, net).job.seed)) == walks[2]


def test_a_net_is_trained_once(tmp_path, monkeypatch):
    gather(tmp_path / "walks")
    first = ground(tmp_path)
    monkeypatch.setattr(dataset, "make_dataset", None)  # nor are the walks made samples again
    again = ground(tmp_path)
    jax.tree.map(np.testing.assert_array_equal, first[:2], again[:2])
    assert (again.errors, again.held_out_walks) == (first.errors, first.held_out_walks)


def test_walks_of_other_code_and_nets_of_other_settings_or_walks_are_refused(tmp_path):
    gather(tmp_path / "old" / "walks", code="older")
    message = "walks: made by other code or other versions of jax, jaxlib, mujoco"
    with pytest.raises(InputError, match=message):
        ground(tmp_path / "old")
    path = tmp_path / "grfm-linear.npz"
    gather(tmp_path / "walks")
    gather(tmp_path / "others", draw=1)
    for config, walks, fault in (
        (TrainConfig("linear", epochs=2), "walks", "epochs 2, this command expects"),
        (ONCE, "others", "content"),
    ):
        nets.train_net(config, ROBOT, tmp_path / walks, path)
        written = path.read_bytes()
        with pytest.raises(InputError, match=f"grfm-linear.npz: made with {fault}"):
            ground(tmp_path)
        assert path.read_bytes() == written


@pytest.mark.parametrize(
    ("sizes", "draws", "stand", "counted"),
    [
        ((1.0, 1e3), 0, 0, [1.0, 1e3]),
        ((1.0,), 3, 2, [1.0, 2.0]),
        ((1.0,), 3, 0, [1.0, 2.0, 3.0]),  # all fall: the tuning refuses the start
    ],
)
def test_losses_count_alike_and_falls_do_not(monkeypatch, capsys, sizes, draws, stand, counted):
    """The loss is the duration of the command, times more for a model of a higher seed."""

    def slope(config, scenario, weights):
        seed = 0 if scenario.variation is None else int(scenario.variation.seed)
        loss = scenario.command.duration[0] * (1.0 + seed)
        fallen = np.array(float(draws > 0 and seed >= stand))
        return Evaluation(loss, {}, nominal(), fallen, np.array(0.0)), np.eye(18)

    monkeypatch.setattr(tunings.difftune, "model_slope", slope)
    commands = [named_command("s")._replace(duration=np.array([size])) for size in sizes]
    problem = tunings.Problem(tuple(commands), None, draws)
    setup = Setup(ThreadPoolExecutor(2), TuneConfig(), ROBOT)
    objective = tunings._objective(setup, nominal(), problem)
    found, matrix = objective.slope(nominal())
    said = " ".join(capsys.readouterr().err.split())
    if draws and not stand:
        with pytest.raises(InputError, match="weights cannot be tuned from: the robot fell"):
            tunings._tune_on_cpu(setup, nominal(), problem, print)
    else:
        assert float(found.fallen) == 0.0
    relative = np.mean(1.0 / np.array(counted)) * np.eye(18)
    np.testing.assert_allclose(matrix / float(found.loss), relative)
    told = "1 of 3 drawn models left out of the tuning: the weights at the start fall"
    assert (told in said) == (stand == 2)


def test_from_the_command_to_the_qp_the_stack_has_14_frames(monkeypatch, tmp_path):
    """Where the programs of a tuning are compiled, in one process; the table is in CONTRIBUTING."""
    frames, package = [], str(Path(tunings.__file__).parents[1])

    def solve_qp(*_):
        frames.extend(f for f in traceback.extract_stack() if f.filename.startswith(package))
        raise InputError("the QP")

    monkeypatch.setattr(mpc, "solve_qp", solve_qp)
    monkeypatch.setattr(tunings, "not_the_weights", slice)  # any function of three
    monkeypatch.setattr(tune, "workers", lambda *_: nullcontext(HandsOver()))
    trajectory, start = tmp_path / "brief.toml", tmp_path / "start.json"
    trajectory.write_text('name = "brief"\n[[segment]]\nseconds = 0.15\nv_x = 0.2\n')
    save_weights(start, nominal())
    flags = ("--traj", trajectory, "--start", start, "--out", tmp_path / "run")
    assert call(monkeypatch, "tune", *flags) == 2
    assert len(frames) + 1 == 14  # with that of `solve_qp`
