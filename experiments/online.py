"""Does tuning while walking help on a plant that changes under the robot?

A payload is put on the trunk in the middle of a walk. Weights that stay are compared with weights
that take a step of DiffTune after every window of measured states (`adaptation`), on the hfs
and plants around it, from several start weights; and with weights that are tuned until the change
only. What tuning all the way has over these is adapting to the payload and, not told apart from it,
the ordinary tuning that goes on after the change. Other ways to the gradient are walked beside:
sensitivities begun anew in each window, the model's own walk from the window's first state, and the
plain rigid body in the place of GRFM-Net.

    python experiments/online.py --sets nominal expert tuned \
        --tuned straight runs/.../weights/with.json c ... s ...

Walks are kept under OUT/walks and taken up again. `--standin` adds plants of the hardware stand-in,
for a verdict; nothing here was chosen by them.
"""

import itertools
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import plots
import tyro
from adaptation import OnlineConfig, retuner
from changes import Change, walk_with_changes
from lib import check_names, write_report
from plots import ARMS

from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import Weights, expert, nominal, weight_names, weights_to_vector
from hector_jax.control.weights_file import load_weights
from hector_jax.core.console import bar, exit_code
from hector_jax.core.files import make_folder
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, SEED, convert
from hector_jax.core.trajectory import Trajectory
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.network import as_effect
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.standin import standin
from hector_jax.sim.world import Imperfections, named_world
from hector_jax.store import nets
from hector_jax.store.cache import content_key, load_or_make
from hector_jax.tuning.difftune import Iteration, TuneConfig
from hector_jax.tuning.loss import PAPER_LOSS, losses, total

# modules of the package that decide the numbers
CODE = ("tuning.difftune", "tuning.grounded", "grfm.network", "sim.walk")
SETS = ("nominal", "expert", "tuned")
WINDOW = 0.4  # [s] of the losses along a walk


@dataclass(frozen=True)
class Flags:
    """What to walk."""

    data: Path = Path("data")  # walks and net; made where missing
    out: Path = Path("runs/online")  # folder of the report
    tuned: dict[str, Path] = field(default_factory=dict)  # TRAJ FILE of tuned start weights
    trajectories: tuple[str, ...] = COMMANDS
    sets: tuple[str, ...] = ("nominal", "expert")  # start weights; or tuned, which needs --tuned
    arms: tuple[str, ...] = tuple(ARMS)
    varied: tuple[int, ...] = ()  # seeds of hfs-varied, beside the hfs
    standin: tuple[int, ...] = ()  # seeds of the hardware stand-in
    payload: float = 2.0  # [kg]
    change: float = 4.0  # [s] when it is put on
    seconds: float = 8.0  # length of a walk
    window: int = 40  # ticks between steps
    late: int = 20  # ticks after a window at which its step comes into force
    processes: int = 2  # one core each

    def __post_init__(self) -> None:
        check_names("arms", self.arms, ARMS)
        check_names("sets", self.sets, SETS)
        for trajectory in self.trajectories:
            named_command(trajectory)
        for name, kind, allowed in (
            ("varied", tuple[int, ...], SEED),
            ("standin", tuple[int, ...], SEED),
            ("payload", float, NOT_NEGATIVE),
            ("processes", int, AT_LEAST_ONE),
        ):
            convert(getattr(self, name), kind, allowed, f"Flags.{name}")
        OnlineConfig(window=self.window, late=self.late)
        count = round(self.seconds / WINDOW)
        if count < 2 or abs(self.seconds - count * WINDOW) > 1e-9:
            raise InputError(
                f"Flags.seconds must be a multiple of {WINDOW:g} s, two at least, "
                f"got {self.seconds:g}"
            )
        if not 0.0 < self.change < self.seconds:
            raise InputError(f"Flags.change must lie within the walk, got {self.change} s")


class Case(NamedTuple):
    """A walk."""

    plant: str
    trajectory: str
    start: str  # name of the start weights
    arm: str


class Walked(NamedTuple):
    """Results of a walk."""

    halves: np.ndarray  # (2,) L before and after the change
    parts: np.ndarray  # (2, 3) terms of L
    loss: np.ndarray  # (windows,) L of each 0.4 s
    height: np.ndarray  # (2,) [m] mean error of the centre of mass
    fallen: np.ndarray
    residual: np.ndarray  # largest relative KKT residual of a plan
    weights: np.ndarray  # (steps, 24) in use at the end of each window
    refused: np.ndarray  # (steps,)
    seconds: np.ndarray  # (steps,) [s] of processor time that a window's gradient and step took


