"""A console, here or in a process; walks and scores of no simulator, for what is only drawn."""

import os
import pickle
import subprocess
import sys
from concurrent.futures import Executor, Future
from unittest import mock

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from hector_jax.cli.main import main
from hector_jax.control.weights import nominal
from hector_jax.core.trajectory import State, Wrench, no_samples
from hector_jax.core.tree import stack
from hector_jax.tuning.difftune import Iteration, Tuning
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.loss import PAPER_LOSS, total
from hector_jax.tuning.status import StepStatus, Stop
from hector_jax.verdict.metrics import Score, make_verdict

SETS = ("nominal", "expert", "without", "with")


def instead(patch, module, name, fake):
    """Put a fake in the place of a function, which must be called as that one can be."""
    present = getattr(module, name)
    made = mock.create_autospec(getattr(present, "real", present), side_effect=fake)
    made.real = getattr(present, "real", present)  # which has the signature, should it come again
    patch.setattr(module, name, made)


# the environment without the flags of the tests
USUAL = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}


def python(*words, **options):
    """A process of this Python that has ended."""
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, **options)


def files(folder):
    """All files of a folder but its lock, and what is in them."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def call(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["hector", *map(str, words)])
    return main()


def refused(monkeypatch, capsys, *words):
    """Run a line that must be refused; the one line that is said of it."""
    assert call(monkeypatch, *words) == 2
    out, err = capsys.readouterr()
    (line,) = [line for line in err.splitlines() if line.startswith("hector:")]
    assert "Traceback" not in out + err
    assert out == ""
    return line


class HandsOver(Executor):
    """Does each job at once in this process, on what pickling leaves of it."""

    def submit(self, job, *inputs):
        """Return the result, which was pickled too."""
        job, inputs = pickle.loads(pickle.dumps((job, inputs)))
        done = Future()
        done.set_result(pickle.loads(pickle.dumps(job(*inputs))))
        return done


def still_walk(count, **parts):
    """Samples of two legs that are all zero but for these parts; the controller knows all."""
    walk = jax.tree.map(lambda x: np.zeros((count, *np.shape(x)[1:])), no_samples(10, 2))
    flags = {name: np.zeros(count, bool) for name in ("fallen", "legs_touch")}
    return walk._replace(**flags | parts)


def pretend_walk(seed=0, error=0.03, seconds=4.0, period=0.01, fall_at=None, turn=0.0):
    """A walk at 0.5 m/s that sways about its reference by `error` [m]; numpy arrays."""
    rng = np.random.default_rng(seed)
    count = round(seconds / period)
    t = period * np.arange(1, count + 1)
    yaw = turn * t
    step = 2 * np.pi * t / 0.4
    along = period * np.cumsum(0.5 * np.stack([np.cos(yaw), np.sin(yaw), 0 * t], axis=1), axis=0)
    zero = np.zeros((count, 3))
    euler, velocity = np.stack([0 * t, 0 * t, yaw], axis=1), np.gradient(along, t, axis=0)
    reference = State(euler, along + [0, 0, 0.5], zero, velocity)
    slow = rng.normal(size=(2, 3)) * error
    sway = np.stack([np.sin(2 * step), np.sin(step), np.cos(2 * step)], axis=1)
    euler = reference.euler + 1.5 * error * sway + slow[0] * t[:, None] / seconds
    position = reference.position + 0.3 * error * sway + slow[1] * t[:, None] / seconds
    state = reference._replace(euler=euler, position=position)
    left = np.mod(t - period / 2, 0.4) < 0.2
    contact = np.stack([left, ~left], axis=1)
    carried = contact[..., None] * np.array([0.0, 0.0, 118.0])
    shape = np.stack([np.sin(step), np.cos(step), np.sin(2 * step)], axis=1)[:, None]
    shape = contact[..., None] * shape
    command = Wrench(carried + shape * [15, 20, 10], shape * [0, 2.0, 1.0])
    force = 0.9 * command.force + rng.normal(size=(count, 2, 3)) * [2, 2, 5]
    effect = Wrench(force, 0.7 * command.moment + 0.1 * rng.normal(size=(count, 2, 3)))
    fallen = np.zeros(count, bool)
    if fall_at is not None:
        fallen = t > fall_at
        state = State(*(np.where(fallen[:, None], np.nan, x) for x in state))
    feet = state.position[:, None] + np.array([[0, 0.07, -0.5], [0, -0.07, -0.5]])
    swing = 0.3 * np.sin(step)
    left_leg = np.stack([0 * t, 0 * t, 0.6 + swing, -1.2 - 0.3 * abs(swing), 0.6 - swing], axis=1)
    right_leg = np.stack([0 * t, 0 * t, 0.6 - swing, -1.2 - 0.3 * abs(swing), 0.6 + swing], axis=1)
    parts = {"reference": reference, "command": command, "effect": effect, "contact": contact}
    parts |= {"feet": feet, "joints": np.concatenate([left_leg, right_leg], axis=1)}
    parts["initial"] = State(*np.zeros((4, 3)))._replace(position=np.array([0, 0, 0.5]))
    return still_walk(count, period=np.array(period), state=state, fallen=fallen, **parts)


def elsewhere(walk, place, yaw):
    """The same walk, begun at another place (x, y) and heading."""
    R, place = Rotation.from_euler("z", yaw).as_matrix(), np.array([*place, 0.0])

    def moved(state):
        rates = state.ang_velocity @ R.T, state.velocity @ R.T
        return State(state.euler + [0.0, 0.0, yaw], state.position @ R.T + place, *rates)

    parts = {name: moved(getattr(walk, name)) for name in ("initial", "state", "reference")}
    for name in ("command", "effect"):
        parts[name] = Wrench(*(part @ R.T for part in getattr(walk, name)))
    return walk._replace(feet=walk.feet @ R.T + place, **parts)


def pretend_score(loss, fallen=False):
    """A score whose total is `loss`."""
    losses = {"L_Eul": 4e-6 * loss, "L_pos": 2e-6 * loss, "L_ctrl": 0.2 * loss, "L": loss}
    return Score(
        losses={name: np.array(x) for name, x in losses.items()},
        switching=np.array(0.15 * loss),
        rms_euler=np.array([0.02, 0.03, 0.01]),
        rms_position=np.array([0.02, 0.01, 0.005]),
        fallen=np.array(fallen),
        legs_touch=np.array(0.0),
        residual=np.array(1e-14),
    )


def pretend_verdict(seeds=8, fallen=(), scenes=("straight",)):
    """A verdict over all sets; `fallen` names pairs (set, seed index) that fell in every scene."""
    plant = np.exp(0.3 * np.random.default_rng(0).normal(size=seeds))
    level = dict(zip(SETS, (3.2e6, 2.9e6, 2.6e6, 1.2e6), strict=True))
    scores = {}
    for number, scene in enumerate(scenes, 1):
        noise = np.random.default_rng(number).normal(size=(len(SETS), seeds))
        scores[scene] = {}
        for name, row in zip(SETS, noise, strict=True):
            losses = level[name] * plant * np.exp(0.05 * row)
            each = [pretend_score(loss, (name, i) in fallen) for i, loss in enumerate(losses)]
            scores[scene][name] = each
    return make_verdict(PAPER_LOSS, range(seeds), scores)


def pretend_history(iterations=10, pace=5.0, refused=(), **others):
    """A tuning whose loss falls; refused iterations are not finite. `others` are tuned too."""
    history, weights = [], nominal()._replace(others=others)
    for i in range(iterations + 1):
        terms = {"L_Eul": 8 * np.exp(-i / pace) + 2, "L_pos": 6 * np.exp(-i / 9) + 1}
        terms = jax.tree.map(np.array, terms | {"L_ctrl": 5.5e5 + 2e4 * np.sqrt(i)})
        loss = np.array(np.nan if i in refused else float(total(PAPER_LOSS, terms)))
        found = Evaluation(loss, terms, weights, np.array(0.0), np.array(1e-12))
        status = StepStatus.NOT_FINITE if i in refused else StepStatus.ACCEPTED
        row = i, weights, found, int(status), 1.0 if i else 0.0
        history.append(Iteration(*jax.tree.map(np.asarray, row)))
    return history


def tuning_of(history, weights=None, stop=Stop.LIMIT):
    """A tuning of these iterations; in its matrix Q_pitch against Q_x matters most."""
    last = [i for i in history if i.accepted][-1]
    direction = np.zeros(18 + len(last.weights.others))
    direction[[1, 3]] = 0.9, -0.4
    weights = last.weights if weights is None else weights
    precision = np.outer(direction, direction) + 0.01 * np.eye(len(direction))
    return Tuning(weights, last.evaluation.loss, precision, np.array(stop), stack(history))


def walking_program(off, height):
    """Text of a walker, `off` to the left [m]; what writes its log comes after."""
    return _WALKER.replace("OFF", off).replace("HEIGHT", str(height))


_WALKER = """import json, sys
import numpy as np
request = json.load(open(sys.argv[1]))
count = round(request["seconds"] / 0.005)
t = 0.005 * np.arange(1, count + 1)[:, None]
velocity = np.array([*request["command"]["velocity"][0], 0.0])
off = OFF
start = np.array([0.0, 0.0, HEIGHT])
log = {
    "period": 0.005,
    "joints": 1e-6 * np.sin(t) * np.ones(10),
    "initial.position": start,
    "state.position": start + t * velocity + [0.0, off, 0.0],
    "command.force": np.full((count, 2, 3), 10.0),
    "command.moment": np.zeros((count, 2, 3)),
}
for name in ("euler", "ang_velocity", "velocity"):
    log["initial." + name], log["state." + name] = np.zeros(3), np.zeros((count, 3))
"""
