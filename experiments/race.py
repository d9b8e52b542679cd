"""Is a tuning on walks ahead of what sees one number of each walk? The race.

`hector tune --walks` and its parts against the optimizers of `rivals.py`: from the same starts,
on the high-fidelity simulator, one trajectory each. All search in the box of the weights, rivals
within 3 of the start in log-weights or 4 in the metric of the model.

    python experiments/race.py --traj s --start nominal assets/hector-best.json

Each contest is a tuning of its own with a folder under OUT/contests; a later call continues there,
with more methods or walks too. At the end the best set of each at some budgets walks on plants that
no one has walked.

The walk of the start counts for the methods that need it. `--robot` and `--engine` choose what is
walked; by default it is HECTOR in MuJoCo C.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import plots
import tyro
from jaxtyping import Float
from lib import check_names, write_report
from rivals import LEARN, READ_START, RIVALS, Spent, Task
from scipy.stats import t as student

from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import Weights, nominal
from hector_jax.control.weights_file import load_weights
from hector_jax.core.arrays import Array
from hector_jax.core.console import bar, exit_code, say
from hector_jax.core.files import make_folder
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.settings import AT_LEAST_ONE, SEED, Range, check
from hector_jax.core.tree_file import load_tree, save_tree
from hector_jax.grfm.network import effect_of
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import Robot, load_robot
from hector_jax.search import few_walks
from hector_jax.search.few_walks import Proposal, Space
from hector_jax.sim.engine import choose_engine
from hector_jax.sim.world import hfs, named_world
from hector_jax.store import tunings
from hector_jax.store.cache import content_key
from hector_jax.store.setup import Setup
from hector_jax.tuning.loss import Loss, loss_of
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout
from hector_jax.verdict import judging
from hector_jax.walk_tuning import walks
from hector_jax.walk_tuning.campaign import Campaign, box_of, weights_at
from hector_jax.walk_tuning.walks import Row

BUDGETS = (0, 1, 5, 10, 25, 50, 100, 200)
WALKS = "walks"
OURS: dict[str, dict[str, Any]] = {
    WALKS: {},
    "no metric": {},
    "no grounding": {"model": "plain"},
    "no gradients": {"model": "none"},
}
"""The method of `hector tune --walks`, and what is left out of it."""
METRIC = " in metric"
METHODS = (*OURS, *RIVALS, *(name + METRIC for name in RIVALS))
NOMINAL = "nominal"
SPREADS = {NOMINAL: 1.0}  # first standard deviation of rivals by start
SPREAD = 0.3  # from a tuned start
NEAR, FAR = 3.0, 4.0  # box of rivals: log-weights, and the metric's units
SEARCHES, SOURCES = 8, 250  # searches on the model, for rivals that learn from them; points of each
NET = 64  # walks of the simulator that the net of a tuned start has seen


@dataclass(frozen=True)
class Flags:
    """What to race."""

    traj: tuple[str, ...] = ("s",)
    start: tuple[str, ...] = (NOMINAL,)  # nominal, or weights files
    methods: tuple[str, ...] = (WALKS, *RIVALS)
    walks: int = 200  # of each contest
    repeats: int = 3  # seeds of each method
    plants: int = 8  # of hfs-varied, from `first_plant` on, that judge the best sets; 0: none
    first_plant: int = 300
    engine: str = "c"  # what walks, one of `hector walk --engine` but mjx
    robot: Path | None = None  # TOML file of another robot; HECTOR by default
    out: Path = Path("runs/race")  # folder of the report
    processes: int = 2  # one core each

    def __post_init__(self) -> None:
        counts = dict.fromkeys(("walks", "repeats", "processes"), AT_LEAST_ONE)
        check(self, **counts, plants=Range(0), first_plant=SEED)
        check_names("methods", self.methods, METHODS)
        check_names("engine", [self.engine], ("c", "drake", "pinocchio"))
        names = [Path(name).stem for name in self.start]
        if len({*names, NOMINAL}) < len({*self.start, NOMINAL}):
            raise InputError(
                "Flags.start must be nominal, or files of different names other than that, got "
                + ", ".join(self.start)
            )


class Contest(NamedTuple):
    """One tuning of the race."""

    traj: str
    start: str
    method: str
    seed: int

    @property
    def name(self) -> str:
        """Name of its folder."""
        return "-".join((self.traj, self.start, self.method.replace(" ", "_"), str(self.seed)))

    @property
    def counts_start(self) -> bool:
        """Whether the walk of the start is one of its walks."""
        return self.method in OURS or self.method.removesuffix(METRIC) in READ_START

    def rows_after(self, budget: int) -> int:
        """Return the number of rows that so many walks buy, that of the start included."""
        return max(budget + (not self.counts_start), 1)


class _Inline(Executor):
    """Does each job at once, in this process."""

    def submit(self, fn: Callable, /, *args: Any, **kwargs: Any) -> Future:
        done: Future = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class Model(NamedTuple):
    """What the model tells about a start before any walk."""

    space: Space
    steps: Float[np.ndarray, "m n"]  # log-weights less those of the start, of searches on the model
    losses: Float[np.ndarray, " m"]  # their log-losses there less that of the start


def search_job(campaign: Campaign, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Search on the model with CMA-ES; return the steps of all its points and their log-losses."""
    (command,) = campaign.commands.values()
    box = _box(campaign)
    identity = np.eye(len(box))
    space = Space(identity, identity, np.zeros(len(box)), box_of(campaign))
    config = campaign.config.rollout
    anchor, effect = standing_anchor(campaign.robot), effect_of(None, config.walk)
    scenario, loss = Scenario(campaign.robot, command, anchor, effect), campaign.config.loss
    at_start = float(np.log(_model_loss(config, scenario, loss, campaign.start)))
    points: list[np.ndarray] = []
    losses: list[float] = []

    def walk(point: Float[np.ndarray, " n"]) -> float:
        if len(losses) == SOURCES:
            raise Spent
        found = _model_loss(config, scenario, loss, weights_at(campaign, space, point))
        change = float(np.log(found)) - at_start
        points.append(point)
        losses.append(change if np.isfinite(change) else max(losses, default=0.0) + 1.0)
        return losses[-1]

    nothing = np.zeros((0, len(box))), np.zeros(0)
    with suppress(Spent):
        RIVALS["cma-es"](Task(walk, box, SPREAD, seed, nothing))
    return np.array(points), np.array(losses)


