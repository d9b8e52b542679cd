"""Reports of walks: whose log is refused, what is shown of it, what is undone, and what is kept.

The logs are drawn, not walked: what is tried here is what the folder makes of them.
"""

import json
from contextlib import nullcontext, suppress
from dataclasses import replace
from itertools import product
from pathlib import Path

import jax
import numpy as np
import pytest
from pretend import instead
from test_walks import HandsOver

from hector_jax.cli import evaluate, propose
from hector_jax.cli.flags import Propose, Report, Walk
from hector_jax.control.trajectories import load_command
from hector_jax.control.weights import expert, nominal
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import State, no_samples
from hector_jax.core.tree_file import save_tree
from hector_jax.robot.model import load_robot
from hector_jax.search.few_walks import Proposal
from hector_jax.tuning.loss import loss_of_robot
from hector_jax.walk_tuning import reported_walks, walk_log, walks

SECONDS = 0.1
SPEEDS = {"ahead": (0.5, 0.0), "aside": (0.0, 0.5), "back": (-0.5, 0.0)}
TOML = """
name = "{}"
[[segment]]
seconds = 0.1
v_x = {}
v_y = {}
"""
POINTS = 0.1 * np.random.default_rng(0).standard_normal((9, 19))


@pytest.fixture(scope="module")
def robot():
    return jax.tree.map(np.asarray, load_robot())


def proposed(space, history, *_, **__):
    """The next of POINTS, from the start on."""
    first = Proposal(np.zeros(19), "start", None)
    return Proposal(POINTS[len(history)], "model", -0.1) if history else first


@pytest.fixture
def folder(monkeypatch, robot, tmp_path):
    """A folder for reports of three trajectories, in which nothing is computed for a proposal."""
    pool = HandsOver()
    monkeypatch.setattr(propose, "workers", lambda processes: nullcontext(pool))
    instead(monkeypatch, walks.few_walks, "propose", proposed)
    instead(monkeypatch, walks.few_walks, "needs_model", lambda *_: False)
    instead(monkeypatch, walks.few_walks, "incumbent", lambda _, h: walks.few_walks.best_walk(h))
    monkeypatch.setattr(propose.arguments, "beyond", lambda *_: "")  # takes a quarter of a second
    monkeypatch.setattr(propose.arguments, "limits", lambda *_: None)
    monkeypatch.chdir(tmp_path)
    for name, speed in SPEEDS.items():
        Path(f"{name}.toml").write_text(TOML.format(name, *speed))
    folder = Path("robot")
    save_tree(folder / "metric.npz", {"matrix": np.eye(18)}, kind="metric", robot=robot)
    return folder


def next_walk(folder, names=("ahead", "aside", "back"), start="nominal"):
    flags = {}
    if not (folder / "config.json").exists():
        files = tuple(f"{name}.toml" for name in names)
        flags = {"traj": files, "start": start, "tune": ("foot_height",)}
    propose.run_propose(Propose(folder, json=True, **flags))


def drawn(robot, name, error=0.002, fall_at=None, seconds=SECONDS, place=(0.0, 0.0)):
    """A walk along a trajectory, up to an error [m] to its left."""
    count = round(seconds * 1000)
    t = 1e-3 * np.arange(1, count + 1)[:, None]
    zero = np.zeros((count, 3))
    start = np.array([*place, robot.standing_height])
    position = start + t * [*SPEEDS[name], 0.0] + error * np.sin(np.pi * t / seconds) * [0, 1, 0]
    if fall_at is not None:
        position[round(1000 * fall_at) :, 2] = 0.1
    rng = np.random.default_rng(len(name))
    empty = no_samples(len(robot.joint_lower), 2)
    return empty._replace(
        period=np.array(1e-3),
        initial=State(np.zeros(3), start, np.zeros(3), np.zeros(3)),
        state=State(zero, position, zero, zero),
        command=jax.tree.map(lambda x: rng.normal(size=(count, 2, 3)), empty.command),
        joints=np.zeros((count, 10)),
        fallen=np.zeros(count, bool),
        residual=np.zeros(count),
    )


def plain(robot, name, path=None, **options):
    """Write a log without a card; return its name."""
    path, log = path or f"{name}.npz", walk_log.log_of(drawn(robot, name, **options))
    np.savez(path, **walk_log.named_leaves(log))
    return path


