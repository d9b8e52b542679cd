"""Is a tuning on walks ahead of what sees one number of each walk? The race.

`tune_on_walks` against the optimizers of `rivals.py`, on one trajectory of the high-fidelity
simulator, from nominal; the walk of the start is the first of each. That simulator has no chance in
it: the tuner runs once, the rivals, which draw, with several seeds. They search steps of the
log-weights within 3 of the start. What the tuner has found walks on drawn plants at the end,
because a low loss on one plant is partly fitted to it.

    python experiments/race.py --traj s

The walks of the tuner and the rivals that have ended are kept in OUT.
"""

from collections.abc import Iterator
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import jax
import lib
import numpy as np
import plots
from jaxtyping import Float
from rivals import RIVALS, Task, search

from hector_jax.control.parameters import step_bounds, weights_after
from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.arrays import Array
from hector_jax.core.console import bar
from hector_jax.core.files import make_folder
from hector_jax.core.identity import function_id
from hector_jax.core.pool import workers
from hector_jax.core.settings import AT_LEAST_ONE, SEED, Range, check
from hector_jax.grfm.network import effect_of
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import load_robot
from hector_jax.sim.engine import choose_engine
from hector_jax.sim.world import hfs, named_world
from hector_jax.store import tunings
from hector_jax.store.cache import content_key, load_or_make
from hector_jax.store.setup import Setup
from hector_jax.tuning.loss import Loss, loss_of
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout
from hector_jax.verdict import judging, metrics
from hector_jax.walk_tuning import best_set
from hector_jax.walk_tuning.campaign import Campaign
from hector_jax.walk_tuning.walks import tune_on_walks, walk_case

BUDGETS = (1, 2, 5, 10, 25)
TUNER = "tuner"
SPREAD, NEAR = 1.0, 3.0  # of rivals, in log-weights: first standard deviation, and their box


@dataclass(frozen=True, kw_only=True)
class Flags(lib.Flags):
    """What to race."""

    traj: str = "s"
    rivals: tuple[str, ...] = tuple(RIVALS)
    walks: Annotated[int, Range(2)] = BUDGETS[-1]  # of each contest
    repeats: Annotated[int, AT_LEAST_ONE] = 8  # seeds of each rival
    plants: Annotated[int, AT_LEAST_ONE] = 16  # of hfs-varied, that judge the set of the tuner
    first_plant: Annotated[int, SEED] = 300
    engine: str = "c"  # what walks, one of `hector walk --engine` but mjx
    robot: Path | None = None  # TOML file of another robot; HECTOR by default
    out: Path = Path("runs/race")  # folder of the report

    def __post_init__(self) -> None:
        check(self, rivals=tuple(RIVALS), engine=("c", "drake", "pinocchio"))


Contest = tuple[str, int]
"""A rival and its seed."""


def contest_job(
    campaign: Campaign, contest: Contest, at_start: float, budget: int
) -> Float[np.ndarray, " walks"]:
    """Run a rival; return L of its walks, that of the start first, infinite where one fell.

    The rest is NaN if it has converged before the budget was spent.
    """
    config, robot, ((_, command),) = campaign.config, campaign.robot, campaign.cases
    effect = effect_of(None, config.rollout.walk)
    scenario = Scenario(robot, command, standing_anchor(robot), effect)
    on_model = partial(_model_loss, config.rollout, scenario, config.loss)
    losses, model_start = [at_start], on_model(campaign.start)

    def weights_at(steps: Float[np.ndarray, " n"]) -> Weights:
        return jax.device_get(weights_after(campaign.start, steps))

    def walk(steps: Float[np.ndarray, " n"]) -> float:
        losses.append(walk_case(campaign, weights_at(steps), 0).loss)
        return float(np.log(losses[-1] / at_start))

    def model(steps: Float[np.ndarray, " n"]) -> float:
        return float(np.log(on_model(weights_at(steps)) / model_start))

    box = np.clip(np.stack(step_bounds(campaign.start), axis=1), -NEAR, NEAR)
    name, seed = contest
    search(RIVALS[name], Task(walk, model, box, SPREAD, seed), budget)
    return np.array([*losses, *[np.nan] * (budget - len(losses))])


@partial(jax.jit, static_argnums=0)
def _model_loss(config: RolloutConfig, scenario: Scenario, loss: Loss, weights: Weights) -> Array:
    return loss_of(loss, rollout(config, scenario, weights))


