"""Results on disk, taken up again where the same is asked: tunings and the scores of walks.

The name of a file ends in a digest of all that its content follows from: settings, body, command,
net, weights, plant, seed, loss, versions of the packages. Other inputs make another file, so that
nothing is taken for something else and nothing is overwritten. The program's own lines are not in
the digest: every result tells the commit it was made at, and a report names them. A damaged file
is made anew.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float

from hector_jax import pipeline
from hector_jax.console import bar, say
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights, nominal
from hector_jax.evaluation import metrics
from hector_jax.evaluation.metrics import Score
from hector_jax.grfm.dataset import at_interval
from hector_jax.grfm.network import Params
from hector_jax.robot import MODEL_PATH, Robot
from hector_jax.sim.walk import Job
from hector_jax.sim.world import Imperfections
from hector_jax.storage import fingerprint, load_tree, save_tree, versions
from hector_jax.trajectory import State, Trajectory, Wrench
from hector_jax.tuning.difftune import Evaluation, Iteration, TuneConfig, Tuning
from hector_jax.tuning.loss import LossConfig, Losses

Key = TypeVar("Key")
Tree = TypeVar("Tree")


class Tuned(NamedTuple):
    """A tuning with its history."""

    tuning: Tuning
    commit: str  # at which it was made; empty where that is not known


class Walked(NamedTuple):
    """What is kept of one walk."""

    score: Score
    upright: Float[np.ndarray, ""]  # [s] until a fall, or the whole walk
    last: State  # the last one upright, or of the walk
    commit: str


class Judged(NamedTuple):
    """Walks of several sets on the same plants."""

    walks: dict[str, list[Walked]]  # by set, in the order of the plants
    shown: dict[str, Trajectory]  # by set, the walk on the first plant, at the plan interval


def digest(*parts: Any) -> str:
    """Twelve digits for settings (known by their repr), trees of numbers and the plants' XML."""
    is_tree = lambda x: isinstance(x, tuple) or x is None  # noqa: E731
    told = [fingerprint(part) if is_tree(part) else repr(part) for part in parts]
    key = "\n".join([*told, repr(versions())]).encode() + MODEL_PATH.read_bytes()
    return hashlib.sha256(key).hexdigest()[:12]


def _taken(path: Path, like: Any, kind: str, robot: Robot) -> tuple[Any, dict[str, Any]] | None:
    """What is kept under `path` with its notes; None where there is nothing sound."""
    if not path.exists():
        return None
    try:
        tree, card = load_tree(path, like, kind=kind, robot=robot)
    except ValueError as error:
        say(f"made anew: {error}")
        return None
    return tree, card["about"]


class _Course(NamedTuple):
    """The arrays of a tuning, iterations stacked; the words go into the card."""

    weights: Weights
    evaluation: Evaluation
    accepted: Any
    step: Any
    ten: Weights
    converged: Weights


def _course_like() -> _Course:
    none = np.zeros(0)
    rows = jax.tree.map(lambda w: np.zeros((0, *w.shape)), nominal())
    seen = Evaluation(none, Losses(none, none, none), rows, none, none)
    return _Course(rows, seen, none, none, nominal(), nominal())


def save_tuning(path: Path, tuning: Tuning, robot: Robot, commit: str = "") -> None:
    """Keep a tuning with its history.

    Raises:
        OSError: where the file cannot be written.
    """
    stack = lambda trees: jax.tree.map(lambda *x: np.stack(x), *trees)  # noqa: E731
    course = _Course(
        weights=stack([i.weights for i in tuning.history]),
        evaluation=stack([i.evaluation for i in tuning.history]),
        accepted=np.array([i.accepted for i in tuning.history]),
        step=np.array([i.step for i in tuning.history]),
        ten=tuning.ten,
        converged=tuning.converged,
    )
    reasons = [i.reason for i in tuning.history]
    about = {"reasons": reasons, "stop": tuning.stop, "commit": commit}
    save_tree(path, course, kind="tuning", robot=robot, about=about)