def carded(folder, robot, name, path=None, *, weights=None, number=0, card=None, **options):
    """Write a log with the card of `hector walk --out`; return its name."""
    path = path or f"{name}.npz"
    weights = weights or load_weights(walks.weights_path(folder, number), robot)
    command = load_command(Path(f"{name}.toml")).command
    made = walk_log.walk_card(name, command, weights=weights, robot=robot, seconds=SECONDS)
    about = {"walk": made | (card or {})}
    walk = drawn(robot, name, **options)
    save_tree(Path(path), walk, kind="trajectory", robot=robot, about=about)
    return path


def report(folder, *logs, **flags):
    propose.run_report(Report(folder, logs, json=True, **flags))


def content(folder):
    """All files of a folder but the lock, and what is in them."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def result(capsys):
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def refused(folder, words, *logs, **flags):
    """A report is refused in one line, and the folder is as it was."""
    before = content(folder)
    with pytest.raises(InputError, match=words) as error:
        report(folder, *logs, **flags)
    assert "\n" not in str(error.value)
    assert content(folder) == before


# Whose log it is


def test_swapped_logs_with_cards_are_refused(folder, robot):
    next_walk(folder)
    logs = [carded(folder, robot, name) for name in ("aside", "ahead", "back")]
    words = r"^aside.npz: a walk of aside, expected ahead; logs in the order ahead, aside, back, or"
    refused(folder, words, *logs)


def test_swapped_logs_without_cards_are_refused(folder, robot):
    next_walk(folder)
    logs = [plain(robot, name) for name in ("ahead", "back", "aside")]
    words = (
        r"^back.npz: fits back \(horizontal error 0.1 cm\), expected aside \(4.0 cm\); .* aside=b"
    )
    refused(folder, words, *logs)


@pytest.mark.parametrize(
    ("logs", "words"),
    [
        (("ahad=a.npz", "a.npz", "b.npz"), "LOGS: unknown trajectory 'ahad'; did you mean 'ahead'"),
        (("ahead=a.npz", "ahead=b.npz", "c.npz"), "two files for ahead: a.npz and b.npz"),
        (("ahead=a.npz", "b.npz"), "a log of each of ahead, aside, back, got 2 files"),
    ],
)
def test_names_that_do_not_fit_are_refused(folder, logs, words):
    next_walk(folder)
    refused(folder, words, *logs)


@pytest.mark.parametrize(
    ("card", "words"),
    [
        ({"robot": "0123456789abcdef"}, "a walk of another robot, or with another gait"),
        ({"seconds": 4.0}, "a walk of 4.0 s, expected 0.1 s"),
        ({"trajectory": "eight", "command": "0"}, "a walk of eight, expected ahead"),
    ],
)
def test_a_log_of_another_robot_or_length_is_refused(folder, robot, card, words):
    next_walk(folder, ("ahead",))
    refused(folder, f"^ahead.npz: {words}", carded(folder, robot, "ahead", card=card))


@pytest.mark.parametrize("at", [0.01, 0.5, -20])  # in the card, in the numbers, in the hash
def test_a_log_with_a_damaged_card_is_refused(folder, robot, at):
    next_walk(folder, ("ahead",))
    log = Path(carded(folder, robot, "ahead"))
    data = bytearray(log.read_bytes())
    data[int(at * len(data)) if at > 0 else at] ^= 1
    log.write_bytes(data)
    refused(folder, "^ahead.npz: ", str(log))


def test_what_a_campaign_cannot_do_now_is_one_line(folder, robot):
    next_walk(folder, ("ahead",))
    with pytest.raises(InputError, match="begun with --traj ahead.toml, got s"):
        propose.run_propose(Propose(folder, ("s",)))
    log = carded(folder, robot, "ahead")
    report(folder, log)
    refused(folder, "no walk is waited for", log)
    with pytest.raises(InputError, match="nothing was proposed here"):
        report(Path("other"), log)


# What is shown


def test_a_fallen_walk_is_reported_as_one(folder, robot, capsys):
    next_walk(folder, ("ahead",))
    report(folder, plain(robot, "ahead"))
    next_walk(folder, ("ahead",))
    capsys.readouterr()
    # it fits another trajectory better, as a walk that fell may
    report(folder, plain(robot, "back", "ahead.npz", fall_at=0.04))
    seen = json.loads((captured := capsys.readouterr()).out)
    assert "fell after 0.04 s" in " ".join(captured.err.split())
    assert (seen["walk"], seen["best"], seen["change"]) == (1, 0, None)
    assert seen["logs"]["ahead"]["fell"] is True
    assert seen["logs"]["ahead"]["seconds"] == pytest.approx(0.04)


# Undo


def test_a_report_that_is_undone_and_made_again_leaves_the_same_bytes(folder, robot, capsys):
    next_walk(folder, ("ahead",))
    report(folder, plain(robot, "ahead", "0.npz"))
    next_walk(folder, ("ahead",))
    before = content(folder)
    report(folder, carded(folder, robot, "ahead", "1.npz", number=1))
    after = content(folder)
    next_walk(folder, ("ahead",))  # which the undo makes void
    capsys.readouterr()
    report(folder, undo=True)
    undone = result(capsys)
    assert (undone["walk"], undone["weights"]) == (1, "robot/weights/1.json")
    (log,) = undone["logs"]
    assert Path(log).read_bytes() == Path("1.npz").read_bytes()
    assert content(folder).items() >= before.items()
    next_walk(folder, ("ahead",))
    assert result(capsys)["walk"] == 1
    report(folder, "1.npz")
    again = content(folder)
    assert again.items() >= after.items()
    kept = {str(Path(log).relative_to(folder)), "weights/2.json"}
    assert again.keys() - after.keys() == kept  # and no proposal from the history before


STEPS = [(walks, "add_row"), (reported_walks, "write_file"), (Path, "replace"), (Path, "unlink")]


@pytest.mark.parametrize("undo", [True, False])
def test_a_report_or_undo_that_is_killed_leaves_the_old_or_the_new_state(
    folder, robot, undo, capsys
):
    """Killed before and after each of its writes; then the same once more."""
    next_walk(folder, ("ahead",))
    report(folder, carded(folder, robot, "ahead", "0.npz"))
    next_walk(folder, ("ahead",))
    log = carded(folder, robot, "ahead", "1.npz", number=1)
    if undo:
        report(folder, log)
        next_walk(folder, ("ahead",))
    call = {"undo": True} if undo else {}
    logs = () if undo else (log,)
    record, old, kills, calls = folder / "walks.jsonl", (folder / "walks.jsonl").read_bytes(), 0, []

    def killed(real, at, after):
        def step(*args, **options):
            calls.append(real)
            this = len(calls) == at
            if this and not after:
                raise KeyboardInterrupt
            done = real(*args, **options)
            if this and after:
                raise KeyboardInterrupt
            return done

        return step

    for at, after in product(range(1, 6), (False, True)):
        with pytest.MonkeyPatch.context() as patch:
            calls.clear()
            for module, name in STEPS:
                patch.setattr(module, name, killed(getattr(module, name), at, after))
            with suppress(KeyboardInterrupt):
                report(folder, *logs, **call)
        kills += len(calls) >= at
        number = len(rows(folder))
        waiting = walks.pending(campaign(folder), number)
        assert Path("1.npz").read_bytes() in content(folder).values() or not undo
        if record.read_bytes() == old:
            assert (number, waiting is None) == (2 if undo else 1, False)
            continue
        assert (number, waiting is None) == (1 if undo else 2, not undo)
        if undo:
            report(folder, log)
            next_walk(folder)
        else:
            report(folder, undo=True)
        assert record.read_bytes() == old
    assert kills == 2 * len(calls) > 4


# Data


def campaign(folder):
    return propose._campaign(propose.from_file(Propose, folder / "config.json"))


def rows(folder):
    return reported_walks.read_reports(HandsOver(), campaign(folder))


@pytest.fixture
def walked(folder, robot):
    """Two walks of two trajectories were reported."""
    for number in range(2):
        next_walk(folder, ("ahead", "aside"))
        error = 0.003 * (1 + number)
        report(folder, *(plain(robot, name, error=error) for name in ("ahead", "aside")))
    return folder


def test_reports_are_scored_by_the_present_loss(walked, monkeypatch):
    before, files = rows(walked), content(walked)

    def heavier(description):
        return loss_of_robot(replace(description, loss=(("L_pos", 1e9),)))

    instead(monkeypatch, propose.tunings, "loss_of_robot", heavier)
    after, one = rows(walked), campaign(walked)
    for number, (old, new) in enumerate(zip(before, after, strict=True)):
        scores = walks.evaluate_logs(HandsOver(), one, number)
        np.testing.assert_array_equal(new.losses, [score.loss for score, _ in scores])
        assert np.all(new.losses > 2.0 * old.losses)
        np.testing.assert_array_equal(new.point, old.point)
    assert (before[1].predicted, after[1].predicted) == (-0.1, None)  # it was of the other loss
    assert content(walked) == files
    next_walk(walked)  # and it goes on


def test_reports_outlive_the_code_and_packages_that_took_them(walked, monkeypatch):
    before, files = rows(walked), content(walked)
    for module in ("store.cache", "walk_tuning.walks"):
        monkeypatch.setattr(f"hector_jax.{module}.code_hash", lambda *_: "of other code")
    monkeypatch.setattr("hector_jax.core.environment.version", lambda package: "99")
    for old, new in zip(before, rows(walked), strict=True):
        jax.tree.map(np.testing.assert_array_equal, old, new)
    assert content(walked) == files


# From end to end


def test_the_log_of_a_walk_with_the_proposed_file_is_taken(folder, robot, capsys):
    """From weights with unlike feet, which are tied, and with numbers beside Q and R."""
    start = nominal(robot)
    uneven = start.R.force * [[1.0], [2.0 / 3.0]]
    others = {"footstep_width": np.array(0.07)}
    save_weights(
        Path("uneven.json"), start._replace(R=start.R._replace(force=uneven), others=others)
    )

    def walk(weights, **flags):
        evaluate.run_walk(Walk(traj="ahead.toml", weights=weights, out=Path("log.npz"), **flags))
        return "log.npz"

    next_walk(folder, ("ahead",), start="uneven.json")
    first = result(capsys)["weights"]
    refused(folder, f"other weights than the proposed ones, {first}", walk("uneven.json"))
    stiffer = (description := robot.description).path.read_text().replace("kp = [60", "kp = [61")
    Path("stiffer.toml").write_text(stiffer)
    Path("hector.xml").write_bytes(description.model.read_bytes())
    other = walk(first, robot=Path("stiffer.toml"))
    refused(folder, "a walk of another robot, or with another gait", other)
    report(folder, walk(first))
    next_walk(folder)  # the other flags are those of the folder
    second = result(capsys)["weights"]
    refused(folder, f"other weights than the proposed ones, {second}", walk(first))
    report(folder, f"ahead={walk(second, world='standin', seed=3)}")
    assert result(capsys)["walk"] == 1


def test_a_log_of_other_weights_is_refused(folder, robot):
    next_walk(folder, ("ahead",))
    log = carded(folder, robot, "ahead", weights=expert(robot))
    words = r"^ahead.npz: a walk with other weights than the proposed ones, robot/weights/0.json$"
    refused(folder, words, log)
    own = load_weights(walks.weights_path(folder, 0), robot)
    higher = own._replace(others={"foot_height": own.others["foot_height"] + 0.01})
    refused(folder, words, carded(folder, robot, "ahead", weights=higher))


def test_a_log_of_the_set_before_is_refused(folder, robot):
    next_walk(folder, ("ahead",))
    log = carded(folder, robot, "ahead")
    report(folder, log)
    next_walk(folder, ("ahead",))
    refused(folder, "other weights than the proposed ones, robot/weights/1.json", log)


def test_a_log_of_another_command_of_the_same_name_is_refused(folder, robot):
    next_walk(folder, ("ahead",))
    log = carded(folder, robot, "ahead", card={"command": "0123456789abcdef"})
    refused(folder, "a walk of ahead with another command, expected ahead;", log)


def test_a_card_that_was_edited_is_refused(folder, robot):
    next_walk(folder, ("ahead",))
    log = carded(folder, robot, "ahead", weights=expert(robot))
    with np.load(log) as archive:
        np.savez("edited.npz", **archive)
    refused(folder, "^edited.npz: cut or changed since it was written", "edited.npz")