def race(setup: Setup, campaign: Campaign, flags: Flags) -> tuple[Weights, dict[str, np.ndarray]]:
    """Tune, and run the rivals; return the set of the tuner, and L by contestant, seed and walk."""
    tuning = tune_on_walks(setup.pool, campaign, walks=flags.walks)
    own = np.full((1, flags.walks), np.nan)
    own[0, : len(tuning.sets)] = [walked.losses[0] for walked in tuning.sets]
    inputs = campaign.config, campaign.robot, campaign.start, campaign.cases[0], flags.walks
    code = "walk_tuning.walks", *campaign.engine.modules
    key = partial(content_key, *inputs, campaign.engine.key, SPREAD, NEAR, code=code)
    paths = {
        (name, seed): flags.out / "contests" / f"{name}-{seed}-{key(function_id(RIVALS[name]))}.npz"
        for name, seed in product(flags.rivals, range(flags.repeats))
    }

    def run(missing: list[Contest], _: Any) -> Iterator[tuple[Contest, np.ndarray]]:
        job = partial(contest_job, campaign, at_start=float(own[0, 0]), budget=flags.walks)
        running = {setup.pool.submit(job, contest): contest for contest in missing}
        with bar("racing") as report_progress:
            for done, future in enumerate(as_completed(running), 1):
                yield running[future], future.result()
                report_progress(done, len(missing), running[future][0])

    like, robot = np.zeros(flags.walks), campaign.robot
    found = load_or_make(paths, run, like=lambda _: like, kind="contest", robot=robot)
    rivals = {
        name: np.stack([found[name, seed] for seed in range(flags.repeats)])
        for name in flags.rivals
    }
    return tuning.sets[tuning.best].weights, {TUNER: own, **rivals}


def judge(
    setup: Setup, campaign: Campaign, weights: Weights, flags: Flags
) -> tuple[str, dict[str, list[float]]]:
    """Walk the set of the tuner on other plants; return the change against nominal, and each L."""
    seeds = range(flags.first_plant, flags.first_plant + flags.plants)
    plants = [named_world("hfs-varied", seed, setup.robot.description) for seed in seeds]
    sets = {"nominal": nominal(setup.robot), TUNER: weights}
    options = {"folder": flags.out, "engine": campaign.engine}
    inputs = setup, sets, campaign.commands, plants, seeds
    verdict = judging.judge(*inputs, title="judging the tuner", **options).verdict
    falls = {name: int(score.fallen.sum()) for name, score in verdict.scores.items()}
    change = metrics.compare(verdict, TUNER, "nominal").change["L"].text()
    text = (
        f"On {flags.plants} other plants (hfs-varied from {flags.first_plant} on) the set of the "
        f"tuner has an L of {change} % against nominal, median with 95 % interval; it fell "
        f"{falls[TUNER]} times, nominal {falls['nominal']}."
    )
    return text, {name: score.L[:, 0].tolist() for name, score in verdict.scores.items()}


def entry(losses: Float[np.ndarray, "seeds walks"]) -> dict[str, Any]:
    """Return L of the best set so far by budget and seed, and the falls by seed."""
    best, budgets = np.fmin.accumulate(losses, axis=1), [n for n in BUDGETS if n <= losses.shape[1]]
    falls = np.isinf(losses).sum(axis=1)
    return {"own": {n: best[:, n - 1].tolist() for n in budgets}, "falls": falls.tolist()}


def main(flags: Flags) -> Path:
    """Race, judge the set of the tuner, and write report.md, race.json and the picture."""
    robot, engine = jax.tree.map(np.asarray, load_robot(flags.robot)), choose_engine(flags.engine)
    config, command = best_set.on_walks(tunings.tune_config(robot)), named_command(flags.traj)
    folder = flags.out / TUNER
    make_folder(folder)
    inputs = folder, config, robot, nominal(robot), {flags.traj: command}, [hfs(robot.description)]
    campaign = Campaign(*inputs, engine=engine)
    with workers(flags.processes) as pool:
        setup = Setup(pool, config, robot)
        weights, losses = race(setup, campaign, flags)
        on_others, others = judge(setup, campaign, weights, flags)
    entries = {name: entry(each) for name, each in losses.items()}
    own = {name: each["own"] for name, each in entries.items()}
    intro = (
        f"{flags.traj} from nominal, engine {engine.title}. L of the best "
        "set so far on the simulator's own plant after some walks, mean over the seeds [1e6], and "
        "the mean number of falls."
    )
    rows = []
    for name, each in entries.items():
        means = [f"{np.mean(best) / 1e6:.3f}" for best in each["own"].values()]
        rows.append([name, str(len(each["falls"])), *means, f"{np.mean(each['falls']):.1f}"])
    table = markdown_table(["method", "seeds", *map(str, own[TUNER]), "falls"], rows)
    numbers = {
        "flags": {name: str(value) for name, value in asdict(flags).items()},
        flags.traj: entries,
        "others": others,
    }
    picture, text = f"{flags.traj}.png", [intro, table, on_others]
    pictures = {picture: plots.race(flags.out / picture, own)}
    title = f"The race: {flags.out.name}"
    return lib.write_report(flags.out / "race.json", title, text, numbers, pictures)


if __name__ == "__main__":
    lib.run(main, Flags)
