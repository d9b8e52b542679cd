"""A live walk: the walk of `hector walk`, without compiling; its page; steps of the tuner."""

import re
import signal
import subprocess
import sys
import time
from functools import partial

import jax
import numpy as np
import pytest
from browser import CHROMIUM, opened
from model import EXAMPLES, ROBOT
from pretend import HandsOver, refused

from hector_jax import Job, walk
from hector_jax.control.controller import walk_config
from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert, nominal, weights_to_vector
from hector_jax.control.weights_file import load_weights, shipped, weights_tree
from hector_jax.sim.live import Session
from hector_jax.sim.world import hfs, hfs_even
from hector_jax.tuning.live import take_step, what_matters
from hector_jax.view.live_page import LivePage
from hector_jax.view.live_weights import PageSetup
from hector_jax.view.page import opened_server

PLANT = hfs(ROBOT.description)


def job(weights=None, plant=PLANT, seed=0):
    return Job(weights or nominal(ROBOT), named_command("straight"), plant, seed=seed)


@pytest.fixture(scope="module")
def session():
    """A session of `shipped` that has walked for four seconds."""
    found = Session(ROBOT, [job(shipped(ROBOT))])
    go(found, 4.0)
    return found


def count_compilations():
    """A function that tells how many programs this process has compiled or loaded since."""
    found = []

    def listen(event, duration_secs, **_):
        found.extend([event] * (event == "/jax/core/compile/backend_compile_duration"))

    jax.monitoring.register_event_duration_secs_listener(listen)
    return lambda: len(found)


def go(session, seconds):
    """Walk until this time after t = 0, or a fall; the last frame."""
    while session.frame()[0][0].time < seconds and not session.walks[0].fall:
        session.tick()
    return session.frame()[0][0]


@pytest.mark.parametrize("plant", [PLANT, hfs_even(3, ROBOT.description)], ids=["hfs", "noise"])
def test_an_untouched_live_walk_is_the_walk_to_the_bit(plant):
    asked = job(plant=plant, seed=3)
    found = Session(ROBOT, [asked])
    now = go(found, 4.0)
    wanted, lived = walk(walk_config(ROBOT), ROBOT, asked), found.walks[0].trajectory()
    jax.tree.map(partial(np.testing.assert_array_equal, strict=True), lived, wanted)
    away = wanted.state.position - wanted.reference.position
    np.testing.assert_allclose(now.errors[:3], 100.0 * np.sqrt(np.mean(away**2, axis=0)))


def test_nothing_compiles_while_a_person_turns_and_both_sets_walk_on_one_plant():
    found = Session(ROBOT, [job(), job(shipped(ROBOT))])
    found.warm_up()
    compilations = count_compilations()
    go(found, 0.3)
    found.set_weights(0, expert(ROBOT))
    found.set_velocity(0.3, 0.1, 0.2)
    found.set_numbers(PLANT._replace(mass=np.asarray(1.05), delay=np.asarray(0.003)), 1.0)
    found.push(np.array([0.0, 30.0, 0.0]))
    go(found, 0.8)
    found.reset()
    frames = [go(found, 0.2), *found.frame()[0]]
    assert compilations() == 0
    masses = {float(x._plant.world.model.body_mass.sum()) for x in found.walks}
    assert len(masses) == 1
    assert masses.pop() == pytest.approx(1.05 * float(ROBOT.mass) + 1.0, rel=0.02)
    assert not any(now.fall for now in frames)


def test_a_small_push_is_survived_and_a_large_one_ends_in_a_fall_with_its_cause(session):
    end = session.walks[0].now().time
    session.push(np.array([60.0, 0.0, 0.0]))
    assert go(session, end + 2.0).fall == ""
    session.push(np.array([300.0, 0.0, 0.0]))
    now = go(session, end + 6.0)
    assert re.match(r"fell after \d\.\d s: .+ \(try ", now.fall)
    assert session.log(0) == "it fell: reset"
    session.reset()
    assert go(session, 0.5).fall == ""


def test_weights_change_the_errors_and_those_of_the_start_stay_beside_them():
    found = Session(ROBOT, [job(shipped(ROBOT))])
    before = go(found, 2.0).errors
    found.set_weights(0, nominal(ROBOT))
    now = go(found, 6.5)
    np.testing.assert_array_equal(found.frame()[1][0], before)
    assert now.errors[4] > 3.0 * before[4]  # pitch


