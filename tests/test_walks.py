"""Tuning on walks: budget, folder, logs, falls, and files against walks in process.

The first stories are of walks of five ticks, compiled once for all of them; the others of a toy, a
quadratic in log-weights whose optimum is another in each case.
"""

import json
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import jax
import model
import numpy as np
import pytest
from model import AHEAD, BEST_OTHERS, BRIEF, ROBOT, vector
from pretend import HandsOver, files

from hector_jax import InputError, Job, TuneConfig, hfs, load_robot, named_command, nominal, walk
from hector_jax.cli import arguments
from hector_jax.control.parameters import GROUPS
from hector_jax.control.weights import directions, expert, vector_to_weights, weights_to_vector
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core.trajectory import no_samples
from hector_jax.core.tree_file import save_tree
from hector_jax.own import walk_log
from hector_jax.sim.engine import MUJOCO_C
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.loss import alphas, loss_of
from hector_jax.walk_tuning import added_logs, best_set, walks
from hector_jax.walk_tuning import campaign as campaigns
from hector_jax.walk_tuning.best_set import drawn_plants
from hector_jax.walk_tuning.kept import compare_kept
from hector_jax.walk_tuning.starts import with_best_start

# all walks of this file are of these ticks and this command: one set of programs for all tests
CONFIG, COMMAND, SECONDS = TuneConfig(rollout=BRIEF, least_gain=1e-6), {"short": AHEAD}, 0.05
SETS, POOL, ANOTHER_ROBOT = 3, HandsOver(), "made for another robot of this name"


@pytest.fixture(scope="module")
def robot():
    return jax.tree.map(np.asarray, load_robot())


def campaign(folder, robot, plants=(None,), **others):
    own = {"folder": folder, "config": CONFIG, "robot": robot, "start": nominal(robot)}
    return campaigns.Campaign(**own | {"commands": COMMAND, "plants": plants} | others)


def same(a, b):
    return jax.tree.all(jax.tree.map(np.array_equal, a, b))


def same_sets(a, b):
    return len(a) == len(b) and all(map(same, a, b))


@pytest.fixture(scope="module")
def in_process(robot, tmp_path_factory):
    one = campaign(tmp_path_factory.mktemp("walked"), robot, [hfs()])
    return one, walks.tune_on_walks(POOL, one, walks=SETS)


def walked(robot, weights, path):
    job = Job(weights, AHEAD, hfs(), SECONDS)
    save_tree(path, walk(CONFIG.rollout.walk, robot, job), kind="trajectory", robot=robot)
    return path


def test_walks_through_files_are_those_in_process_to_the_last_bit(robot, in_process, tmp_path):
    one, (_, theirs) = campaign(tmp_path, robot), in_process
    for number in range(SETS):
        found = added_logs.read_campaign(POOL, one)  # as a new process would
        assert (found.number, found.again, found.tuning.reason) == (number, None, "")
        waiting = load_weights(walks.weights_path(tmp_path, number), robot)
        assert same(waiting, found.waiting)
        log = walked(robot, waiting, tmp_path / f"{number}.npz")
        added_logs.add_logs(one, number, [log])
    mine = added_logs.read_campaign(POOL, one).tuning
    assert same_sets(mine.sets, theirs.sets)
    assert [x.accepted for x in mine.sets].count(True) > 1
    assert mine.best == theirs.best > 0
    assert theirs.sets[theirs.best].losses[0] < 0.9 * theirs.sets[0].losses[0]
    assert theirs.reason == f"{SETS - 1} iterations"


def test_what_was_walked_is_not_walked_again(monkeypatch, in_process):
    one, first = in_process
    monkeypatch.setattr(walks, "walk_case", None)
    again = walks.tune_on_walks(POOL, one, walks=SETS)
    assert same_sets(again.sets, first.sets)
    assert again.best == first.best


def test_any_engine_walks_and_is_recorded(robot, in_process, tmp_path):
    jobs = []

    def walk_in(pool, config, robot, some, **options):
        jobs.extend(some)
        return (walk(config, robot, job) for job in some)

    engine = MUJOCO_C._replace(name="mine", walk=walk_in)
    one = replace(campaign(tmp_path, robot, [hfs()]), engine=engine)
    score = walks.walk_case(one, nominal(robot), 0)
    assert len(jobs) == 1
    assert score.loss == in_process[1].sets[0].losses[0]
    assert walks.tune_on_walks(POOL, one, waits).sets == []  # begins the record
    with pytest.raises(InputError, match="made with engine .mine"):
        walks.tune_on_walks(POOL, replace(one, engine=MUJOCO_C), waits)