def _loss(walk: Trajectory) -> tuple[float, np.ndarray]:
    terms = losses(PAPER_LOSS, walk)
    return float(total(PAPER_LOSS, terms)), np.array([float(terms[t.name]) for t in PAPER_LOSS])


def _cut(walk: Trajectory, first: int, end: int) -> Trajectory:
    samples = jax.tree.map(lambda x: x[first:end], walk._replace(period=None, initial=None))
    initial = walk.initial if not first else jax.tree.map(lambda x: x[first - 1], walk.state)
    return samples._replace(period=walk.period, initial=initial)


def _walk_case(
    config: OnlineConfig,
    robot: Robot,
    job: Job,
    changes: Sequence[Change],
    effect: jax.tree_util.Partial,
    moment: float,
    arm: str,
) -> Walked:
    """Walk a case of an arm; in a worker."""
    steps: list[Iteration] = []
    seconds: list[float] = []
    online = retuner(config, robot, job.weights, job.command, effect, steps.append)
    last_tick = round(moment / config.tune.rollout.walk.gait.tick)

    weights_in_use = job.weights

    def step(tick: int, *measured: Any) -> Weights:
        nonlocal weights_in_use
        if arm == "until" and tick >= last_tick:
            return weights_in_use
        count, start = len(steps), time.process_time()
        weights_in_use = online(tick, *measured)
        if len(steps) > count:
            seconds.append(time.process_time() - start)
        return weights_in_use

    retune = None if arm == "fixed" else step
    trajectory = walk_with_changes(config.tune.rollout.walk, robot, job, changes, retune=retune)
    middle, end = round(1e3 * moment), len(trajectory.fallen)
    halves = [_loss(_cut(trajectory, *span)) for span in ((0, middle), (middle, end))]
    spans = [(i, i + round(1e3 * WINDOW)) for i in range(0, end, round(1e3 * WINDOW))]
    error = (trajectory.state.position - trajectory.reference.position)[:, 2]
    weights = [np.asarray(weights_to_vector(s.weights)) for s in steps]
    return Walked(
        halves=np.array([loss for loss, _ in halves]),
        parts=np.stack([parts for _, parts in halves]),
        loss=np.array([_loss(_cut(trajectory, *span))[0] for span in spans]),
        height=np.array([error[:middle].mean(), error[middle:].mean()]),
        fallen=np.asarray(trajectory.fallen.any()),
        residual=np.asarray(trajectory.residual.max()),
        weights=np.array(weights).reshape(-1, len(weight_names())),
        refused=np.array([not s.accepted for s in steps], bool),
        seconds=np.array(seconds),
    )


def plants(flags: Flags) -> dict[str, tuple[Imperfections, int]]:
    """Return the plants by name, and the seeds of their estimators."""
    varied = {f"hfs-varied {seed}": (named_world("hfs-varied", seed), 0) for seed in flags.varied}
    standins = {f"stand-in {seed}": (standin(seed), seed) for seed in flags.standin}
    return {"hfs": (named_world("hfs"), 0), **varied, **standins}


def start_weights(flags: Flags, trajectory: str, name: str) -> Weights:
    """Return start weights by name.

    Raises:
        InputError: no file of the tuned weights.
    """
    if name != "tuned":
        return {"nominal": nominal, "expert": expert}[name]()
    if trajectory not in flags.tuned:
        raise InputError(f"--tuned: no weights file for {trajectory}, which --sets asks for")
    return load_weights(flags.tuned[trajectory])


def walk_cases(
    pool: Executor,
    flags: Flags,
    robot: Robot,
    effects: Mapping[str, jax.tree_util.Partial],
    starts: Mapping[tuple[str, str], Weights],
) -> dict[Case, Walked]:
    """Walk from start weights by trajectory and set; walks that are on disk are read."""
    default = OnlineConfig(window=flags.window, late=flags.late)
    changes = (Change(start=flags.change, payload=flags.payload),)
    host = partial(jax.tree.map, np.asarray)
    by_name = plants(flags)
    inputs: dict[Case, tuple] = {}
    for case in itertools.starmap(
        Case, itertools.product(by_name, flags.trajectories, flags.sets, flags.arms)
    ):
        imperfections, seed = by_name[case.plant]
        weights = host(starts[case.trajectory, case.start])
        walked = weights, host(named_command(case.trajectory)), host(imperfections)
        job = Job(*walked, flags.seconds, seed)
        estimator = case.arm if case.arm in ("cut", "model") else "carried"
        config = replace(default, estimator=estimator)
        effect = effects["command" if case.arm == "plain" else "net"]
        inputs[case] = config, robot, job, changes, effect, flags.change, case.arm

    def path(case: Case) -> Path:
        config, _, job, changes, effect, moment, arm = inputs[case]
        name = "-".join(case).replace(" ", "")
        own = function_id(_walk_case)
        ending = content_key(config, robot, job, changes, (effect,), moment, arm, own, code=CODE)
        return flags.out / "walks" / f"{name}-{ending}.npz"

    def make(missing: Sequence[Case], _: Mapping[Case, Walked]) -> Iterator[tuple[Case, Walked]]:
        running = {case: pool.submit(_walk_case, *inputs[case]) for case in missing}
        with bar("walks on plants that change") as report_progress:
            for done, (case, future) in enumerate(running.items(), 1):
                yield case, future.result()
                report_progress(done, len(running), " ".join(case))

    like = Walked(*(np.zeros((0,) * n) for n in (1, 2, 1, 1, 0, 0, 2, 1, 1)))
    paths = {case: path(case) for case in inputs}
    return load_or_make(paths, make, like=lambda _: like, kind="online", robot=robot)


