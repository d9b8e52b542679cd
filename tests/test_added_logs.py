"""Logs that are added: whose log is refused, what is shown, undone and kept, and how it ends.

The logs are drawn, not walked, and so is the slope: what is tried here is what the folder makes of
them.
"""

import json
import os
from contextlib import nullcontext, suppress
from dataclasses import replace
from itertools import product
from pathlib import Path

import jax
import numpy as np
import pytest
from pretend import HandsOver, files, instead
from test_walks import same, same_sets

from hector_jax.cli import propose, walk
from hector_jax.cli.flags import Add, Propose, Walk
from hector_jax.control.trajectories import load_command
from hector_jax.control.weights import expert, nominal, vector_to_weights, weights_to_vector
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import State, no_samples
from hector_jax.core.tree_file import named_leaves, save_tree
from hector_jax.own import walk_log
from hector_jax.robot.model import load_robot
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.loss import loss_of_robot
from hector_jax.verdict.metrics import Interval
from hector_jax.walk_tuning import added_logs, forecasts, walks

SECONDS = 0.1
SPEEDS = {"ahead": (0.5, 0.0), "aside": (0.0, 0.5), "back": (-0.5, 0.0)}
TOML = 'name = "{}"\n[[segment]]\nseconds = 0.1\nv_x = {}\nv_y = {}\n'
ROBOT = jax.tree.map(np.asarray, load_robot())
NOMINAL = np.asarray(weights_to_vector(nominal(ROBOT)))
DOWN = np.r_[0.5 * np.ones(12) / np.sqrt(12.0), np.zeros(12)]  # half an e-fold, of Q
LENGTH = {"slope": 100.0}  # [e-folds] from nominal, where the slope ends


def slope_of(campaign, weights, case, log, moved):
    """A slope that is the same up to some distance from the start, and then none."""
    vector = np.asarray(weights_to_vector(weights))
    goes_on = np.linalg.norm(np.log(vector / NOMINAL)) < LENGTH["slope"]
    slope = vector_to_weights(-DOWN / vector * goes_on)
    gradient = jax.tree.map(np.asarray, slope._replace(others={n: 0.0 for n in weights.others}))
    terms = {term.name: np.ones(()) for term in campaign.config.loss}
    return Evaluation(np.ones(()), terms, gradient, np.zeros(()), np.zeros(())), np.eye(18)


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """A folder for logs of three trajectories, in which nothing is computed for a proposal."""
    pool = HandsOver()
    monkeypatch.setattr(propose, "workers", lambda *_: nullcontext(pool))
    monkeypatch.setattr(walks, "slope_of_walk", slope_of)
    monkeypatch.setattr(propose.arguments, "beyond", lambda *_: "")  # takes a quarter of a second
    monkeypatch.setattr(propose.arguments, "limits", lambda *_: None)
    monkeypatch.chdir(tmp_path)
    for name, speed in SPEEDS.items():
        Path(f"{name}.toml").write_text(TOML.format(name, *speed))
    return Path("robot")


def next_walk(folder, names=("ahead", "aside", "back"), start="nominal"):
    flags = {}
    if not (folder / "config.json").exists():
        flags = {"traj": tuple(f"{name}.toml" for name in names), "start": start}
    propose.run_propose(Propose(folder, json=True, **flags))


def drawn(name, error=0.002, fall_at=None):
    """A walk along a trajectory, up to an error [m] to its left."""
    count = round(SECONDS * 1000)
    t = 1e-3 * np.arange(1, count + 1)[:, None]
    zero = np.zeros((count, 3))
    start = np.array([0.0, 0.0, ROBOT.standing_height])
    position = start + t * [*SPEEDS[name], 0.0] + error * np.sin(np.pi * t / SECONDS) * [0, 1, 0]
    if fall_at is not None:
        position[round(1000 * fall_at) :, 2] = 0.1
    rng = np.random.default_rng(len(name))
    still = no_samples(len(ROBOT.joint_lower), 2)
    still = jax.tree.map(lambda x: np.zeros((count, *x.shape[1:])), still)
    return still._replace(
        period=np.array(1e-3),
        initial=State(np.zeros(3), start, np.zeros(3), np.zeros(3)),
        state=State(zero, position, zero, zero),
        command=jax.tree.map(lambda x: rng.normal(size=x.shape), still.command),
    )