@partial(jax.jit, static_argnums=0)
def _model_loss(config: RolloutConfig, scenario: Scenario, loss: Loss, weights: Weights) -> Array:
    return loss_of(loss, rollout(config, scenario, weights))


def _box(campaign: Campaign) -> Float[np.ndarray, "n 2"]:
    return np.clip(box_of(campaign), -NEAR, NEAR)


def contest_job(campaign: Campaign, contest: Contest, model: Model, budget: int) -> None:
    """Walk a contest to its end, from what is in its folder on."""
    make_folder(campaign.folder)
    space, rows = _space(campaign, contest, model), walks.read_record(campaign)[0]

    def walk(proposal: Proposal, weights: Weights) -> None:
        rows[:] = walks.add_walk(campaign, rows, proposal, [walks.walk_case(campaign, weights, 0)])

    if len(rows) >= contest.rows_after(budget):
        return
    if not rows:
        walk(Proposal(np.zeros(len(space.box)), "start", None), campaign.start)
    if not np.isfinite(rows[0].losses[0]):
        raise InputError(f"{campaign.folder}: the start fell, or a QP was not solved")
    if contest.method in OURS:
        while len(rows) < contest.rows_after(budget):
            walk(*walks.next_proposal(_Inline(), campaign, space, rows))
        return
    metric, seen = contest.method.endswith(METRIC), [] if contest.counts_start else rows[:1]

    def to_point(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return space.clip(np.asarray(x) if metric else space.to_point @ np.asarray(x))

    def loss(x: Float[np.ndarray, " n"]) -> float:
        point, number = to_point(x), len(seen)
        if number == contest.rows_after(budget):
            raise Spent
        if number == len(rows):
            walk(Proposal(point, contest.method, None), weights_at(campaign, space, point))
        if not np.allclose(rows[number].point, point, atol=1e-6):
            raise InputError(f"{campaign.folder}: walk {number} was another; remove the folder")
        seen.append(rows[number])
        return float(_log_losses(rows)[number])

    steps = model.steps @ space.to_point.T if metric else model.steps
    box = np.tile([-FAR, FAR], (len(space.box), 1)) if metric else _box(campaign)
    spread = SPREADS.get(contest.start, SPREAD)
    task = Task(loss, box, spread, contest.seed, (steps, model.losses))
    with suppress(Spent):
        RIVALS[contest.method.removesuffix(METRIC)](task)


def _space(campaign: Campaign, contest: Contest, model: Model) -> Space:
    if contest.method != "no metric":
        return model.space
    return few_walks.space_of(np.zeros_like(model.space.to_steps), box_of(campaign))


def _log_losses(rows: Sequence[Row]) -> Float[np.ndarray, " walks"]:
    """Return the log-losses less that of the start; a fall is worse than all before it."""
    losses = np.array([row.losses[0] for row in rows])
    worst = np.maximum.accumulate(np.where(np.isfinite(losses), losses, 0.0))
    return np.log(np.where(np.isfinite(losses), losses, np.e * worst) / losses[0])


class Entry(NamedTuple):
    """A method from a start, on one trajectory."""

    start: str
    method: str


class Best(NamedTuple):
    """The best set of a contest after so many walks."""

    number: int  # of its walk
    weights: Weights
    loss: float  # L on the plant that was walked


def best_of(campaign: Campaign, contest: Contest, model: Model, rows: Sequence[Row]) -> Best:
    """Return the best set of some walks: of ours by posterior mean, of the others the least L."""
    space = _space(campaign, contest, model)
    losses = [row.losses[0] for row in rows]
    number = int(np.argmin(losses))
    if contest.method in OURS:
        number = walks.answer(campaign, space, rows)[1]
    return Best(number, weights_at(campaign, space, rows[number].point), losses[number])


Losses = dict[Entry, dict[int, list[float]]]
"""L of the best sets by entry and budget, one for each repeat."""


class Lead(NamedTuple):
    """Ratio of the losses of an entry to those of its best rival, with its 95 % interval.

    The interval is Student's, over pairs of repeats: the chance is that of the methods. Plants are
    the same in all repeats, so it tells nothing of others.
    """

    rival: Entry
    ratio: float
    low: float
    high: float


def lead(losses: Losses, entry: Entry, budget: int, *, charge: int = 0) -> Lead:
    """Compare an entry with the rival from its start of the least mean log-loss, by repeat.

    Args:
        losses: of all entries.
        entry: one of ours.
        budget: number of walks.
        charge: walks that the start of the entry has taken, less than the budget; rivals are then
            those from nominal.
    """
    ours = np.log(losses[entry][budget - charge])
    rivals = {
        rival: np.log(each[budget])
        for rival, each in losses.items()
        if rival.method not in OURS and rival.start == (NOMINAL if charge else entry.start)
    }
    best = min(rivals, key=lambda rival: np.mean(rivals[rival]))
    count = min(len(ours), len(rivals[best]))
    ratios = ours[:count] - rivals[best][:count]
    error = np.std(ratios, ddof=1) / np.sqrt(count) if count > 1 else np.inf
    reach = student.ppf(0.975, max(count - 1, 1)) * error
    return Lead(best, *(float(np.exp(ratios.mean() + by)) for by in (0.0, -reach, reach)))


def read_model(pool: Executor, campaign: Campaign, *, searches: bool) -> Model:
    """Return what the model tells of a start, with searches if a rival learns from them.

    It is computed once, in a folder of its own for all that it depends on.
    """
    settings = campaign.config, campaign.robot, campaign.start, tuple(campaign.commands.values())
    key = content_key(*settings, SEARCHES, function_id(search_job), code=("walk_tuning.walks",))
    campaign = replace(campaign, folder=campaign.folder / key)
    path, size = campaign.folder / "searches.npz", len(box_of(campaign))
    parts = {"steps": np.zeros((0, size)), "losses": np.zeros(0)}
    if searches and not path.exists():
        jobs = [pool.submit(search_job, campaign, seed) for seed in range(SEARCHES)]
        results = zip(*(job.result() for job in jobs), strict=True)
        parts = dict(zip(parts, map(np.concatenate, results), strict=True))
        save_tree(path, parts, kind="searches", robot=campaign.robot)
    if searches:
        parts = load_tree(path, parts, kind="searches", robot=campaign.robot)[0]
    return Model(walks.campaign_space(pool, campaign), **parts)


def main() -> None:
    """Walk all contests, judge their sets, and write report.md, race.json and the pictures."""
    flags = tyro.cli(Flags)
    setup_jax()
    robot, engine = jax.tree.map(np.asarray, load_robot(flags.robot)), choose_engine(flags.engine)
    config, plant = tunings.tune_config(robot), hfs(robot.description)
    sets = {Path(name).stem: _load(name, robot) for name in flags.start}

    def campaign_of(traj: str, start: str, folder: Path, **options: Any) -> Campaign:
        inputs = folder, config, robot, sets[start], {traj: named_command(traj)}, [plant]
        return Campaign(*inputs, engine=engine, **options)

    contests = [
        Contest(*row) for row in product(flags.traj, sets, flags.methods, range(flags.repeats))
    ]
    campaigns = {
        contest: campaign_of(
            contest.traj,
            contest.start,
            flags.out / "contests" / contest.name,
            seed=contest.seed,
            **OURS.get(contest.method, {}),
        )
        for contest in contests
    }
    with workers(flags.processes) as pool:
        pairs = list(product(flags.traj, sets))
        searches = any(method.removesuffix(METRIC) in LEARN for method in flags.methods)
        models = {
            (traj, start): read_model(
                pool, campaign_of(traj, start, flags.out / "models"), searches=searches
            )
            for traj, start in pairs
        }
        inputs = [(campaigns[c], c, models[c[:2]], flags.walks) for c in contests]
        with bar("racing") as report_progress:
            for done, future in enumerate([pool.submit(contest_job, *row) for row in inputs], 1):
                future.result()
                report_progress(done, len(contests), contests[done - 1].name)
        budgets, both = _budgets(flags), NOMINAL in sets and len(sets) > 1
        charged = [budget - NET for budget in budgets if both and budget >= NET]
        rows = {
            c: walks.read_record(campaigns[c])[0][: c.rows_after(flags.walks)] for c in contests
        }
        bests = {
            (c, budget): best_of(campaigns[c], c, models[c[:2]], rows[c][: c.rows_after(budget)])
            for c in contests
            for budget in sorted({*budgets, *charged})
        }
        judged = judge(Setup(pool, config, robot), flags, bests)
    falls = {c: sum(not np.isfinite(row.losses[0]) for row in rows[c]) for c in contests}
    say(f"the report is {report(flags, bests, judged, falls)}")


def _load(name: str, robot: Robot) -> Weights:
    return nominal(robot) if name == NOMINAL else load_weights(Path(name), robot)


def _budgets(flags: Flags) -> list[int]:
    """Return the budgets of the tables."""
    return [budget for budget in BUDGETS if budget < flags.walks] + [flags.walks]


Bests = Mapping[tuple[Contest, int], Best]


def judge(setup: Setup, flags: Flags, bests: Bests) -> dict[tuple[Contest, int], float]:
    """Return the mean L of the best sets on other plants; infinite after a fall."""
    judged = {}
    seeds = range(flags.first_plant, flags.first_plant + flags.plants)
    description = setup.robot.description
    plants = [named_world("hfs-varied", seed, description) for seed in seeds]
    for traj in flags.traj if plants else ():
        of_traj = {key: best for key, best in bests.items() if key[0].traj == traj}
        sets = {_set_name(key[0], best): best.weights for key, best in of_traj.items()}
        inputs = setup, sets, named_command(traj), plants, seeds
        options = {"title": f"judging {traj}", "folder": flags.out / "scores"}
        scores = judging.judge(*inputs, **options, engine=choose_engine(flags.engine)).scores
        for key, best in of_traj.items():
            each = scores[_set_name(key[0], best)]
            fell = any(score.fallen for score in each)
            judged[key] = np.inf if fell else float(np.mean([score.L for score in each]))
    return judged


def _set_name(contest: Contest, best: Best) -> str:
    return f"start-{contest.start}" if best.number == 0 else f"{contest.name}-{best.number}"


def _by_entry(traj: str, losses: Mapping[tuple[Contest, int], float]) -> Losses:
    """Group the losses on a trajectory by entry and budget."""
    grouped: Losses = {}
    for (contest, budget), loss in losses.items():
        if contest.traj == traj:
            entry = grouped.setdefault(Entry(contest.start, contest.method), {})
            entry.setdefault(budget, []).append(loss)
    return grouped


def report(
    flags: Flags,
    bests: Bests,
    judged: Mapping[tuple[Contest, int], float],
    falls: Mapping[Contest, int],
) -> Path:
    """Write the report with its pictures and its numbers; returns its path."""
    own = {key: best.loss for key, best in bests.items()}
    text: list[str] = []
    numbers: dict[str, Any] = {}
    pictures: dict[str, str] = {}
    for traj in flags.traj:
        on_own, on_others = _by_entry(traj, own), _by_entry(traj, judged)
        text += [f"## {traj}", _losses_table(flags, on_own, falls, traj)]
        if on_others:
            title = f"Mean L on {flags.plants} other plants, median over the repeats [1e6]:"
            text += [title, _losses_table(flags, on_others, {}, traj)]
        for title, losses in (("the plant of the walks", on_own), ("the other plants", on_others)):
            if any(entry.method not in OURS for entry in losses):
                about = f"L against the best rival on {title} [95 % interval over the repeats]:"
                text += [about, _leads_table(flags, losses)]
        numbers[traj] = {
            f"{entry.start} {entry.method}": {
                "own": each,
                "others": on_others.get(entry, {}),
                "falls": [falls[c] for c in falls if c[:3] == (traj, *entry)],
            }
            for entry, each in on_own.items()
        }
        names = [
            e.method if len(flags.start) == 1 else f"{e.method}, from {e.start}" for e in on_own
        ]
        curves = dict(zip(names, on_own.values(), strict=True))
        pictures[f"{traj}.png"] = plots.race(flags.out / f"{traj}.png", curves)
    intro = (
        f"Engine {choose_engine(flags.engine).title}, {flags.walks} walks a contest, "
        f"{flags.repeats} seeds. L of the best set so far on the simulator's own plant, median "
        "over the repeats [1e6]: of the methods of `hector tune --walks` that of the least "
        "posterior mean, of the others that of the least L."
    )
    numbers |= {"flags": {name: str(value) for name, value in asdict(flags).items()}}
    inputs = flags.out / "report.md", f"The race: {flags.out.name}", [intro, *text]
    return write_report(*inputs, numbers=numbers, json_name="race.json", pictures=pictures)


def _losses_table(flags: Flags, losses: Losses, falls: Mapping[Contest, int], traj: str) -> str:
    budgets = _budgets(flags)
    head = ["start", "method", "repeats", *map(str, budgets), *(["falls"] if falls else [])]
    rows = []
    for entry, each in losses.items():
        cells = [f"{np.median(each[budget]) / 1e6:.3f}" for budget in budgets]
        fell = [falls[c] for c in falls if c[:3] == (traj, *entry)]
        rows.append(
            [*entry, str(len(each[0])), *cells, *([f"{np.mean(fell):.1f}"] if fell else [])]
        )
    return markdown_table(head, rows)


def _leads_table(flags: Flags, losses: Losses) -> str:
    budgets = _budgets(flags)
    rows = []
    for entry in losses:
        if entry.method not in OURS:
            continue
        for charge in (0,) if entry.start == NOMINAL or NOMINAL not in flags.start else (0, NET):
            leads = [lead(losses, entry, b, charge=charge) for b in budgets if b >= charge]
            cells = [f"{x.ratio:.2f} [{x.low:.2f}, {x.high:.2f}] {x.rival.method}" for x in leads]
            blank = [""] * (len(budgets) - len(cells))
            name = f"{entry.method}, {charge} walks before" if charge else entry.method
            rows.append([entry.start, name, *blank, *cells])
    return markdown_table(["start", "method", *map(str, budgets)], rows)


if __name__ == "__main__":
    sys.exit(exit_code("race", main))
