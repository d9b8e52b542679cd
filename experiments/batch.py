"""What batches of tunings are good for; one sub-command per question, each writes a report.

    python experiments/batch.py shared     one weight set for several trajectories
    python experiments/batch.py robust     weights that bear with variations of the model
    python experiments/batch.py front      what smoothness costs in tracking
    python experiments/batch.py starts     how much the start matters
    python experiments/batch.py verdict OUT    weights of a report on the hardware stand-in

Tuned is on the rigid body, through a GRFM-Net where --net names one, on all devices there are
(every CPU core is one). Judged is on the high-fidelity simulator or plants drawn around it; the
stand-in is read by `verdict` alone, which tunes nothing.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import plots
import tyro
from lib import all_devices, sample_weights, write_report

from hector_jax.control.reference import COMMANDS, Command, named_command, standing_anchor
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core.console import bar, exit_code
from hector_jax.core.files import make_folder
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, SEED, Range, check
from hector_jax.core.tree import stack
from hector_jax.grfm import nets
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.network import as_effect, load_net
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.standin import standin
from hector_jax.sim.world import Imperfections, hfs, hfs_varied
from hector_jax.store.setup import Setup
from hector_jax.tuning.batch import BatchProblem, BatchScenario, tail_weights, tune_batch
from hector_jax.tuning.difftune import TuneConfig, Tuning, single
from hector_jax.tuning.loss import PAPER_LOSS, Terms, with_alphas
from hector_jax.tuning.status import Stop
from hector_jax.tuning.variation import Variation, no_variation
from hector_jax.verdict import judging
from hector_jax.verdict.metrics import Score

HELD_BACK = Command(  # forward, sideways and turns of another rate; used by no tuning
    np.array([1.0, 1.0, 2.0]),
    np.array([[0.4, 0.0], [0.3, 0.1], [0.25, 0.0]]),
    np.array([0.0, -0.3 * np.pi, 0.4 * np.pi]),
)
TAIL = 0.25  # share of the variations and plants, worst first, of a CVaR


@dataclass(frozen=True)
class Flags:
    """Flags of all sub-commands that tune."""

    net: Path | None = None  # GRFM-Net to tune through; none: the plain rigid body
    iterations: Annotated[int, AT_LEAST_ONE] = 10  # at most
    processes: Annotated[int, AT_LEAST_ONE] = 2  # that walk in MuJoCo, one core each

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Shared(Flags):
    """One weight set for several trajectories: mean or worst of their losses."""

    out: Path = Path("runs/batch/shared")  # folder of the report
    trajectories: tuple[str, ...] = COMMANDS


@dataclass(frozen=True)
class Robust(Flags):
    """Mean or CVaR over variations of the model, against the model as it is."""

    out: Path = Path("runs/batch/robust")  # folder of the report
    traj: str = "straight"
    variations: Annotated[int, AT_LEAST_ONE] = 16
    noise: bool = False  # the controller sees the state with white noise
    plants: Annotated[int, AT_LEAST_ONE] = 20  # drawn around the hfs, to judge by


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


@dataclass(frozen=True)
class Verdict:
    """Weights of a report on the hardware stand-in, for a verdict: nothing is chosen by it."""

    out: Path  # folder of the report
    traj: str = "straight"
    seeds: Annotated[int, AT_LEAST_ONE] = 8
    first_seed: Annotated[int, SEED] = 0
    processes: Annotated[int, AT_LEAST_ONE] = 2  # one core each

    def __post_init__(self) -> None:
        check(self)


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


def scenario(
    robot: Robot,
    command: Command,
    *,
    tracking: float = 1.0,
    scale: float = 1.0,
    effect: int = 0,
    variation: Variation | None = None,
) -> BatchScenario:
    """Return a walk from standing, with the paper's weights of tracking times `tracking`."""
    loss = with_alphas({t.name: tracking * t.weight for t in PAPER_LOSS[:2]})
    anchor, index = standing_anchor(robot), np.asarray(effect)
    return BatchScenario(command, anchor, index, loss, np.asarray(scale), variation)