def test_the_reference_of_a_log_is_that_of_its_walk(robot):
    walked = walk(CONFIG.rollout.walk, robot, Job(nominal(robot), AHEAD, hfs(), SECONDS))
    seen = walk_log.evaluate_log(CONFIG, robot, AHEAD, walk_log.log_of(walked))
    assert seen.loss == pytest.approx(float(loss_of(CONFIG.loss, walked)), rel=1e-9)


NOMINAL = np.asarray(weights_to_vector(nominal()))
LOG = walk_log.log_of(no_samples(10, 2))  # one without samples: the toy needs none
WALKED = []  # case and weights of the walks of `toy_case`
HERE = ThreadPoolExecutor(1)


def away(weights, case):
    """Logs of the weights against the optimum of a case, an e-fold or so from nominal."""
    aim = np.linspace(-0.4, 0.2, 18) + 0.05 * case * np.linspace(1.0, -1.0, 18)
    return np.log(np.asarray(weights_to_vector(weights)) / NOMINAL) - directions().T @ aim


def toy_loss(weights, case):
    """L of a case: a hundredth of it no weights can fix."""
    off = away(weights, case)
    return (case + 1) * 1e6 * (0.01 + off @ off)


def toy_slope(campaign, weights, case, log, moved=None):
    """Slope and matrix of the loss of a case, in the place of those grounded on its walk."""
    gradient = 2e6 * (case + 1) * away(weights, case) / np.asarray(weights_to_vector(weights))
    loss, zero = np.asarray(toy_loss(weights, case)), np.zeros(())
    terms = {term.name: loss for term in campaign.config.loss}
    matrix = 2e6 * (case + 1) * np.asarray(directions() @ directions().T)
    return Evaluation(loss, terms, as_weights(gradient), zero, zero), matrix


def as_weights(vector):
    return jax.tree.map(np.asarray, vector_to_weights(vector))


def toy_case(campaign, weights, case):
    WALKED.append((case, weights))
    return walk_log.ScoredLog(toy_loss(weights, case), LOG)


def logs(*losses):
    return [walk_log.ScoredLog(x, LOG) for x in losses]


def asked(number, weights, cases=1, fell=lambda number, case, weights: False):
    """The scored logs of a set, by the toy; those that fell have no loss."""
    found = (np.inf if fell(number, c, weights) else toy_loss(weights, c) for c in range(cases))
    return logs(*found)


def waits(number, weights):
    raise walks.Waiting


@pytest.fixture
def toy(monkeypatch, robot, tmp_path):
    """A function that makes a campaign whose walks and slopes are those of the toy."""
    monkeypatch.setattr(walks, "slope_of_walk", toy_slope)
    monkeypatch.setattr(walks, "walk_case", toy_case)
    WALKED.clear()

    def made(cases=3, folder="toy", **others):
        return campaign(tmp_path / folder, robot, drawn_plants(robot, cases), **others)

    return made


def test_a_toy_is_tuned_to_the_optimum_of_the_mean_of_log_l(toy):
    found = walks.tune_on_walks(HERE, toy(), walks=30)
    slopes = [
        np.mean([2.0 * away(w, c) / (0.01 + away(w, c) @ away(w, c)) for c in range(3)], axis=0)
        for w in (found.sets[0].weights, found.sets[found.best].weights)
    ]
    assert np.linalg.norm(slopes[1]) < 0.05 * np.linalg.norm(slopes[0])
    assert found.rows[found.best]["change"] < -90.0
    assert [row["change"] for row in found.rows] == walks.changes(found.sets)
    assert found.rows[0] == {"change": 0.0, "falls": 0, "accepted": True}


def test_a_tuning_begins_with_the_start_that_walks_best_and_repeats_none_of_its_walks(toy):
    aim = np.asarray(directions().T) @ np.linspace(-0.4, 0.2, 18)
    near, far = (as_weights(np.exp(x * aim) * NOMINAL) for x in (0.9, -2.0))
    starts = {"far": far, "near": near, "nominal": nominal()}
    name, first = with_best_start(HERE, toy(cases=5), starts)
    assert name == "near"
    assert same(first.start, walks.difftune.init(CONFIG, near).start)
    assert [case for case, _ in WALKED] == 3 * [0, 1, 2]
    found = walks.tune_on_walks(HERE, first, walks=10)
    assert [case for case, _ in WALKED[9:]] == [3, 4, 0, 1, 2, 3, 4]
    assert same(found.sets[0].weights, first.start)
    _, again = with_best_start(HERE, toy(cases=5), starts)
    assert same(again.start, first.start)
    assert len(WALKED) == 16


