"""What batches of tunings are good for; one sub-command per question, each writes a report.

    python experiments/batch.py front      what smoothness costs in tracking
    python experiments/batch.py starts     how much the start matters

Tuned is on the rigid body, through a GRFM-Net where --net names one, on all devices there are
(every CPU core is one). Judged is by a walk on the high-fidelity simulator.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import plots
import tyro
from lib import all_devices, sample_weights, write_report

from hector_jax.control.reference import Command, named_command, standing_anchor
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.core.console import bar, exit_code
from hector_jax.core.files import make_folder
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, Range, check
from hector_jax.core.tree import stack
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.network import as_effect, load_net
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.world import hfs
from hector_jax.store.setup import Setup
from hector_jax.tuning.batch import BatchProblem, BatchScenario, tune_batch
from hector_jax.tuning.difftune import TuneConfig, Tuning, single
from hector_jax.tuning.loss import PAPER_LOSS, Terms, with_alphas
from hector_jax.tuning.status import Stop
from hector_jax.verdict import judging
from hector_jax.verdict.metrics import Score


@dataclass(frozen=True)
class Flags:
    """Flags of all sub-commands that tune."""

    net: Path | None = None  # GRFM-Net to tune through; none: the plain rigid body
    iterations: Annotated[int, AT_LEAST_ONE] = 10  # at most
    processes: Annotated[int, AT_LEAST_ONE] = 2  # that walk in MuJoCo, one core each

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Front(Flags):
    """Loss weights of tracking over decades."""

    out: Path = Path("runs/batch/front")  # folder of the report
    traj: str = "straight"
    points: Annotated[int, Range(2)] = 9
    decades: Annotated[float, POSITIVE] = 2.0  # to either side of the paper's weights


@dataclass(frozen=True)
class Starts(Flags):
    """Starts drawn log-uniformly about nominal."""

    out: Path = Path("runs/batch/starts")  # folder of the report
    traj: str = "straight"
    starts: Annotated[int, AT_LEAST_ONE] = 32
    factor: Annotated[float, Range(1.0, above=True)] = 3.0  # within which of nominal


def tune(
    flags: Flags,
    robot: Robot,
    effects: Any,
    problems: Sequence[BatchProblem],
    title: str,
    nominal_rows: slice = slice(None),
) -> Tuning:
    """Tune problems as one batch; those of `nominal_rows` start at the nominal weights.

    Raises:
        InputError: the nominal weights are refused, so there is nothing to compare with.
    """
    config = TuneConfig(iterations=flags.iterations)
    with bar(f"{title}: {len(problems)} tunings") as progress:
        tunings = tune_batch(config, robot, stack(problems), effects, report_progress=progress)
    if np.any(np.asarray(tunings.stop)[nominal_rows] == Stop.BAD_START):
        raise InputError(
            f"{title}: the nominal weights are refused at their first walk: a fall, a plan that is "
            "not solved, or numbers that are not finite; expected weights that walk on the model"
        )
    return tunings


def whole_net(flags: Flags, robot: Robot) -> jax.tree_util.Partial:
    """Return the phi to tune through, in the form of `tune_batch`."""
    return last_command if flags.net is None else stack([as_effect(load_net(flags.net, robot)[0])])


def problem(robot: Robot, start: Weights, command: Command, tracking: float = 1.0) -> BatchProblem:
    """Return the tuning on a walk from standing, with the paper's alphas times `tracking`."""
    loss = with_alphas({t.name: tracking * t.weight for t in PAPER_LOSS[:2]})
    zero, one = np.asarray(0), np.asarray(1.0)
    walk = BatchScenario(command, standing_anchor(robot), zero, loss, one, None)
    return BatchProblem(start, stack([walk]), one)


def first_host() -> bool:
    """Return True on the host that evaluates and writes; the others of a cluster end earlier."""
    first = jax.process_index() == 0
    if jax.distributed.is_initialized():
        jax.distributed.shutdown()  # at exit it would wait for the first host until a timeout
    return first