def problem(start: Weights, scenarios: Sequence[BatchScenario], tail: float = 1.0) -> BatchProblem:
    """Return the problem of tuning a weight set on scenarios."""
    return BatchProblem(start, stack(scenarios), np.asarray(tail))


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


def scores_on(
    pool: Any,
    robot: Robot,
    sets: Mapping[str, Weights],
    command: Command,
    plants: Sequence[Imperfections],
    title: str,
    first_seed: int = 0,
) -> dict[str, Score]:
    """Return the scores of weight sets, stacked over the plants."""
    seeds = range(first_seed, first_seed + len(plants))
    setup = Setup(pool, TuneConfig(), robot)
    judgement = judging.judge(setup, sets, command, plants, seeds, title=title)
    return {name: stack(scores) for name, scores in judgement.scores.items()}


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


def shared(flags: Shared) -> None:
    """Compare one weight set for many trajectories with one for each (question a)."""
    robot, names = load_robot(), flags.trajectories
    effects, commands = whole_net(flags, robot), {n: named_command(n) for n in names}
    problems = [problem(nominal(), [scenario(robot, c)]) for c in commands.values()]
    alone = tune(flags, robot, effects, problems, "one set for each")
    scales = alone.history.evaluation.loss[:, 0].tolist()
    walks = [scenario(robot, c, scale=k) for c, k in zip(commands.values(), scales, strict=True)]
    tails = {"shared_mean": 1.0, "shared_worst": 0.0}
    problems = [problem(nominal(), walks, tail) for tail in tails.values()]
    together = tune(flags, robot, effects, problems, "one set for all")
    if not first_host():
        return

    sets = {"nominal": nominal(), "expert": expert()}
    sets |= {f"{n} alone": row_of(alone.weights, i) for i, n in enumerate(names)}
    sets |= {n: row_of(together.weights, i) for i, n in enumerate(tails)}
    with workers(flags.processes) as pool:
        scores = {
            name: scores_on(pool, robot, sets, command, [hfs()], f"{name} on the hfs")
            for name, command in {**commands, "unseen": HELD_BACK}.items()
        }
    loss = {n: {c: float(by_set[n].L[0]) for c, by_set in scores.items()} for n in sets}
    falls = {n: [c for c, by_set in scores.items() if by_set[n].fallen.any()] for n in sets}

    def row(name: str) -> list[str]:
        cells = [
            f"{million(x)} ({100 * (x / loss['nominal'][c] - 1):+.0f} %)"
            for c, x in loss[name].items()
        ]
        changes = [100 * (loss[name][c] / loss[f"{c} alone"][c] - 1) for c in names]
        return [name, *cells, f"{max(changes):+.0f} %", ", ".join(falls[name]) or "none"]

    head = ["set", *scores, "worst, to the set tuned singly", "falls"]
    base = np.array(list(loss["nominal"].values()))
    changes = {n: np.array(list(loss[n].values())) / base for n in list(sets)[1:]}
    make_folder(flags.out)
    caption = plots.ratios(flags.out / "shared.png", list(scores), changes)
    ends = [f"{n} alone: {end_of(alone, i)}" for i, n in enumerate(names)]
    ends += [f"{n}: {end_of(together, i)}" for i, n in enumerate(tails)]
    text = [
        "One weight set for several trajectories",
        "Each trajectory's loss is divided by that of its nominal walk before the mean, or the "
        "worst, of all is lowered. Judged by one walk on the high-fidelity simulator (hfs) each; "
        "in brackets the change to nominal. `unseen` was tuned on by none.",
        markdown_table(head, [row(n) for n in sets]),
        "\n".join(f"- {line}" for line in ends),
    ]
    write(flags, sets, {"hfs": loss, "falls": falls}, text, ("shared.png", caption))