def main() -> None:
    """Write report.md, online.json and the pictures."""
    flags = tyro.cli(Flags)
    setup_jax()
    starts = {(t, s): start_weights(flags, t, s) for t in flags.trajectories for s in flags.sets}
    robot = jax.tree.map(np.asarray, load_robot())
    make_folder(flags.out)
    with workers(flags.processes) as pool:
        net = nets.load_or_train(pool, robot, flags.data)
        effects = {"command": last_command, "net": as_effect(net.params)}
        effects = {name: jax.tree.map(np.asarray, effect) for name, effect in effects.items()}
        walks = walk_cases(pool, flags, robot, effects, starts)
    print(report(flags, walks))


SPANS: dict[str, Callable[[Walked], float]] = {
    "before": lambda row: row.halves[0],
    "after": lambda row: row.halves[1],
    "end": lambda row: row.loss[-2:].sum(),
}


def _changes(
    walks: Mapping[Case, Walked], cases: Sequence[Case], span: str, against: str
) -> np.ndarray:
    """Return the change of L [%] over a span, against the same walks by another arm."""
    loss = SPANS[span]
    pairs = ((walks[case], walks[case._replace(arm=against)]) for case in cases)
    return np.array([100 * (loss(row) / loss(other) - 1) for row, other in pairs])


def _median(values: np.ndarray) -> str:
    if len(values) == 1:
        return f"{values[0]:+.1f}"
    return f"{np.median(values):+.1f} [{values.min():+.1f}, {values.max():+.1f}]"


def table(flags: Flags, walks: Mapping[Case, Walked]) -> str:
    """Return a table of L before and after the change by trajectory, start weights and arm."""
    names = list(plants(flags))
    head = ("trajectory", "start", "arm", "L before, 1e6", "L after, 1e6")
    head += ("before, % against fixed", "after, % against fixed", "z after, cm", "falls", "refused")
    lines = []
    for group in itertools.product(flags.trajectories, flags.sets, flags.arms):
        cases = [Case(plant, *group) for plant in names]
        rows = [walks[case] for case in cases]
        halves = np.median([row.halves for row in rows], axis=0) / 1e6
        change = [
            _median(_changes(walks, cases, span, "fixed"))
            if group[-1] != "fixed" and "fixed" in flags.arms
            else ""
            for span in ("before", "after")
        ]
        height = 100.0 * np.median([row.height[1] for row in rows])
        falls = sum(bool(row.fallen) for row in rows)
        refused = sum(int(row.refused.sum()) for row in rows)
        line = [*group, *(f"{half:.2f}" for half in halves), *change]
        lines.append([*line, f"{height:+.1f}", f"{falls} of {len(rows)}", str(refused)])
    return markdown_table(head, lines, words=3)


def _spread(values: np.ndarray) -> str:
    return (
        f"{np.median(values):+.1f} % ({values.min():+.1f} to {values.max():+.1f}), "
        f"lower in {int((values < 0).sum())} of {len(values)}"
    )


def verdicts(flags: Flags, walks: Mapping[Case, Walked]) -> list[str]:
    """Describe the result of each arm after the change, over all walks, in a sentence."""
    sentences = []
    for arm in flags.arms:
        if arm == "fixed" or "fixed" not in flags.arms:
            continue
        cases = [case for case in walks if case.arm == arm]
        after, end = (_changes(walks, cases, span, "fixed") for span in ("after", "end"))
        text = (
            f"- `{arm}`, against weights that stay: L after the change {_spread(after)}; "
            f"of the last {2 * WINDOW:g} s {_spread(end)}"
        )
        if arm != "until" and "until" in flags.arms:
            stopped = _changes(walks, cases, "after", "until")
            text += (
                f". Against tuning until the change: {_spread(stopped)}; that is adapting to the "
                f"payload and {flags.seconds - flags.change:g} s more of ordinary tuning"
            )
        sentences.append(text + ".")
    return sentences