def test_a_new_command_starts_at_the_old_reference(session):
    session.reset()
    before = go(session, 1.0).reference
    session.set_velocity(0.0, 0.2, 0.0)
    after = session.walks[0].now().reference
    np.testing.assert_allclose(after, before, atol=1e-9)
    moved = go(session, 2.0).reference - after
    np.testing.assert_allclose(moved, [0.0, 0.2, 0.0], atol=0.01)


@pytest.mark.slow
def test_one_step_of_the_tuner_moves_the_weights_of_the_walk_just_seen():
    found = Session(ROBOT, [job()])
    go(found, 2.0)
    assert found.log(0) == "2.0 s more with nothing moved"
    before = go(found, 5.0).errors
    walked = found.log(0)
    assert walked.start_tick == 100
    state, weights, text = take_step(ROBOT, None, walked)
    assert text.startswith("L of these 4 s: ")
    assert " One step: " in text
    step = np.log(weights_to_vector(weights) / weights_to_vector(nominal(ROBOT)))
    assert 0.1 < np.abs(step).max() <= 1.0 + 1e-6
    found.set_weights(0, weights)
    now = go(found, 9.5)
    assert np.linalg.norm(now.errors[:2]) < np.linalg.norm(before[:2])
    assert int(take_step(ROBOT, state, found.log(0))[0].iteration) == 2
    said = what_matters(ROBOT, None, walked)[2].splitlines()[2:]
    assert said
    assert all(re.match(r"- `[QR]_\w+`.*, doubled: \w+ [+-]\d+ %, ", line) for line in said)


def test_what_is_not_live_is_refused_in_a_line(monkeypatch, capsys, tmp_path):
    line = partial(refused, monkeypatch, capsys, "view")
    assert "--live takes no RUN" in line(tmp_path, "--live")
    assert "RUN expects a value, got none; or --live" in line()
    assert "--robot is of a live walk: --live" in line(
        tmp_path, "--robot", EXAMPLES / "quadruped/robot.toml"
    )
    assert "--seconds is of a run" in line("--live", "--seconds", 2)
    assert "--at mass must be a number from 0.7 to 1.3, got '9'" in line("--live", "--at", "mass=9")
    assert "unknown number 'mas'; did you mean 'mass'?" in line("--live", "--at", "mas=1")
    once = "--at takes NAME=VALUE, each name once, got mass"
    assert f"{once}=1.2" in line("--live", "--at", "mass=1.1", "mass=1.2")
    assert once in line("--live", "--at", "mass")
    assert "--at is of a live walk: --live" in line(tmp_path, "--at", "mass=1")
    assert "it tunes; got standin" in line("--live", "--world", "standin")
    own = EXAMPLES / "own_controller" / "numbers.toml"
    assert "whose program is not walked live" in line("--live", "--robot", own)
    assert "no flag '--walker'" in line("--live", "--walker", own)


class Wire:
    """A pipe to a session that answers at once."""

    def __init__(self, session):
        self.session, self.answers = session, []

    def send(self, call):
        """Do what a page calls."""
        name, values = call
        answer = getattr(self.session, name)(*values)
        self.answers += [answer] if answer is not None else []