def row_of(tree: Any, row: int) -> Any:
    """Return the results of one problem of a batch."""
    return jax.tree.map(lambda x: np.asarray(x)[row], tree)


def last_iterations(tunings: Tuning) -> np.ndarray:
    """Return the number of the last iteration of each problem, after which its history is zero."""
    return np.asarray(tunings.history.iteration).max(axis=1)


def accepted(tunings: Tuning) -> np.ndarray:
    """Return the mask (problems, iterations) of the accepted iterations."""
    mask = tunings.history.accepted
    return mask & (np.arange(mask.shape[1]) <= last_iterations(tunings)[:, None])


def final_terms(tunings: Tuning) -> Terms:
    """Return the terms of the loss on the model of each tuned set."""
    mask = accepted(tunings)
    last = np.max(np.where(mask, np.arange(mask.shape[1]), 0), axis=1)
    return jax.tree.map(lambda x: x[np.arange(len(last)), last], tunings.history.evaluation.terms)


def end_of(tunings: Tuning, row: int) -> str:
    """Describe why a tuning ended, and when."""
    tuning = single(jax.tree.map(lambda x: x[row], tunings))
    return f"{tuning.reason} (after {len(tuning.iterations) - 1})"


def scores_on_hfs(
    flags: Flags, robot: Robot, sets: Mapping[str, Weights], command: Command
) -> dict[str, Score]:
    """Return the score of each weight set on the high-fidelity simulator."""
    with workers(flags.processes) as pool:
        setup = Setup(pool, TuneConfig(), robot)
        judged = judging.judge(setup, sets, {"": command}, [hfs()], [0], title="on the hfs")
    return {name: judged.walks["", name, 0].score for name in sets}


def million(x: Any) -> str:
    """Format a loss in 1e6."""
    return f"{float(x) / 1e6:.3f}"


def write(
    flags: Flags,
    sets: Mapping[str, Weights],
    numbers: Mapping[str, Any],
    paragraphs: Sequence[str],
    picture: tuple[str, str],
) -> None:
    """Write weights, numbers and report; the first paragraph is the title."""
    out = flags.out  # pyright: ignore
    make_folder(out / "weights")
    for name, weights in sets.items():
        save_weights(out / "weights" / f"{name.replace(' ', '-')}.json", weights)
    settings = {name: str(x) if isinstance(x, Path) else x for name, x in vars(flags).items()}
    model = f"through {flags.net.name}" if flags.net else "on the plain rigid body"
    about = f"Tuned {model}, at most {flags.iterations} iterations. Losses in 1e6."
    title, *rest = paragraphs
    write_report(
        out / "report.md",
        title,
        [about, *rest],
        numbers={"flags": settings, **numbers},
        json_name="result.json",
        pictures=dict([picture]),
    )
    print(out / "report.md")


