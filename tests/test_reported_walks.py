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
from hector_jax.core.tree_file import named_leaves, save_tree
from hector_jax.robot.model import load_robot
from hector_jax.search.few_walks import Proposal
from hector_jax.tuning.loss import loss_of_robot
from hector_jax.walk_tuning import reported_walks, walk_log, walks

SECONDS = 0.1
SPEEDS = {"ahead": (0.5, 0.0), "aside": (0.0, 0.5), "back": (-0.5, 0.0)}
TOML = 'name = "{}"\n[[segment]]\nseconds = 0.1\nv_x = {}\nv_y = {}\n'
POINTS = 0.1 * np.random.default_rng(0).standard_normal((9, 19))
ROBOT = jax.tree.map(np.asarray, load_robot())


def proposed(space, history, *_, **__):
    """The next of POINTS, from the start on."""
    first = Proposal(np.zeros(19), "start", None)
    return Proposal(POINTS[len(history)], "model", -0.1) if history else first


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """A folder for reports of three trajectories, in which nothing is computed for a proposal."""
    pool = HandsOver()
    monkeypatch.setattr(propose, "workers", lambda *_: nullcontext(pool))
    instead(monkeypatch, walks.few_walks, "propose", proposed)
    instead(monkeypatch, walks.few_walks, "needs_model", lambda *_: False)
    instead(monkeypatch, walks.few_walks, "incumbent", lambda _, h: walks.few_walks.best_walk(h))
    monkeypatch.setattr(propose.arguments, "beyond", lambda *_: "")  # takes a quarter of a second
    monkeypatch.setattr(propose.arguments, "limits", lambda *_: None)
    monkeypatch.chdir(tmp_path)
    for name, speed in SPEEDS.items():
        Path(f"{name}.toml").write_text(TOML.format(name, *speed))
    folder = Path("robot")
    save_tree(folder / "metric.npz", {"matrix": np.eye(18)}, kind="metric", robot=ROBOT)
    return folder


def next_walk(folder, names=("ahead", "aside", "back"), start="nominal"):
    flags = {}
    if not (folder / "config.json").exists():
        files = tuple(f"{name}.toml" for name in names)
        flags = {"traj": files, "start": start, "tune": ("foot_height",)}
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
    higher = own._replace(others={"foot_height": own.others["foot_height"] + 0.01})
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
    report(folder, log)
    refused(folder, "no walk is waited for", log)
    with pytest.raises(InputError, match="nothing was proposed here"):
        report(Path("other"), log)


def test_a_fallen_walk_is_reported_as_one(folder, capsys):
    next_walk(folder, ("ahead",))
    report(folder, plain("ahead"))
    next_walk(folder, ("ahead",))
    capsys.readouterr()
    # it fits another trajectory better, as a walk that fell may
    report(folder, plain("back", "ahead.npz", fall_at=0.04))
    seen = json.loads((captured := capsys.readouterr()).out)
    assert "fell after 0.04 s" in " ".join(captured.err.split())
    assert (seen["walk"], seen["best"], seen["change"]) == (1, 0, None)
    assert seen["logs"]["ahead"]["fell"] is True
    assert seen["logs"]["ahead"]["seconds"] == pytest.approx(0.04)


def test_a_report_that_is_undone_and_made_again_leaves_the_same_bytes(folder, capsys):
    next_walk(folder, ("ahead",))
    report(folder, plain("ahead", "0.npz"))
    next_walk(folder)
    before = content(folder)
    report(folder, carded(folder, "ahead", "1.npz", number=1))
    after = content(folder)
    next_walk(folder)  # which the undo makes void
    capsys.readouterr()
    report(folder, undo=True)
    undone = result(capsys)
    assert (undone["walk"], undone["weights"]) == (1, "robot/weights/1.json")
    log = Path(*undone["logs"])
    assert log.read_bytes() == Path("1.npz").read_bytes()
    assert content(folder).items() >= before.items()
    next_walk(folder)
    assert result(capsys)["walk"] == 1
    report(folder, "1.npz")
    again = content(folder)
    assert again.items() >= after.items()
    # and no proposal from the history before
    assert again.keys() - after.keys() == {str(log.relative_to(folder)), "weights/2.json"}


def campaign(folder):
    return propose._campaign(propose.from_file(Propose, folder / "config.json"))


def rows(folder):
    return reported_walks.read_reports(HandsOver(), campaign(folder))


