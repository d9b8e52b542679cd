"""What batches of tunings are good for; one sub-command per question, each writes a report.

    python experiments/batch.py front      what smoothness costs in tracking
    python experiments/batch.py starts     how much the start matters

Tuned is on the rigid body, through a GRFM-Net where --net names one, on all devices there are
(every CPU core is one). Judged is by a walk on the high-fidelity simulator.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import lib
import numpy as np
import plots

from hector_jax.control.reference import Command, named_command, standing_anchor
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.core.console import bar
from hector_jax.core.files import make_folder
from hector_jax.core.inputs import InputError
from hector_jax.core.pool import workers
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, Range
from hector_jax.core.tree import stack
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.network import as_effect, load_net
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.world import hfs
from hector_jax.store.setup import Setup
from hector_jax.tuning.batch import BatchProblem, BatchScenario, tune_batch
from hector_jax.tuning.difftune import TuneConfig, Tuning, single
from hector_jax.tuning.loss import PAPER_LOSS, with_alphas
from hector_jax.tuning.status import Stop
from hector_jax.verdict import judging
from hector_jax.verdict.metrics import Score


@dataclass(frozen=True, kw_only=True)
class Flags(lib.Flags):
    """Flags of all sub-commands."""

    net: Path | None = None  # GRFM-Net to tune through; none: the plain rigid body
    iterations: Annotated[int, AT_LEAST_ONE] = 10  # at most
    traj: str = "straight"


@dataclass(frozen=True, kw_only=True)
class Front(Flags):
    """Loss weights of tracking over decades."""

    out: Path = Path("runs/batch/front")  # folder of the report
    points: Annotated[int, Range(2)] = 9
    decades: Annotated[float, POSITIVE] = 2.0  # to either side of the paper's weights


@dataclass(frozen=True, kw_only=True)
class Starts(Flags):
    """Starts drawn log-uniformly about nominal."""

    out: Path = Path("runs/batch/starts")  # folder of the report
    starts: Annotated[int, AT_LEAST_ONE] = 32
    factor: Annotated[float, Range(1.0, above=True)] = 3.0  # within which of nominal


def tune(flags: Flags, problems: Sequence[BatchProblem], title: str) -> list[Tuning]:
    """Tune problems as one batch, the first from nominal; return those that could be started.

    Raises:
        InputError: the nominal weights are refused, so there is nothing to compare with.
    """
    config, robot, effects = TuneConfig(iterations=flags.iterations), load_robot(), last_command
    if flags.net is not None:
        effects = stack([as_effect(load_net(flags.net, robot)[0])])
    with bar(f"{title}: {len(problems)} tunings") as progress:
        tunings = tune_batch(config, robot, stack(problems), effects, report_progress=progress)
    usable = np.asarray(tunings.stop) != Stop.BAD_START
    if not usable[0]:
        raise InputError(
            f"{title}: the nominal weights are refused at their first walk: a fall, a plan that is "
            "not solved, or numbers that are not finite; expected weights that walk on the model"
        )
    row_of = lambda i: jax.tree.map(lambda x: np.asarray(x)[i], tunings)  # noqa: E731
    return [single(row_of(i)) for i in np.flatnonzero(usable)]


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


def scores_on_hfs(flags: Flags, sets: Mapping[str, Weights]) -> dict[str, Score]:
    """Return the score of each weight set on the high-fidelity simulator."""
    commands = {flags.traj: named_command(flags.traj)}
    with workers(flags.processes) as pool:
        setup = Setup(pool, TuneConfig(), load_robot())
        judged = judging.judge(setup, sets, commands, [hfs()], [0], title="on the hfs")
    return {name: walk.score for (_, name, _), walk in judged.walks.items()}


def million(x: Any) -> str:
    """Format a loss in 1e6."""
    return f"{float(x) / 1e6:.3f}"


def write(
    flags: Flags,
    sets: Mapping[str, Weights],
    numbers: Mapping[str, Any],
    paragraphs: Sequence[str],
    picture: tuple[str, str],
) -> Path:
    """Write weights, numbers and report; the first paragraph is the title."""
    make_folder(flags.out / "weights")
    for name, weights in sets.items():
        save_weights(flags.out / "weights" / f"{name.replace(' ', '-')}.json", weights)
    settings = {name: str(x) if isinstance(x, Path) else x for name, x in vars(flags).items()}
    model = f"through {flags.net.name}" if flags.net else "on the plain rigid body"
    about = f"Tuned {model}, at most {flags.iterations} iterations. Losses in 1e6."
    title, *rest = paragraphs
    return lib.write_report(
        flags.out / "result.json",
        title,
        [about, *rest],
        {"flags": settings, **numbers},
        dict([picture]),
    )


def front(flags: Front) -> Path | None:
    """Trade tracking against smoothness (question c)."""
    robot, command = load_robot(), named_command(flags.traj)
    prices = 10.0 ** np.linspace(-flags.decades, flags.decades, flags.points)
    problems = [problem(robot, nominal(), command, tracking) for tracking in prices]
    tuned = dict(zip(prices, tune(flags, problems, "prices of tracking"), strict=True))
    if not first_host():
        return None
    sets = {f"tracking x{price:.3g}": tuning.weights for price, tuning in tuned.items()}
    all_sets = {"nominal": nominal(), "expert": expert(), **sets}
    scores = scores_on_hfs(flags, all_sets)

    def tracking(terms: Mapping[str, Any]) -> Any:
        return sum(term.weight * terms[term.name] for term in PAPER_LOSS[:2])

    accepted = [[i for i in tuning.iterations if i.accepted] for tuning in tuned.values()]
    terms = [iterations[-1].evaluation.terms for iterations in accepted]
    model = np.array([[tracking(each), each["L_ctrl"]] for each in terms])
    on_hfs = {n: (float(tracking(s.losses)), float(s.losses["L_ctrl"])) for n, s in scores.items()}
    ends = [f"{x.reason} (after {len(x.iterations) - 1})" for x in tuned.values()]
    on_model = {n: [*map(million, row)] for n, row in zip(sets, model, strict=True)}
    told, rows = dict(zip(sets, ends, strict=True)), []
    for name, losses in on_hfs.items():
        fell = "yes" if scores[name].fallen else "no"
        cells = *on_model.get(name, ["", ""]), *map(million, losses)
        rows.append([name, *cells, fell, told.get(name, "")])
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
    return write(flags, sets, numbers, text, ("front.png", caption))


def starts(flags: Starts) -> Path | None:
    """Tune from many starts (question d)."""
    robot, command = load_robot(), named_command(flags.traj)
    initial = [nominal(), *lib.sample_weights(nominal(), flags.factor, flags.starts - 1)]
    problems = [problem(robot, weights, command) for weights in initial]
    tuned = tune(flags, problems, "starts")
    if not first_host():
        return None
    histories, refused = [tuning.history for tuning in tuned], flags.starts - len(tuned)
    curves = [np.where(h.accepted, h.evaluation.loss, np.nan) for h in histories]
    first, last = np.array([(t.history.evaluation.loss[0], t.loss) for t in tuned]).T
    rows = [
        [f"at the {end}", *map(million, np.quantile(x, (0, 0.25, 0.5, 0.75, 1)))]
        for end, x in (("start", first), ("end", last))
    ]
    sets = {"from nominal": tuned[0].weights}
    sets |= {f"best {i + 1}": tuned[row].weights for i, row in enumerate(np.argsort(last)[:3])}
    scores = scores_on_hfs(flags, sets)
    caption = plots.starts(flags.out / "starts.png", curves)
    text = [
        f"How much the start matters: {flags.traj}",
        f"{flags.starts} starts, the first at nominal, the others log-uniform within "
        f"x/{flags.factor:g} of it; {refused} are refused at their "
        "first walk: a fall, a plan that is not solved, or numbers that are not finite.",
        markdown_table(["L on the model", "least", "25 %", "median", "75 %", "most"], rows),
        f"From nominal: {million(last[0])}, {int(np.sum(last < last[0]))} of the others end lower.",
        markdown_table(
            ["set", "L on the hfs", "fell"],
            [[n, million(s.L), "yes" if s.fallen else "no"] for n, s in scores.items()],
        ),
    ]
    numbers = {"first": first.tolist(), "last": last.tolist(), "refused": refused}
    on_hfs = {name: {"L": float(s.L), "fallen": bool(s.fallen)} for name, s in scores.items()}
    return write(flags, sets, numbers | {"hfs": on_hfs}, text, ("starts.png", caption))


def main(flags: Any) -> Path | None:
    """Run a sub-command."""
    lib.all_devices()
    return {Front: front, Starts: starts}[type(flags)](flags)


if __name__ == "__main__":
    lib.run(main, Front | Starts, __doc__)