def test_of_several_starts_one_that_falls_less_often_is_taken(monkeypatch, toy):
    losses = iter([np.inf, 1e6, 1e6, 2e6, 2e6, 1.5e6])
    monkeypatch.setattr(walks, "walk_case", lambda *_: walk_log.ScoredLog(next(losses), LOG))
    starts = {"falls": expert(), "stands": nominal()}
    name, first = with_best_start(HERE, toy(), starts)
    assert name == "stands"
    assert same(first.start, walks.difftune.init(CONFIG, nominal()).start)


@pytest.mark.parametrize("killed_at", [0, 1, 4, 5])
def test_a_killed_run_keeps_each_walk_and_ends_as_one_that_is_not(monkeypatch, toy, killed_at):
    whole = walks.tune_on_walks(HERE, toy(folder="whole"), walks=9)
    assert [case for case, _ in WALKED] == 3 * [0, 1, 2]
    WALKED.clear()

    def cut(campaign, weights, case):
        if len(WALKED) == killed_at:
            raise KeyboardInterrupt
        return toy_case(campaign, weights, case)

    with monkeypatch.context() as patch, ThreadPoolExecutor(1) as pool:
        patch.setattr(walks, "walk_case", cut)
        with pytest.raises(KeyboardInterrupt):
            walks.tune_on_walks(pool, toy(), walks=9)
    again = walks.tune_on_walks(HERE, toy(), walks=9)
    assert [case for case, _ in WALKED] == 3 * [0, 1, 2]  # none twice
    assert same_sets(again.sets, whole.sets)
    for name in ("walks.jsonl", *(f"weights/{i}.json" for i in range(3))):
        cut, uncut = ((toy(folder=x).folder / name).read_bytes() for x in ("toy", "whole"))
        assert cut == uncut


def test_a_walk_is_kept_as_it_ends_though_one_before_it_has_not(monkeypatch, toy):
    """With 2 processes a killed run loses 2 walks at most, not all behind the longest."""
    kept, one = [], toy(cases=4)

    def slow_first(campaign, weights, case):
        if case == 0:
            assert others_are_kept.wait(10.0)
            kept.extend(path.name for path in (one.folder / "logs").glob("*.npz"))
        return toy_case(campaign, weights, case)

    others_are_kept, save = threading.Event(), walks.save_tree

    def watched_save(path, *inputs, **options):
        save(path, *inputs, **options)
        if len(list(path.parent.glob("*.npz"))) == 3:
            others_are_kept.set()

    monkeypatch.setattr(walks, "walk_case", slow_first)
    monkeypatch.setattr(walks, "save_tree", watched_save)
    with ThreadPoolExecutor(2) as pool:
        walks.walk_all(pool, one, 0, nominal())
    assert sorted(kept) == ["0-1.npz", "0-2.npz", "0-3.npz"]


def test_a_larger_budget_goes_on_from_the_walks_there_are(toy):
    first = walks.tune_on_walks(HERE, toy(), walks=6)
    assert (len(first.sets), first.reason) == (2, "1 iteration")
    assert len(WALKED) == 6
    more = walks.tune_on_walks(HERE, toy(), walks=14)  # whole sets only
    assert (len(more.sets), len(WALKED)) == (4, 12)
    assert same_sets(more.sets[:2], first.sets)
    less = walks.tune_on_walks(HERE, toy(), walks=6)
    assert same_sets(less.sets, first.sets)
    assert len(WALKED) == 12


def test_a_set_whose_walks_are_not_made_is_waited_for(toy):
    def ask(number, weights):
        seen.append(weights)
        if number == 2:
            raise walks.Waiting
        return ask_all(number, weights)

    ask_all = partial(asked, cases=3)
    seen, one = [], toy(cases=3)
    found = walks.tune_on_walks(HERE, one, ask)
    assert (len(found.sets), found.reason) == (2, "")
    assert same(found.waiting, seen[-1])
    assert same(found.waiting, load_weights(walks.weights_path(one.folder, 2)))
    assert not same(found.waiting, found.sets[1].weights)
    rows = list(map(json.loads, (one.folder / "walks.jsonl").read_text().splitlines()))
    assert [row["losses"] for row in rows[1:]] == [x.losses.tolist() for x in found.sets]
    ended = walks.tune_on_walks(HERE, one, ask_all)
    assert ended.waiting is None
    assert same_sets(ended.sets[:2], found.sets)