def draw_variations(count: int, noise: bool) -> list[Variation]:
    """Draw bodies and grounds around the model, with the widths of hfs-varied if it has them."""
    rng = np.random.default_rng(0)
    sigmas = (5e-3, 3e-3, 3e-2, 3e-2) if noise else (0.0,) * 4  # rad, m, rad/s, m/s
    none = no_variation()
    return [
        none._replace(
            mass=np.asarray(1 + rng.uniform(-0.04, 0.04)),
            inertia=np.asarray(1 + rng.uniform(-0.2, 0.2)),
            com=rng.uniform(-0.01, 0.01, 3),
            friction=np.asarray(rng.uniform(0.6, 1.0)),
            delay=np.asarray(rng.uniform(0.0, 5e-3)),
            noise=type(none.noise)(*(np.full(3, sigma) for sigma in sigmas)),
            seed=np.asarray(seed),
        )
        for seed in range(count)
    ]


def member_params(params: Any) -> Any:
    """Return each member of the ensemble as an ensemble of one, stacked on a new first axis."""
    members = jax.tree.map(lambda p: jnp.asarray(p)[:, None], nets.by_kind(params))
    count = len(jax.tree.leaves(members)[0])
    shared = jax.tree.map(lambda p: jnp.broadcast_to(p, (count, *jnp.shape(p))), params)
    return nets.with_nets(shared, members)


def robust(flags: Robust) -> None:
    """Tune weights for variations, evaluated on plants drawn around the hfs (question b)."""
    robot, command = load_robot(), named_command(flags.traj)
    effects, members = last_command, 1
    if flags.net is not None:  # a net of another variant is refused before any tuning
        effects = as_effect(member_params(load_net(flags.net, robot, "residual")[0]))
        members = len(jax.tree.leaves(effects)[0])
    problems = [problem(nominal(), [scenario(robot, command)])]
    plain = tune(flags, robot, whole_net(flags, robot), problems, "the model as it is")
    variations = draw_variations(flags.variations, flags.noise)
    walks = [
        scenario(robot, command, effect=i % members, variation=variation)
        for i, variation in enumerate(variations)
    ]
    tails = {"mean": 1.0, "CVaR": TAIL}
    problems = [problem(nominal(), walks, tail) for tail in tails.values()]
    varied = tune(flags, robot, effects, problems, f"{flags.variations} variations")
    if not first_host():
        return

    sets = {"nominal": nominal(), "expert": expert(), "as it is": row_of(plain.weights, 0)}
    sets |= {n: row_of(varied.weights, i) for i, n in enumerate(tails)}
    plants = [hfs_varied(seed) for seed in range(flags.plants)]
    with workers(flags.processes) as pool:
        scores = scores_on(pool, robot, sets, command, plants, "plants around the hfs")
    make_folder(flags.out)
    caption = plots.by_plant(flags.out / "robust.png", {n: s.L for n, s in scores.items()})
    ensemble = ", members of the net's ensemble in turn (`as it is`: through the mean of them all)"
    ensemble *= members > 1
    text = [
        f"Tuned over variations of the model: {flags.traj}",
        f"{flags.variations} variations: mass within 4 %, inertia 20 %, centre of mass 1 cm, "
        f"friction 0.6 to 1, effects late by up to 5 ms{ensemble}"
        f"{', a noisy estimate' if flags.noise else ''}. CVaR: mean over the worst {TAIL:.0%}. "
        f"Judged on {flags.plants} plants drawn around the hfs (hfs-varied).",
        plant_table(scores, "as it is"),
        "\n".join(
            f"- {n}: {end_of(tunings, i)}"
            for n, tunings, i in [("as it is", plain, 0), ("mean", varied, 0), ("CVaR", varied, 1)]
        ),
    ]
    write(flags, sets, {"hfs-varied": as_numbers(scores)}, text, ("robust.png", caption))


def plant_table(scores: Mapping[str, Score], base: str) -> str:
    """Return a table of weight sets over plants: falls, mean, tail, and paired ratio to a set."""
    rows = []
    for name, score in scores.items():
        change = 100 * (np.median(score.L / scores[base].L) - 1)
        falls = f"{int(score.fallen.sum())} of {len(score.L)}"
        losses = jnp.asarray(score.L)
        worst = tail_weights(losses, jnp.asarray(TAIL)) @ losses
        rows.append([name, falls, million(losses.mean()), million(worst), f"{change:+.1f} %"])
    head = ("set", "falls", "mean L", f"worst {TAIL:.0%}", f"median, to {base}")
    return markdown_table(head, rows)