def plain(name, path=None, **options):
    """Write a log without a card; return its name."""
    path, log = path or f"{name}.npz", walk_log.log_of(drawn(name, **options))
    np.savez(path, **named_leaves(log))
    return path


def carded(folder, name, path=None, *, weights=None, number=0, card=None, **options):
    """Write a log with the card of `hector walk --out`; return its name."""
    path = path or f"{name}.npz"
    weights = weights or load_weights(walks.weights_path(folder, number), ROBOT)
    command = load_command(Path(f"{name}.toml")).command
    made = walk_log.walk_card(name, command, weights=weights, robot=ROBOT, seconds=SECONDS)
    about = {"walk": made | (card or {})}
    walk = drawn(name, **options)
    save_tree(Path(path), walk, kind="trajectory", robot=ROBOT, about=about)
    return path


def add(folder, *logs, **flags):
    propose.run_add(Add(folder, logs, json=True, **flags))


def result(capsys):
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def refused(folder, words, *logs, **flags):
    """Logs are refused in one line, and the folder is as it was."""
    before = files(folder)
    with pytest.raises(InputError, match=words) as error:
        add(folder, *logs, **flags)
    assert "\n" not in str(error.value)
    assert files(folder) == before


def test_logs_that_are_swapped_or_named_otherwise_are_refused(folder):
    next_walk(folder)
    logs = [carded(folder, name) for name in ("aside", "ahead", "back")]
    words = r"^aside.npz: a walk of aside, expected ahead; logs in the order ahead, aside, back, or"
    refused(folder, words, *logs)
    logs = [plain(name) for name in ("ahead", "back", "aside")]
    words = (
        r"^back.npz: fits back \(horizontal error 0.1 cm\), expected aside \(4.0 cm\); .* aside=b"
    )
    refused(folder, words, *logs)
    words = "LOGS: unknown trajectory 'ahad'; did you mean 'ahead'"
    refused(folder, words, "ahad=a.npz", "a.npz", "b.npz")
    words = "two files for ahead: a.npz and b.npz"
    refused(folder, words, "ahead=a.npz", "ahead=b.npz", "c.npz")
    words = "a log of each of ahead, aside, back, got 2 files"
    refused(folder, words, "ahead=a.npz", "b.npz")


def test_a_log_of_something_else_is_refused(folder):
    next_walk(folder, ("ahead",))
    for card, words in (
        ({"robot": "0123456789abcdef"}, "a walk of another robot, or with another gait"),
        ({"seconds": 4.0}, "a walk of 4.0 s, expected 0.1 s"),
        ({"trajectory": "eight", "command": "0"}, "a walk of eight, expected ahead"),
        ({"command": "0123456789abcdef"}, "a walk of ahead with another command, expected ahead;"),
    ):
        refused(folder, f"^ahead.npz: {words}", carded(folder, "ahead", card=card))
    own = load_weights(walks.weights_path(folder, 0), ROBOT)
    higher = own._replace(others={"foot_height": np.array(0.09)})
    words = r"^ahead.npz: a walk with other weights than the proposed ones, robot/weights/0.json$"
    refused(folder, words, carded(folder, "ahead", weights=higher))


def test_a_log_or_a_card_that_was_changed_is_refused(folder):
    next_walk(folder, ("ahead",))
    log = Path(carded(folder, "ahead"))
    log.write_bytes(log.read_bytes()[:-20])
    refused(folder, "^ahead.npz: ", str(log))
    with np.load(carded(folder, "ahead", weights=expert(ROBOT))) as archive:
        np.savez("edited.npz", **archive)
    refused(folder, "^edited.npz: cut or changed since it was written", "edited.npz")


def test_what_a_campaign_cannot_do_now_is_one_line(folder):
    next_walk(folder, ("ahead",))
    with pytest.raises(InputError, match="begun with --traj ahead.toml, got s"):
        propose.run_propose(Propose(folder, ("s",)))
    log = carded(folder, "ahead")
    add(folder, log)
    refused(folder, "other weights than the proposed ones, robot/weights/1.json", log)
    with np.load(log) as archive:
        np.savez("bare.npz", **{n: x for n, x in archive.items() if n != "card"})
    add(folder, "bare.npz")
    refused(folder, "^bare.npz: was added before, it is robot/logs/1-0.npz$", "bare.npz")
    with pytest.raises(InputError, match="nothing was proposed here"):
        add(Path("other"), log)