def test_later_calls_ground_the_model_on_every_walk_if_the_first_asks_for_it(folder):
    flags = {"traj": ("ahead.toml",), "start": "nominal", "tune": ("foot_height",)}
    propose.run_propose(Propose(folder, every_walk=True, **flags))
    next_walk(folder)
    assert campaign(folder).model == "every_walk"


@pytest.mark.parametrize("undo", [True, False])
def test_a_report_or_undo_that_is_killed_leaves_the_old_or_the_new_state(folder, undo):
    """Killed before and after each of its writes; then the same once more."""
    next_walk(folder, ("ahead",))
    report(folder, carded(folder, "ahead", "0.npz"))
    next_walk(folder)
    log = carded(folder, "ahead", "1.npz", number=1)
    if undo:
        report(folder, log)
        next_walk(folder)
    reported, undone = ((log,), {}), ((), {"undo": True})
    (logs, flags), (logs_back, flags_back) = (undone, reported) if undo else (reported, undone)
    record, kills, calls = folder / "walks.jsonl", 0, []
    old = record.read_bytes()

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

    writes = (walks, "add_row"), (reported_walks, "write_file"), (Path, "replace")
    for at, after in product(range(1, 6), (False, True)):
        with pytest.MonkeyPatch.context() as patch:
            calls.clear()
            for module, name in writes:
                patch.setattr(module, name, killed(getattr(module, name), at, after))
            with suppress(KeyboardInterrupt):
                report(folder, *logs, **flags)
        kills += len(calls) >= at
        number = len(rows(folder))
        waits = walks.read_record(campaign(folder))[1] is not None
        assert Path("1.npz").read_bytes() in content(folder).values() or not undo
        if record.read_bytes() == old:
            assert (number, waits) == (2 if undo else 1, True)
            continue
        assert (number, waits) == (1 if undo else 2, undo)
        report(folder, *logs_back, **flags_back)
        if undo:
            next_walk(folder)
        assert record.read_bytes() == old
    assert kills == 2 * len(calls) == 4


def test_reports_outlive_the_code_that_took_them_and_are_scored_by_the_present_loss(
    folder, monkeypatch
):
    for number in (1, 2):
        next_walk(folder, ("ahead", "aside"))
        report(folder, *(plain(name, error=0.003 * number) for name in ("ahead", "aside")))
    before, files = rows(folder), content(folder)
    for module in ("store.cache", "walk_tuning.walks"):
        monkeypatch.setattr(f"hector_jax.{module}.code_hash", lambda *_: "of other code")
    monkeypatch.setattr("hector_jax.core.environment.version", lambda package: "99")
    for old, new in zip(before, rows(folder), strict=True):
        jax.tree.map(np.testing.assert_array_equal, old, new)

    def heavier(description):
        return loss_of_robot(replace(description, loss=(("L_pos", 1e9),)))

    instead(monkeypatch, propose.tunings, "loss_of_robot", heavier)
    after = rows(folder)
    for old, new in zip(before, after, strict=True):
        assert np.all(new.losses > 2.0 * old.losses)
        np.testing.assert_array_equal(new.point, old.point)
    assert (before[1].predicted, after[1].predicted) == (-0.1, None)  # it was of the other loss
    assert content(folder) == files
    next_walk(folder)  # and it goes on


def test_the_log_of_a_walk_with_the_proposed_file_is_taken(folder, capsys):
    """From weights with unlike feet, which are tied, and with numbers beside Q and R."""
    start = nominal(ROBOT)._replace(others={"footstep_width": np.array(0.07)})
    uneven = start.R._replace(force=start.R.force * [[1.0], [2.0 / 3.0]])
    save_weights(Path("uneven.json"), start._replace(R=uneven))

    def walk(weights, **flags):
        evaluate.run_walk(Walk(traj="ahead.toml", weights=weights, out=Path("log.npz"), **flags))
        return "log.npz"

    next_walk(folder, ("ahead",), start="uneven.json")
    first = result(capsys)["weights"]
    refused(folder, f"other weights than the proposed ones, {first}", walk("uneven.json"))
    report(folder, walk(first))
    next_walk(folder)  # the other flags are those of the folder
    second = result(capsys)["weights"]
    refused(folder, f"other weights than the proposed ones, {second}", walk(first))
    report(folder, f"ahead={walk(second, world='standin', seed=3)}")
    assert result(capsys)["walk"] == 1