def test_a_page_shows_what_the_walk_is_at_and_turns_undoes_and_saves_weights(monkeypatch, tmp_path):
    pytest.importorskip("viser", reason="viser, of the extra view, is not installed")
    monkeypatch.chdir(tmp_path)
    found, named = Session(ROBOT, [job()]), {"nominal": nominal(ROBOT), "expert": expert(ROBOT)}

    def line(weights, at, world="hfs", seed=0):
        line = f"hector view --live --weights {' '.join(weights)} --world {world} --seed {seed}"
        return f"{line} --at {' '.join(at)}"

    sets = {"nominal": nominal(ROBOT)}
    at = {"ahead": 0.3, "mass": 1.1}
    setup = PageSetup(ROBOT, sets, ["nominal"], named, "hfs", 0, at, line)
    go(found, 0.5)
    with opened_server("127.0.0.1", 0) as (server, _):
        page = LivePage(server, setup, Wire(found), HandsOver())
        assert found.walks[0].job.command.velocity.tolist() == [[0.3, 0.0]] * 2
        assert float(found.walks[0].job.imperfections.mass) == 1.1
        page.show(found.frame()._replace(factor=0.4))
        assert "0.40: **this machine is too slow** for speed 1" in page._status.content
        assert "**nominal**: 0.5 s; QP solved; " in page._status.content
        assert re.search(r"(left|right) \d+ N, \d+ % of friction", page._status.content)
        shown = [cone for cone in page._handles[0]["cones"] if cone.visible]
        assert shown
        for cone in shown:  # the rim, by the friction of the floor
            x, y, up = cone.points[4:].reshape(-1, 3).T
            np.testing.assert_allclose(np.abs(x) + np.abs(y), PLANT.floor_friction * up, rtol=1e-6)
        assert "| **nominal** now | " in page._table.content
        slider = page._weights._sliders["Q_pitch"][0]
        assert slider.label == "Q_pitch = 50 1/rad²"
        page._weights._turn("Q_pitch", 2.0)
        page._weights._turn("Q_pitch", 2.0)  # told twice, undone once
        assert slider.label == "Q_pitch = 100 1/rad²"
        assert found.walks[0].job.weights.Q.euler[1] == pytest.approx(100.0)
        page._weights._save()
        assert (
            "hector view --live --weights live.json --world hfs --seed 0 --at ahead=0.3 mass=1.1 "
            "aside=0.0 turn=0.0 floor_friction=0.8 delay=0.002 payload=0.0\n"
            in page._weights._line.content
        )
        saved = load_weights(tmp_path / "live.json", ROBOT)
        assert weights_tree(saved) == weights_tree(found.walks[0].job.weights)
        page._weights._undo()
        assert weights_tree(found.walks[0].job.weights) == weights_tree(nominal(ROBOT))
        page._weights._file.value = "../there.json"
        page._weights._save()
        assert not (tmp_path.parent / "there.json").exists()
        assert page._strip
        found.reset()
        page.show(found.frame())  # before t = 0
        assert not page._strip
        page._ask(take_step)
        page.tune(found.log(0))
        assert page._found.content.startswith("Not yet: ")
        errors = np.full(6, np.nan), np.ones(6)  # of a set that fell before its path, and another
        page._note([found.walks[0].now()._replace(time=9.0, error=e) for e in errors])
        np.testing.assert_allclose(page._strip[-1], [9.0, 0.0, np.sqrt(2), 0.0, np.sqrt(2)])


def until(seconds, seen):
    end = time.monotonic() + seconds
    while not (found := seen()):
        assert time.monotonic() < end, f"not seen within {seconds} s"
        time.sleep(1.0)
    return found


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_a_person_turns_pushes_and_saves_in_a_browser(tmp_path):
    pytest.importorskip("viser", reason="viser, of the extra view, is not installed")
    words = [sys.executable, "-m", "hector_jax.cli.main", "view", "--live", "--port", "0"]
    words += ["--weights", "shipped"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "cwd": tmp_path}
    with subprocess.Popen(words, **pipes) as page:
        try:
            address = next(line for line in page.stderr if line.startswith("open http")).split()[1]
            with (  # small, because they draw without a graphics card
                opened(address, tmp_path / "one", 300) as tab,
                opened(address, tmp_path / "two", 300) as other,
            ):

                def at(what, one=tab):
                    return re.search(what, one.text())

                def pitch():
                    row = at(r"shipped now\s+\S+, \S+, \S+\s+\S+, ([\d.]+), ")
                    return float(row[1]) if row else None

                def walked():
                    told = at(r"shipped: (-?[\d.]+) s; QP solved")
                    return float(told[1]) if told else -1.0

                until(300, lambda: walked() > 5.0)
                before = until(60, pitch)
                tab.fill("Q_pitch", "-2")
                until(60, lambda: at(r"Q_pitch = 0\.01"))
                until(60, lambda: at(r"Q_pitch = 0\.01", other))
                until(120, lambda: pitch() > 1.3 * before)
                tab.click("Undo")
                tab.click("from behind")
                now = walked()
                until(120, lambda: walked() > now + 3.0)
                tab.fill("push [N]", "300")
                tab.click("from behind")
                until(120, lambda: at("shipped: fell after"))
                until(30, lambda: at("shipped: fell after", other))
                tab.click("Reset: stand at the start again")
                until(60, lambda: walked() > -1.0)
                tab.click("Save these weights")
                until(30, lambda: at("hector view --live --weights live.json"))
                saved = load_weights(tmp_path / "live.json", ROBOT)
                np.testing.assert_array_equal(
                    weights_to_vector(saved), weights_to_vector(shipped(ROBOT))
                )
        finally:
            page.send_signal(signal.SIGINT)
        page.communicate(timeout=60)
    assert page.returncode == 130