def test_the_walks_count_where_the_code_would_now_step_elsewhere(toy):
    """The weights in the folder are those that walked."""
    one, elsewhere = toy(cases=1), expert()
    save_weights(walks.weights_path(one.folder, 1), elsewhere)
    found = walks.tune_on_walks(HERE, one, walks=4)
    np.testing.assert_allclose(vector(found.sets[1].weights), vector(elsewhere), rtol=1e-12)
    assert found.sets[1].losses[0] == pytest.approx(toy_loss(elsewhere, 0))


def test_a_fall_is_a_bounded_loss_of_its_case_and_has_no_slope(toy):
    """Of e times the largest at the start; no loss counts as more."""
    one, at = toy(cases=3), nominal()
    start = np.array([toy_loss(at, case) for case in range(3)])
    objective = walks._Walks(HERE, one, partial(asked, cases=3, fell=lambda n, case, _: case == 1))
    worst = np.e * max(start[0], start[2])
    of_start = np.exp(np.mean(np.log([start[0], worst, start[2]])))
    assert float(objective.slope(at)[0].loss) == pytest.approx(of_start)
    objective.ask = lambda number, weights: logs(start[0], np.inf, 1e3 * start[2])
    found, _ = objective.slope(at)
    value = np.exp(np.mean(np.log([start[0], worst, worst])))
    assert float(found.loss) == pytest.approx(value)
    slopes = [np.asarray(weights_to_vector(toy_slope(one, at, c, LOG)[0].gradient)) for c in (0, 2)]
    expected = value / 3.0 * sum(g / start[c] for g, c in zip(slopes, (0, 2), strict=True))
    np.testing.assert_allclose(weights_to_vector(found.gradient), expected, rtol=1e-12)
    assert float(found.fallen) == 0.0
    objective.ask = lambda number, weights: logs(np.inf, np.inf, start[2])
    assert float(objective.slope(at)[0].fallen) == 1.0  # it falls in more cases than the start


def test_a_walk_whose_planner_fails_has_no_slope_and_the_others_steer(toy, monkeypatch, capsys):
    """From the start on there has to be one; later a set without any is refused."""
    failing, error = {1}, InputError("plans.py: ended with code 1")

    def slope(campaign, weights, case, log, moved):
        return error if case in failing else toy_slope(campaign, weights, case, log)

    monkeypatch.setattr(walks, "slope_of_walk", slope)
    one, at = toy(cases=3), nominal()
    objective = walks._Walks(HERE, one, partial(asked, cases=3))
    found, _ = objective.slope(at)
    assert "a walk without its slope: plans.py: ended with code 1" in capsys.readouterr().err
    slopes = [toy_slope(one, at, c, LOG)[0] for c in (0, 2)]
    shares = [float(found.loss) / 3.0 / toy_loss(at, c) for c in (0, 2)]
    vectors = [np.asarray(weights_to_vector(each.gradient)) for each in slopes]
    expected = sum(share * x for share, x in zip(shares, vectors, strict=True))
    np.testing.assert_allclose(weights_to_vector(found.gradient), expected, rtol=1e-12)
    failing.update(range(3))
    assert float(objective.slope(at)[0].fallen) == 1.0
    with pytest.raises(InputError, match=r"plans\.py: ended with code 1"):
        walks._Walks(HERE, one, partial(asked, cases=3)).slope(at)


def test_a_set_that_falls_in_more_cases_than_the_start_is_refused(toy):
    """Though its loss is lower; the shorter steps that follow are taken if they stand."""

    def fell(number, case, weights):
        return case == 0 and number in (1, 3)

    found = walks.tune_on_walks(HERE, toy(cases=4), partial(asked, cases=4, fell=fell), 20)
    assert [int(x.fell.sum()) for x in found.sets[:4]] == [0, 1, 0, 1]
    assert [x.accepted for x in found.sets[:4]] == [True, False, True, False]
    assert found.rows[1]["change"] < -10.0  # over the cases in which it stood
    assert found.best == max(i for i, x in enumerate(found.sets) if x.accepted)
    assert found.sets[found.best].fell.sum() == 0