def test_a_fallen_walk_is_added_as_one(folder, capsys):
    next_walk(folder, ("ahead",))
    add(folder, plain("ahead"))
    next_walk(folder, ("ahead",))
    capsys.readouterr()
    # it fits another trajectory better, as a walk that fell may
    add(folder, plain("back", "ahead.npz", fall_at=0.04))
    seen = json.loads((captured := capsys.readouterr()).out)
    assert "fell after 0.04 s" in " ".join(captured.err.split())
    assert (seen["walk"], seen["best"], seen["change"]) == (1, 0, None)
    assert seen["logs"]["ahead"]["fell"] is True
    assert seen["logs"]["ahead"]["seconds"] == pytest.approx(0.04)


def told(campaign, walked, waiting, command, path):
    """A forecast of 20 % less, or none."""
    ends = Interval(-0.22, -0.4, -0.1)
    return ends if command.velocity[0, 0] > 0.0 else "no such log"


def test_a_proposed_walk_is_foretold_and_its_logs_tell_whether_that_held(
    folder, monkeypatch, capsys
):
    monkeypatch.setattr(forecasts, "_foretell", told)
    names = "ahead", "aside"
    next_walk(folder, names)
    assert result(capsys)["foretold"] == {}
    add(folder, *(plain(name, error=0.02) for name in names))
    assert result(capsys)["foretold"] == {}
    next_walk(folder, names)
    proposed = result(capsys)["foretold"]
    assert proposed["aside"] == {"not foretold": "no such log"}
    assert proposed["ahead"] == {"change": pytest.approx(-19.7, abs=0.1)} | {
        x: pytest.approx(100 * np.expm1(end)) for x, end in (("low", -0.4), ("high", -0.1))
    }
    propose.run_propose(Propose(folder))
    text = capsys.readouterr().out
    assert "ahead: L -20 [-33, -9.5] % against walk 0 is foretold\n" in text
    assert "aside: not foretold: no such log\n" in text
    for error, held, words in (
        (0.017, True, ", as foretold"),
        (0.0199, False, ", not as foretold"),
    ):
        logs = [plain(name, error=error) for name in names]
        walked = loss_of_ahead(folder, error) / loss_of_ahead(folder, 0.02)
        add(folder, *logs)
        seen = result(capsys)["foretold"]
        assert seen["ahead"]["held"] is held
        assert seen["ahead"]["walked"] == pytest.approx(100 * (walked - 1))
        add(folder, undo=True)
        propose.run_add(Add(folder, tuple(logs)))
        assert f"{words}\n" in capsys.readouterr().out
        add(folder, undo=True)
        capsys.readouterr()


def test_the_first_logs_can_be_undone_and_others_cannot(folder, capsys):
    """The start fell in all: a tuning has nowhere to begin, and another log may."""
    next_walk(folder, ("ahead",))
    before = files(folder)
    with pytest.raises(
        InputError, match="robot: the start fell or was not solved in all walks; tune from another"
    ):
        add(folder, plain("ahead", fall_at=0.04))
    add(folder, undo=True)
    undone = result(capsys)
    assert undone["walk"] == 0
    next_walk(folder)
    assert result(capsys)["walk"] == 0
    now = files(folder)
    assert now.pop(str(Path(*undone["logs"]).relative_to(folder)))
    assert now == before
    refused(folder, "^robot: no logs to take back$", undo=True)
    add(folder, plain("ahead"))
    assert result(capsys)["walk"] == 0


def campaign(folder):
    return propose._campaign(propose.from_file(Propose, folder / "config.json"))


def read(folder):
    return added_logs.read_campaign(HandsOver(), campaign(folder))