def as_numbers(scores: Mapping[str, Score]) -> dict[str, Any]:
    """Return scores as JSON values."""
    return {n: {"L": s.L.tolist(), "fallen": s.fallen.tolist()} for n, s in scores.items()}


def front(flags: Front) -> None:
    """Trade tracking against smoothness (question c)."""
    robot, command = load_robot(), named_command(flags.traj)
    prices = 10.0 ** np.linspace(-flags.decades, flags.decades, flags.points)
    problems = [problem(nominal(), [scenario(robot, command, tracking=p)]) for p in prices]
    tunings = tune(flags, robot, whole_net(flags, robot), problems, "prices of tracking")
    if not first_host():
        return
    sets = {f"tracking x{p:.3g}": row_of(tunings.weights, i) for i, p in enumerate(prices)}
    all_sets = {"nominal": nominal(), "expert": expert(), **sets}
    with workers(flags.processes) as pool:
        scores = scores_on(pool, robot, all_sets, command, [hfs()], "on the hfs")

    def tracking(terms: Mapping[str, Any]) -> Any:
        return sum(term.weight * terms[term.name] for term in PAPER_LOSS[:2])

    terms = final_terms(tunings)
    model = np.stack([tracking(terms), terms["L_ctrl"]], axis=1)
    on_hfs = {
        n: (float(tracking(s.losses)[0]), float(s.losses["L_ctrl"][0])) for n, s in scores.items()
    }
    rows = []
    for name, losses in on_hfs.items():
        cells, end = ["", ""], ""
        if name in sets:
            i = list(sets).index(name)
            cells, end = [*map(million, model[i])], end_of(tunings, i)
        fell = "yes" if scores[name].fallen.any() else "no"
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
    problems = [problem(w, [scenario(robot, command)]) for w in initial]
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
    with workers(flags.processes) as pool:
        scores = scores_on(pool, robot, sets, command, [hfs()], "on the hfs")
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
            [[n, million(s.L[0]), "yes" if s.fallen.any() else "no"] for n, s in scores.items()],
        ),
    ]
    numbers = {"first": first.tolist(), "last": last.tolist(), "refused": int((~usable).sum())}
    write(flags, sets, numbers | {"hfs": as_numbers(scores)}, text, ("starts.png", caption))


def verdict(flags: Verdict) -> None:
    """Walk the weights of a report on the hardware stand-in and write verdict.md beside it."""
    paths = sorted((flags.out / "weights").glob("*.json"))
    if not paths:
        raise InputError(f"{flags.out}: no weights/*.json; expected the folder of a report")
    sets = {"nominal": nominal(), "expert": expert()}
    sets |= {path.stem: load_weights(path) for path in paths}
    plants = [standin(seed) for seed in range(flags.first_seed, flags.first_seed + flags.seeds)]
    command = HELD_BACK if flags.traj == "unseen" else named_command(flags.traj)
    with workers(flags.processes) as pool:
        title = f"{flags.traj} on the hardware stand-in"
        scores = scores_on(pool, load_robot(), sets, command, plants, title, flags.first_seed)
    last = flags.first_seed + flags.seeds - 1
    about = f"Seeds {flags.first_seed} to {last}. Losses in 1e6."
    path = write_report(
        flags.out / f"verdict-{flags.traj}.md",
        f"On the hardware stand-in: {flags.traj}",
        [about, plant_table(scores, "nominal")],
        numbers={"standin": as_numbers(scores)},
        json_name=f"verdict-{flags.traj}.json",
    )
    print(path)


def main() -> None:
    """Run a sub-command."""
    commands = {Shared: shared, Robust: robust, Front: front, Starts: starts, Verdict: verdict}
    flags = tyro.extras.subcommand_cli_from_dict(
        {kind.__name__.lower(): kind for kind in commands}, description=__doc__
    )
    setup_jax()
    all_devices()
    commands[type(flags)](flags)


if __name__ == "__main__":
    sys.exit(exit_code("batch", main))