def front(flags: Front) -> None:
    """Trade tracking against smoothness (question c)."""
    robot, command = load_robot(), named_command(flags.traj)
    prices = 10.0 ** np.linspace(-flags.decades, flags.decades, flags.points)
    problems = [problem(robot, nominal(), command, tracking) for tracking in prices]
    tunings = tune(flags, robot, whole_net(flags, robot), problems, "prices of tracking")
    if not first_host():
        return
    sets = {f"tracking x{p:.3g}": row_of(tunings.weights, i) for i, p in enumerate(prices)}
    all_sets = {"nominal": nominal(), "expert": expert(), **sets}
    scores = scores_on_hfs(flags, robot, all_sets, command)

    def tracking(terms: Mapping[str, Any]) -> Any:
        return sum(term.weight * terms[term.name] for term in PAPER_LOSS[:2])

    terms = final_terms(tunings)
    model = np.stack([tracking(terms), terms["L_ctrl"]], axis=1)
    on_hfs = {n: (float(tracking(s.losses)), float(s.losses["L_ctrl"])) for n, s in scores.items()}
    rows = []
    for name, losses in on_hfs.items():
        cells, end = ["", ""], ""
        if name in sets:
            i = list(sets).index(name)
            cells, end = [*map(million, model[i])], end_of(tunings, i)
        fell = "yes" if scores[name].fallen else "no"
        rows.append([name, *cells, *map(million, losses), fell, end])
    make_folder(flags.out)
    caption = plots.front(
        flags.out / "front.png",
        prices,
        {"rigid body": model, "hfs": np.array([on_hfs[n] for n in sets])},
        {n: on_hfs[n] for n in ("nominal", "expert")},
    )
    head = ["set", *(f"{x}, {world}" for world in ("model", "hfs") for x in ("tracking", "L_ctrl"))]
    text = [
        f"Tracking against smoothness: {flags.traj}",
        "Both alphas are multiplied by one price; tracking is alpha_1 L_Eul + alpha_2 L_pos with "
        "the paper's alphas, whatever the price.",
        markdown_table([*head, "fell", "end"], rows),
    ]
    numbers = {"prices": prices.tolist(), "model": model.tolist(), "hfs": on_hfs}
    write(flags, sets, numbers, text, ("front.png", caption))


def starts(flags: Starts) -> None:
    """Tune from many starts (question d)."""
    robot, command = load_robot(), named_command(flags.traj)
    initial = [nominal(), *sample_weights(nominal(), flags.factor, flags.starts - 1)]
    problems = [problem(robot, weights, command) for weights in initial]
    tunings = tune(flags, robot, whole_net(flags, robot), problems, "starts", slice(1))
    if not first_host():
        return
    usable = np.asarray(tunings.stop) != Stop.BAD_START
    losses = tunings.history.evaluation.loss
    first, last = losses[usable, 0], tunings.loss[usable]
    curves = np.where(accepted(tunings), losses, np.nan)[usable]
    rows = [
        [f"at the {end}", *map(million, np.quantile(x, (0, 0.25, 0.5, 0.75, 1)))]
        for end, x in (("start", first), ("end", last))
    ]
    best = np.flatnonzero(usable)[np.argsort(last)[:3]]
    sets = {"from nominal": row_of(tunings.weights, 0)}
    sets |= {f"best {i + 1}": row_of(tunings.weights, row) for i, row in enumerate(best)}
    scores = scores_on_hfs(flags, robot, sets, command)
    make_folder(flags.out)
    caption = plots.starts(flags.out / "starts.png", curves)
    text = [
        f"How much the start matters: {flags.traj}",
        f"{flags.starts} starts, the first at nominal, the others log-uniform within "
        f"x/{flags.factor:g} of it; {int((~usable).sum())} are refused at their "
        "first walk: a fall, a plan that is not solved, or numbers that are not finite.",
        markdown_table(["L on the model", "least", "25 %", "median", "75 %", "most"], rows),
        f"From nominal: {million(last[0])}, {int(np.sum(last < last[0]))} of the others end lower.",
        markdown_table(
            ["set", "L on the hfs", "fell"],
            [[n, million(s.L), "yes" if s.fallen else "no"] for n, s in scores.items()],
        ),
    ]
    numbers = {"first": first.tolist(), "last": last.tolist(), "refused": int((~usable).sum())}
    on_hfs = {name: {"L": float(s.L), "fallen": bool(s.fallen)} for name, s in scores.items()}
    write(flags, sets, numbers | {"hfs": on_hfs}, text, ("starts.png", caption))


def main() -> None:
    """Run a sub-command."""
    commands = {Front: front, Starts: starts}
    flags = tyro.extras.subcommand_cli_from_dict(
        {kind.__name__.lower(): kind for kind in commands}, description=__doc__
    )
    setup_jax()
    all_devices()
    commands[type(flags)](flags)


if __name__ == "__main__":
    sys.exit(exit_code("batch", main))