def test_a_set_that_falls_in_all_cases_is_refused_and_a_shorter_step_follows(toy):
    fell = lambda number, case, weights: number in (1, 2)  # noqa: E731
    found = walks.tune_on_walks(HERE, toy(cases=2), partial(asked, cases=2, fell=fell), 10)
    assert [x.accepted for x in found.sets[:4]] == [True, False, False, True]
    assert [row["change"] is None for row in found.rows[:4]] == [False, True, True, False]
    length = [np.linalg.norm(np.log(weights_to_vector(x.weights) / NOMINAL)) for x in found.sets]
    assert length[1] > length[2] > length[3] > 0.0
    assert found.best == len(found.sets) - 1


@pytest.mark.parametrize(("price", "best"), [(0.1, True), (30.0, False)])
def test_a_set_that_makes_a_kept_command_much_worse_is_refused(monkeypatch, toy, price, best):
    """Its L grows with the way from the start; a shorter step then follows."""

    def case_or_kept(campaign, weights, case):
        found = toy_case(campaign, weights, case)
        if campaign.folder.name != "kept":
            return found
        away = np.linalg.norm(np.log(weights_to_vector(weights) / NOMINAL))
        return found._replace(loss=2.0 * np.exp(price * (case + 1) * away))

    monkeypatch.setattr(walks, "walk_case", case_or_kept)
    one = toy(kept={"turn": named_command("turn")})
    found = walks.tune_on_walks(HERE, one, walks=50)
    free = walks.tune_on_walks(HERE, toy(folder="free"), walks=50)
    assert found.kept(0) == {"turn": (pytest.approx(0.0), 0, False)}
    broken = {i for i in range(len(found.sets)) if any(x.broken for x in found.kept(i).values())}
    assert broken
    assert not any(found.sets[i].accepted for i in broken)
    assert (found.best > 0) == best
    turn = found.kept(found.best)["turn"]
    assert turn.change <= 10.0
    assert found.rows[found.best]["kept"] == {"turn": turn._asdict()}
    assert "kept" not in free.rows[0]
    record = (one.folder / "walks.jsonl").read_text().splitlines()
    assert len(json.loads(record[1])["kept"]) == 3
    made = len(WALKED)
    again = walks.tune_on_walks(HERE, one, walks=50)
    assert again.rows == found.rows
    assert len(WALKED) == made
    with pytest.raises(InputError, match="made with kept "):
        walks.tune_on_walks(HERE, replace(one, kept={"turn": named_command("c")}), walks=50)


def test_a_kept_command_is_compared_over_its_plants_and_may_fall_no_more_often():
    start = np.array([1.0, 10.0, 4.0, np.inf])  # turn and c on two plants
    found = compare_kept(["turn", "c"], start, np.array([1.2, 9.0, 4.0, np.inf]))
    assert found["turn"] == (pytest.approx(100.0 * (np.sqrt(1.2) - 1.0)), 0, False)
    assert found["c"] == (pytest.approx(-10.0), 1, False)
    found = compare_kept(["turn", "c"], start, np.array([1.2, np.inf, 5.0, 7.0]))
    assert found["turn"].broken
    assert found["c"] == (None, 1, False)  # nothing to compare


def test_from_a_start_that_falls_in_all_cases_nothing_is_tuned_and_in_one_it_is(toy):
    ask = partial(asked, cases=2, fell=lambda *_: True)
    found = walks.tune_on_walks(HERE, toy(cases=2), ask)
    assert [x.accepted for x in found.sets] == [False]
    assert found.reason == "the start fell or was not solved in all walks"
    fell = lambda number, case, weights: case == 1  # noqa: E731
    ask = partial(asked, cases=2, fell=fell)
    found = walks.tune_on_walks(HERE, toy(cases=2, folder="one"), ask, 10)
    assert found.best == len(found.sets) - 1 > 0  # in no more cases than the start
    assert found.rows[found.best]["change"] < -90.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda one: {"plants": drawn_plants(one.robot, 3, first_seed=1)}, "made with plants "),
        (lambda one: {"robot": one.robot._replace(mass=np.asarray(13.0))}, ANOTHER_ROBOT),
        (lambda one: {"start": expert()}, "made with start "),
        (lambda one: {"commands": {"short": named_command("c")}}, "made with commands "),
        (lambda one: {"config": replace(CONFIG, ridge=0.1)}, "made with settings "),
        (lambda one: {"config": replace(CONFIG, least_gain=0.1)}, "made with settings "),
        (lambda one: {"config": replace(CONFIG, others=("turn_lead",))}, "made with "),
    ],
)
def test_the_record_of_another_tuning_is_refused_in_one_line(toy, change, words):
    walks.tune_on_walks(HERE, one := toy(), walks=3)
    before = files(one.folder)
    told = f"^{one.folder / 'walks.jsonl'}: {words}.*; choose another folder$"
    with pytest.raises(InputError, match=told):
        walks.tune_on_walks(HERE, replace(one, **change(one)), walks=3)
    assert files(one.folder) == before