def load_tuning(path: Path, robot: Robot) -> Tuned | None:
    """What `save_tuning` kept, or None where there is nothing sound."""
    taken = _taken(path, _course_like(), "tuning", robot)
    if taken is None:
        return None
    course, about = taken
    row = lambda tree, i: jax.tree.map(lambda x: x[i], tree)  # noqa: E731
    history = [
        Iteration(
            i,
            row(course.weights, i),
            row(course.evaluation, i),
            bool(course.accepted[i]),
            reason,
            float(course.step[i]),
        )
        for i, reason in enumerate(about["reasons"])
    ]
    tuning = Tuning(history, course.ten, course.converged, about["stop"])
    return Tuned(tuning, about["commit"])


def tune(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    problems: Mapping[str, tuple[Command, Params | None]],
    folder: Path,
    commit: str,
    title: str,
) -> dict[str, Tuned]:
    """`pipeline.tune_many`, for those problems whose tunings are not in `folder` yet."""
    paths = {
        name: folder / f"tuning-{name}-{digest(config, robot, nominal(), *problem)}.npz"
        for name, problem in problems.items()
    }
    found = {name: load_tuning(path, robot) for name, path in paths.items()}
    missing = {name: problems[name] for name, tuned in found.items() if tuned is None}
    if missing:
        dumps = folder / "dumps"
        tunings = pipeline.tune_many(pool, config, robot, missing, title, dumps=dumps)
        for name, tuning in tunings.items():
            save_tuning(paths[name], tuning, robot, commit)
            found[name] = Tuned(tuning, commit)
    return {name: tuned for name, tuned in found.items() if tuned is not None}


def tune_measured(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    params: Params | None,
    plants: Sequence[Imperfections],
    folder: Path,
    commit: str,
    title: str,
) -> Tuned:
    """`pipeline.tune_measured`, where its tuning is not in `folder` yet."""
    key = digest(config, robot, weights, command, params, *plants)
    path = folder / f"tuning-walks-{key}.npz"
    found = load_tuning(path, robot)
    if found is None:
        known = (config, robot, weights, command, params, plants, title)
        found = Tuned(pipeline.tune_measured(pool, *known), commit)
        save_tuning(path, found.tuning, robot, commit)
    return found


def _walked(config: LossConfig, walk: Trajectory, commit: str) -> Walked:
    up = int(np.sum(~np.asarray(walk.fallen)))
    last = jax.tree.map(lambda x: np.asarray(x)[max(up - 1, 0)], walk.state)
    return Walked(metrics.score(config, walk), np.asarray(up * float(walk.period)), last, commit)


def _walked_like() -> tuple[Score, np.ndarray, State]:
    one, three = np.zeros(()), np.zeros(3)
    score = Score(one, one, one, one, one, three, three, one, one, one)
    return score, one, State(three, three, three, three)


def _trajectory_like() -> Trajectory:
    rows, state = np.zeros((0, 3)), np.zeros(3)
    wrench = Wrench(np.zeros((0, 2, 3)), np.zeros((0, 2, 3)))
    return Trajectory(
        period=np.zeros(()),
        initial=State(state, state, state, state),
        state=State(rows, rows, rows, rows),
        reference=State(rows, rows, rows, rows),
        command=wrench,
        effect=wrench,
        contact=np.zeros((0, 2)),
        feet=np.zeros((0, 2, 3)),
        joints=np.zeros((0, 10)),
        fallen=np.zeros(0),
        legs_touch=np.zeros(0),
        residual=np.zeros(0),
    )