@pytest.mark.parametrize("undo", [True, False])
def test_adding_or_undoing_that_is_killed_leaves_the_old_or_the_new_state(folder, undo):
    """Killed before and after each of its writes; then the same once more."""
    next_walk(folder, ("ahead",))
    add(folder, carded(folder, "ahead", "0.npz"))
    next_walk(folder)
    log = carded(folder, "ahead", "1.npz", number=1)
    if undo:
        add(folder, log)
        next_walk(folder)
    added, undone = ((log,), {}), ((), {"undo": True})
    (logs, flags), (logs_back, flags_back) = (undone, added) if undo else (added, undone)
    log_kept, kills, calls = folder / "logs" / "1-0.npz", 0, []
    old = files(folder)

    def killed(real, at, after):
        def step(*args, **options):
            calls.append(real)
            this = len(calls) == at
            if this and not after:
                raise KeyboardInterrupt
            done = real(*args, **options)
            if this:
                raise KeyboardInterrupt
            return done

        return step

    writes = (os, "replace"), (Path, "unlink")
    for at, after in product(range(1, 16), (False, True)):
        with pytest.MonkeyPatch.context() as patch:
            calls.clear()
            for module, name in writes:
                patch.setattr(module, name, killed(getattr(module, name), at, after))
            with suppress(KeyboardInterrupt):
                add(folder, *logs, **flags)
        if len(calls) < at and not after:
            break
        kills += len(calls) >= at
        assert Path("1.npz").read_bytes() in files(folder).values() or not undo
        walked = log_kept.exists()
        assert read(folder).number == (2 if walked else 1)
        if walked != undo:
            add(folder, *logs_back, **flags_back)
        next_walk(folder)
        assert {n: x for n, x in files(folder).items() if "undone" not in n} == old
    assert kills == 2 * len(calls) >= 4


def test_logs_outlive_the_code_that_took_them_and_have_the_present_loss(folder, monkeypatch):
    for number in (1, 2):
        next_walk(folder, ("ahead", "aside"))
        add(folder, *(plain(name, error=0.003 * number) for name in ("ahead", "aside")))
    before, kept = read(folder), files(folder)
    for module in ("store.cache", "walk_tuning.walks"):
        monkeypatch.setattr(f"hector_jax.{module}.code_hash", lambda *_: "of other code")
    monkeypatch.setattr("hector_jax.core.environment.version", lambda package: "99")
    now = read(folder)
    assert same_sets(now.tuning.sets, before.tuning.sets)
    assert files(folder) == kept

    def heavier(description):
        return loss_of_robot(replace(description, loss=(("L_pos", 1e9),)))

    instead(monkeypatch, propose.tunings, "loss_of_robot", heavier)
    after = read(folder)
    assert (after.number, len(after.tuning.sets)) == (2, 2)
    for old, new in zip(before.tuning.sets, after.tuning.sets, strict=True):
        assert np.all(new.losses > 2.0 * old.losses)
        assert same(new.weights, old.weights)
    assert same(after.waiting, before.waiting)  # as it was proposed
    changed = {name for name, data in files(folder).items() if kept[name] != data}
    assert changed == {"walks.jsonl"}
    next_walk(folder)  # and it goes on


# The end


def loss_of_ahead(folder, error):
    """L of a walk with this error [m]."""
    one, path = campaign(folder), Path(plain("ahead", "scored.npz", error=error))
    log = walk_log.read_log(path, ROBOT, SECONDS, one.config.rollout.walk.gait.tick)
    return walk_log.evaluate_log(one.config, ROBOT, one.commands["ahead"], log).loss


@pytest.fixture
def ended(folder, monkeypatch, capsys):
    """A function that adds walks with these errors [m] until, after two steps, a tuning ends."""
    monkeypatch.setitem(LENGTH, "slope", 0.9)

    def walked(*errors, names=("ahead",), **options):
        next_walk(folder, names)
        for number, error in enumerate(errors):
            logs = [plain(name, f"{name}-{number}.npz", error=error) for name in names]
            capsys.readouterr()
            add(folder, *logs, **options)
        return result(capsys)

    return walked


def test_the_best_set_of_a_tuning_that_has_ended_is_asked_for_again(folder, ended, capsys):
    found = ended(0.02, 0.015, 0.01)
    assert (found["walk"], found["best"], found["again"]) == (2, 2, None)
    assert found["change"] < 0.0
    assert "predicted to gain too little" in found["ended"]
    next_walk(folder)
    asked = result(capsys)
    assert (asked["walk"], asked["weights"]) == (3, "robot/weights/3.json")
    assert asked["ended"] == found["ended"]
    best = Path(found["weights"])
    assert best == folder / "weights" / "2.json"
    assert Path(asked["weights"]).read_bytes() == best.read_bytes()
    refused(folder, "was added before, it is robot/logs/2-0.npz", "ahead-2.npz")