def test_a_record_a_log_or_weights_that_are_damaged_or_others_are_refused_in_one_line(toy):
    walks.tune_on_walks(HERE, one := toy(), walks=6)
    log, record = one.folder / "logs" / "1-0.npz", one.folder / "walks.jsonl"
    whole = log.read_bytes()
    log.write_bytes(whole[:-30])
    with pytest.raises(InputError, match=r"1-0.npz: cut or changed"):
        walks.tune_on_walks(HERE, one, walks=6)
    log.write_bytes(whole)
    lines = record.read_text().splitlines()
    record.write_text("\n".join([lines[0], "{", ""]))
    with pytest.raises(InputError, match=r"walks.jsonl, line 2: a row of a tuning on walks"):
        walks.tune_on_walks(HERE, one, walks=6)
    record.write_text("\n".join([*lines, ""]))
    path = walks.weights_path(one.folder, 1)
    wide = load_weights(path)._replace(others={"footstep_width": np.array(0.07)})
    save_weights(path, wide)
    words = "1.json: others must be those of the start, none; got footstep_width"
    with pytest.raises(InputError, match=words):
        walks.tune_on_walks(HERE, one, walks=6)


def masses(plants):
    return [float(plant.mass) for plant in plants]


# flags, commands, and the plants and walks: four sets, none beside the hfs, or eight sets
BUDGETS = [
    (None, None, 1, 12, 48),
    (None, None, 3, 12, 144),
    (2, None, 1, 2, 8),
    (0, None, 1, 1, 4),
]
BUDGETS += [(None, 0, 1, 1, 0), (None, 2, 1, 1, 2), (None, 40, 1, 5, 40), (None, 36, 3, 1, 36)]
BUDGETS += [(None, 100_000, 1, 16, 100_000), (3, 24, 2, 3, 24)]


@pytest.mark.parametrize("budget", BUDGETS)
def test_a_budget_is_four_sets_on_twelve_plants_or_eight_on_more(budget):
    *given, plants, walks = budget
    found, all_walks = best_set.walk_plants(ROBOT, *given)
    assert (len(found), all_walks) == (plants, walks)
    if given[0] == 0:
        same = jax.tree.map(np.array_equal, found, [hfs(ROBOT.description)])
        assert jax.tree.all(same)
    else:  # a larger budget begins with the same plants
        assert masses(found) == masses(best_set.drawn_plants(ROBOT, 16)[:plants])
        assert len(set(masses(found))) == plants


def test_plants_of_a_tuning_are_none_that_judge_it():
    standin = masses(arguments.plants("standin", range(32), ROBOT.description))
    assert not {*standin} & {*masses(best_set.drawn_plants(ROBOT, 1000))}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((None, 1, 1), "at least 2 (1 command on 1 plant, twice), got 1"),
        ((None, 5, 3), "at least 6 (3 commands on 1 plant, twice), got 5"),
        ((8, 15, 1), "at least 16 (1 command on 8 plants, twice), got 15"),
        ((0, 3, 2), "at least 4 (2 commands on 1 plant, twice), got 3"),
    ],
)
def test_a_budget_with_which_no_second_set_walks_is_one_line(given, words):
    with pytest.raises(InputError) as error:
        best_set.walk_plants(ROBOT, *given)
    assert str(error.value) == f"--walks must be 0 or {words}"


def test_best_is_tuned_with_numbers_of_its_own_and_smoothly_where_asked():
    start = nominal()._replace(others={"footstep_width": np.array(0.09)})
    config, at = best_set.settings_of_best(model.CONFIG, ROBOT, start, smooth=3.0, safe=0.05)
    assert at.others == {**BEST_OTHERS, "position_limit": 0.05, "footstep_width": 0.09}
    before = alphas(model.CONFIG.loss)
    assert alphas(config.loss) == {**before, "L_between": 3.0 * before["L_ctrl"]}
    assert config.others == GROUPS["integral"]
    assert config.rollout == model.CONFIG.rollout
    jax.tree.map(np.testing.assert_array_equal, at[:2], start[:2])