def judge(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    sets: Mapping[str, Weights],
    command: Command,
    plants: Sequence[Imperfections],
    seeds: Sequence[int],
    folder: Path,
    commit: str,
    title: str,
) -> Judged:
    """Scores of every weight set on every plant, walking what is not in `folder` yet.

    Args:
        pool: worker processes.
        config: controller and loss.
        robot: nominal body.
        sets: weights by name.
        command: what to walk, four seconds.
        plants: of the seeds.
        seeds: of the plants and of the estimators.
        folder: of the scores, a file per walk; the walks of the first seed are kept themselves.
        commit: to note with what is made now.
        title: for the person who waits.
    """
    walk_config = config.rollout.walk
    jobs = {
        (name, seed): Job(weights, command, plant, seed=seed)
        for plant, seed in zip(plants, seeds, strict=True)
        for name, weights in sets.items()
    }
    endings = {
        (name, seed): f"{name}-{seed}-{digest(walk_config, config.loss, robot, job)}.npz"
        for (name, seed), job in jobs.items()
    }
    scored: dict[tuple[str, int], Walked] = {}
    shown: dict[str, Trajectory] = {}
    for (name, seed), ending in endings.items():
        taken = _taken(folder / f"score-{ending}", _walked_like(), "score", robot)
        if taken is None:
            continue
        if seed == seeds[0]:
            walk = _taken(folder / f"walk-{ending}", _trajectory_like(), "trajectory", robot)
            if walk is None:
                continue
            shown[name] = walk[0]
        scored[name, seed] = Walked(*taken[0], commit=taken[1]["commit"])
    missing = [key for key in jobs if key not in scored]
    if missing:
        title = f"{title}, {len(scored)} of {len(jobs)} walks kept" if scored else title
        walks = pipeline.walks_of(pool, config, robot, [jobs[key] for key in missing], title)
        for (name, seed), walk in zip(missing, walks, strict=True):
            found, ending = _walked(config.loss, walk, commit), endings[name, seed]
            if seed == seeds[0]:
                shown[name] = at_interval(walk, walk_config.gait.tick)
                save_tree(folder / f"walk-{ending}", shown[name], kind="trajectory", robot=robot)
            path = folder / f"score-{ending}"
            save_tree(path, tuple(found[:3]), kind="score", robot=robot, about={"commit": commit})
            scored[name, seed] = found
    return Judged(
        {name: [scored[name, seed] for seed in seeds] for name in sets},
        {name: shown[name] for name in sets},
    )


def trees(
    paths: Mapping[Key, Path],
    make: Callable[[Sequence[Key]], Iterable[Tree]],
    like: Tree,
    kind: str,
    robot: Robot,
    about: Mapping[str, Any] | None = None,
) -> dict[Key, Tree]:
    """Trees of arrays by key: those on disk are taken, the others made and saved as they come.

    Args:
        paths: a file for each, its name with a `digest` of all that the tree follows from.
        make: yields the trees of the keys that it is given, in their order.
        like: a tree of the same form.
        kind: of the files.
        robot: the body that the trees are of.
        about: to note with what is made now.
    """
    taken = {key: _taken(path, like, kind, robot) for key, path in paths.items()}
    found = {key: one[0] for key, one in taken.items() if one is not None}
    missing = [key for key in paths if key not in found]
    if missing:
        for key, tree in zip(missing, make(missing), strict=True):
            save_tree(paths[key], tree, kind=kind, robot=robot, about=dict(about or {}))
            found[key] = tree
    return {key: found[key] for key in paths}


def walk_groups(
    groups: Mapping[str, Sequence[Job]],
    walk: Callable[[Sequence[Job]], Iterator[Trajectory]],
    tell: Callable[[Trajectory], Tree],
    like: Tree,
    kind: str,
    robot: Robot,
    folder: Path,
    key: tuple[Any, ...],
    title: str,
) -> dict[str, Tree]:
    """What there is to say of each walk of groups of jobs, stacked; whole groups are kept.

    Args:
        groups: of jobs, by a name that may stand in a file's.
        walk: walks jobs, in their order.
        tell: what is kept of a walk, a NamedTuple of arrays.
        like: such a tuple.
        kind: of the files.
        robot: the body.
        folder: of the files.
        key: what the walks follow from beside the jobs, as `digest` takes it; noted in the files.
        title: for the person who waits, after the number of walks.
    """
    paths = {
        name: folder / f"{name}-{digest(*key, robot, tuple(jobs))}.npz"
        for name, jobs in groups.items()
    }

    def make(missing: Sequence[str]) -> Iterator[Tree]:
        jobs = [job for name in missing for job in groups[name]]
        with bar(f"{len(jobs)} walks{title}") as on:
            on(0, len(jobs), "compiling")
            walks, done = walk(jobs), 0
            for name in missing:
                rows = []
                for _ in groups[name]:
                    rows.append(tell(next(walks)))
                    done += 1
                    on(done, len(jobs), name)
                yield jax.tree.map(lambda *x: np.stack(x), *rows)

    about = {"settings": [repr(part) for part in key]}
    return trees(paths, make, like, kind, robot, about)