def test_the_best_set_is_called_clear_by_walks_that_did_not_choose_it(folder, ended, capsys):
    ended(0.02, 0.015, 0.01)
    start, *again = (np.log(loss_of_ahead(folder, error)) for error in (0.02, 0.0105, 0.011))
    for number, (error, logs) in enumerate(((0.0105, 1), (0.011, 2)), 3):
        add(folder, plain("ahead", f"again-{number}.npz", error=error))
        found = result(capsys)
        mean = np.mean(again[:logs]) - start
        assert (found["walk"], found["best"]) == (number, 2)
        assert found["again"]["change"] == pytest.approx(100.0 * np.expm1(mean))
        assert found["again"]["clear"] is True
        assert found["change"] == found["again"]["change"]
    propose.run_add(Add(folder, (plain("ahead", "last.npz", error=0.0103),)))
    text = capsys.readouterr().out
    assert "best is walk 2, L -" in text
    assert "in walks that did not choose it\n" in text
    assert "not distinguishable" not in text


@pytest.mark.parametrize(
    ("walked", "told", "again"),
    [
        (
            {"error": 0.0195},
            "in walks that did not choose it: not distinguishable from the start",
            False,
        ),
        ({"fall_at": 0.04}, "walk 3: fell; best is walk 2, fell, in walks that did not", False),
        ({"error": 0.0105}, "in walks that did not choose it\n", True),
    ],
    ids=["little gain", "a fall", "a gain"],
)
def test_a_walk_of_the_best_set_is_told_and_undone(folder, ended, capsys, walked, told, again):
    """A gain that only the walk that chose the set shows is not called clear; a fall is none."""
    ended(0.02, 0.015, 0.01)
    before = files(folder)
    propose.run_add(Add(folder, (plain("ahead", "last.npz", **walked),)))
    assert told in capsys.readouterr().out
    assert read(folder).again.clear is again
    assert (read(folder).again.change is None) == ("fall_at" in walked)
    add(folder, undo=True)
    undone = result(capsys)
    assert (undone["walk"], undone["weights"]) == (3, "robot/weights/3.json")
    next_walk(folder)
    assert result(capsys)["walk"] == 3
    now = files(folder)
    assert now.pop(str(Path(*undone["logs"]).relative_to(folder))) == Path("last.npz").read_bytes()
    assert now == before
    assert read(folder).again is None


def test_again_compares_the_cases_in_which_all_stood(folder, ended, capsys):
    """The start fell in one of two, which is no gain of all that there is."""
    next_walk(folder, ("ahead", "aside"))
    for number, error in enumerate((0.02, 0.015, 0.01, 0.0105)):
        aside = {"fall_at": 0.04} if number == 0 else {"error": error}
        capsys.readouterr()
        add(
            folder,
            plain("ahead", f"ahead-{number}.npz", error=error),
            plain("aside", f"aside-{number}.npz", **aside),
        )
    found = result(capsys)
    assert found["walk"] == 3
    start, again = (loss_of_ahead(folder, error) for error in (0.02, 0.0105))
    assert found["again"]["change"] == pytest.approx(100.0 * (again / start - 1.0))


def test_only_walks_of_the_best_set_count_as_such(folder, ended, monkeypatch):
    """Not those of steps that are none any more, as the loss is another."""
    ended(0.02, 0.015, 0.01)
    monkeypatch.setitem(LENGTH, "slope", 0.4)
    found = read(folder)
    assert (len(found.tuning.sets), found.number, found.again) == (2, 3, None)
    assert same(found.waiting, found.tuning.sets[1].weights)
    assert same(load_weights(walks.weights_path(folder, 3), ROBOT), found.waiting)


def test_the_log_of_a_walk_with_the_proposed_file_is_taken(folder, capsys):
    """From weights with unlike feet, which are tied, and with numbers beside Q and R."""
    start = nominal(ROBOT)._replace(others={"footstep_width": np.array(0.07)})
    uneven = start.R._replace(force=start.R.force * [[1.0], [2.0 / 3.0]])
    save_weights(Path("uneven.json"), start._replace(R=uneven))

    def walked(weights, **flags):
        walk.run_walk(Walk(traj="ahead.toml", weights=weights, out=Path("log.npz"), **flags))
        return "log.npz"

    next_walk(folder, ("ahead",), start="uneven.json")
    first = result(capsys)["weights"]
    refused(folder, f"other weights than the proposed ones, {first}", walked("uneven.json"))
    add(folder, walked(first))
    next_walk(folder)  # the other flags are those of the folder
    second = result(capsys)["weights"]
    refused(folder, f"other weights than the proposed ones, {second}", walked(first))
    add(folder, f"ahead={walked(second, world='standin', seed=3)}")
    assert result(capsys)["walk"] == 1