def report(flags: Flags, walks: Mapping[Case, Walked]) -> Path:
    """Write the report with its pictures and its numbers as JSON.

    Args:
        flags: the flags.
        walks: the walks.
    """
    names = list(plants(flags))
    seconds = np.concatenate([row.seconds for row in walks.values()] or [np.zeros(0)])
    times = 1e3 * seconds
    window = flags.window * TuneConfig().rollout.walk.gait.tick
    counts = {"plant": len(names), "trajectory": len(flags.trajectories), "start": len(flags.sets)}
    plural = {"plant": "plants", "trajectory": "trajectories", "start": "starts"}
    crossed = " x ".join(f"{n} {name if n == 1 else plural[name]}" for name, n in counts.items())
    residual = max((float(row.residual) for row in walks.values()), default=0.0)
    text = [
        f"A payload of {flags.payload:g} kg is put on the trunk {flags.change:g} s into walks of "
        f"{flags.seconds:g} s, on {', '.join(names)}. The weights take a Gauss-Newton step of at "
        f"most {OnlineConfig.radius:g} e-folds every {window:g} s, in force {10 * flags.late} ms "
        "after the window that it was computed from. Worst relative KKT residual of a plan: "
        f"{residual:.0e}.",
        "\n".join(f"- `{arm}`: {ARMS[arm]}" for arm in flags.arms),
        "## What came out",
        "Changes of L in %, median over the walks and, in brackets, the least and the largest. "
        f"The {math.prod(counts.values())} walks of an arm are {crossed}, not independent of each "
        "other:",
        "\n".join(verdicts(flags, walks)),
        f"A gradient over {window:g} s of walking with its step took {np.median(times):.0f} "
        f"ms of processor time in the median, {np.percentile(times, 5):.0f} to "
        f"{np.percentile(times, 95):.0f} ms from the 5th to the 95th percentile; the first "
        "of a process is compiled."
        if len(seconds)
        else "No arm was tuned.",
        "Before is the walk until the change and after the rest; where there are several plants, "
        "medians over them, and in brackets the least and the largest.",
        table(flags, walks),
        "## Pictures",
    ]
    numbers = {
        "flags": {k: v for k, v in vars(flags).items() if k not in ("data", "out", "tuned")},
        "weights": weight_names(),
        "residual": residual,
        "walks": {
            " / ".join(case): {name: value.tolist() for name, value in row._asdict().items()}
            for case, row in walks.items()
        },
        "seconds": {"median": float(np.median(seconds)), "least": float(seconds.min())}
        if len(seconds)
        else None,
    }
    return write_report(
        flags.out / "report.md",
        "Does tuning while walking help when the plant changes?",
        text,
        numbers=numbers,
        json_name="online.json",
        pictures=_draw(flags, walks, names, window),
    )


def _draw(
    flags: Flags, walks: Mapping[Case, Walked], names: Sequence[str], window: float
) -> dict[str, str]:
    """Draw the pictures; returns their captions by name."""
    times = WINDOW * (np.arange(round(flags.seconds / WINDOW)) + 0.5)
    arms = [arm for arm in plots.ARM_LINES if arm in flags.arms]
    curves = {
        group: {arm: np.stack([walks[Case(p, *group, arm)].loss for p in names]) for arm in arms}
        for group in itertools.product(flags.trajectories, flags.sets)
    }
    caption = plots.while_walking(flags.out / "loss.png", flags.change, times, curves)
    captions = {"loss.png": caption}
    for start in flags.sets if "carried" in flags.arms else ():
        rows = {t: walks[Case(names[0], t, start, "carried")].weights for t in flags.trajectories}
        histories = {t: weights / weights[0] for t, weights in rows.items() if len(weights)}
        if not histories:  # no window ended within a walk
            continue
        ends = window * np.arange(1, 1 + max(map(len, histories.values())))
        file = f"weights-{start}.png"
        caption = plots.weight_histories(
            flags.out / file, flags.change, ends, weight_names(), histories
        )
        captions[file] = f"Start: {start}, plant {names[0]}. {caption}"
    return captions


if __name__ == "__main__":
    sys.exit(exit_code("online", main))
