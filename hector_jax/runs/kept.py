"""Results on disk, taken up again where the same is asked: tunings and the scores of walks.

The name of a file ends in a digest of all that its content follows from: settings, body, command,
net, weights, plant, seed, loss, and the code and packages that compute it (`storage.code_hash`).
Other inputs make another file, so that nothing is taken for something else and nothing is
overwritten. A damaged file is named and made anew; of a tuning, from the iteration before.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.runs import pipeline
from hector_jax.core.console import bar
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.runs import metrics
from hector_jax.runs.metrics import Score
from hector_jax.grfm.dataset import at_interval
from hector_jax.grfm.network import Params
from hector_jax.core.inputs import plural
from hector_jax.runs.pipeline import as_line
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import Job
from hector_jax.sim.world import Imperfections
from hector_jax.storage import Checkpoint, append_file, digest, locked, write_file
from hector_jax.core.trajectory import State, Trajectory, Wrench
from hector_jax.runs.course import KIND, Record, load_tuning
from hector_jax.tuning.difftune import Iteration, TuneConfig, Tuning
from hector_jax.tuning.loss import LossConfig

_KINDS = {"score": "score", "walk": "trajectory"}  # of files, by the beginning of their names

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


class Journal:
    """metrics.jsonl, a line for each iteration: as they come, and in order once tunings are over.

    The truth is in the records of the tunings; the file is made from them.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known: dict[str, Sequence[Iteration]] = {}

    def write(self, histories: Mapping[str, Sequence[Iteration]]) -> None:
        """Write the file anew, with these tunings after or instead of those written before.

        Raises:
            WriteError: where the file cannot be written; the old one stays.
        """
        self._known.update(histories)
        lines = (as_line(name, i) for name, history in self._known.items() for i in history)
        write_file(self.path, "".join(lines).encode())

    def add(self, name: str, iteration: Iteration) -> None:
        """Write one line more.

        Raises:
            WriteError: where the file cannot be written.
        """
        append_file(self.path, as_line(name, iteration).encode())


def tune(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    problems: Mapping[str, tuple[Command, Params | None]],
    folder: Path,
    commit: str,
    title: str,
    journal: Journal | None = None,
    dumps: Path | None = None,
) -> dict[str, Tuned]:
    """`pipeline.tune_many`, taking up what is in `folder`.

    Args:
        pool, config, robot, problems, title: see there.
        folder: of the tunings, a file for each.
        commit: to note with what is made now.
        journal: to write the iterations to.
        dumps: folder for what was refused; that of the tunings' own by default.

    Raises:
        InputError: the folder cannot be written.
    """
    with locked(folder):
        records = pipeline.records_in(folder, config, robot, problems, {"commit": commit})
        known = (pool, config, robot, problems, title)
        kept_in = {"records": records, "dumps": dumps or folder / "dumps"}
        if journal is None:
            tunings = pipeline.tune_many(*known, **kept_in)
        else:
            journal.write({n: r.past.history if r.past else () for n, r in records.items()})
            tunings = pipeline.tune_many(*known, journal.add, **kept_in)
            journal.write({name: tuning.history for name, tuning in tunings.items()})
    return {name: _tuned(tuning, records[name], commit) for name, tuning in tunings.items()}


def _tuned(tuning: Tuning, record: Record, commit: str) -> Tuned:
    return Tuned(tuning, record.notes["commit"] if record.is_finished else commit)


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
    """`pipeline.tune_measured`, taking up what is in `folder`.

    Raises:
        InputError: a walk with the starting weights falls or cannot be believed.
        InputError: the folder cannot be written.
    """
    code = (*pipeline.TUNING_CODE, "tuning.measured", "sim.walk")
    key = digest(config, robot, weights, command, params, *plants, code=code)
    with locked(folder):
        path = folder / f"tuning-walks-{key}.npz"
        record = load_tuning(Checkpoint(path, KIND, robot, {"commit": commit}))
        known = (config, robot, weights, command, params, plants, title)
        if record.past is not None and record.is_finished:
            return _tuned(record.past, record, commit)
        return Tuned(pipeline.tune_measured(pool, *known, record), commit)


def _walked(config: LossConfig, walk: Trajectory, commit: str) -> Walked:
    up = int(np.sum(~np.asarray(walk.fallen)))
    last = jax.tree.map(lambda x: np.asarray(x)[max(up - 1, 0)], walk.state)
    return Walked(metrics.score(config, walk), np.asarray(up * float(walk.period)), last, commit)


def _walked_like() -> tuple[Score, np.ndarray, State]:
    one, three = np.zeros(()), np.zeros(3)
    return metrics.score_like(), one, State(three, three, three, three)


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
    seconds: float = 4.0,
) -> Judged:
    """Scores of every weight set on every plant, walking what is not in `folder` yet.

    Args:
        pool: worker processes.
        config: controller and loss.
        robot: nominal body.
        sets: weights by name.
        command: what to walk.
        plants: of the seeds.
        seeds: of the plants and of the estimators.
        folder: of the scores, a file per walk; the walks of the first seed are kept themselves.
        commit: to note with what is made now.
        title: for the person who waits.
        seconds: of each walk.

    Raises:
        InputError: the folder cannot be written.
    """
    jobs = {
        (name, seed): Job(weights, command, plant, seconds, seed)
        for plant, seed in zip(plants, seeds, strict=True)
        for name, weights in sets.items()
    }
    with locked(folder):
        scored, shown = _scored(pool, config, robot, jobs, seeds[0], folder, commit, title)
    return Judged(
        {name: [scored[name, seed] for seed in seeds] for name in sets},
        {name: shown[name] for name in sets},
    )


def _scored(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    jobs: Mapping[tuple[str, int], Job],
    first: int,
    folder: Path,
    commit: str,
    title: str,
) -> tuple[dict[tuple[str, int], Walked], dict[str, Trajectory]]:
    """What is kept of jobs by set and seed, and of those of the first seed the walks."""
    walk_config = config.rollout.walk
    code = ("sim.walk", "runs.metrics")
    endings = {
        (name, seed): f"{name}-{seed}-{digest(walk_config, config.loss, robot, job, code=code)}.npz"
        for (name, seed), job in jobs.items()
    }
    scored: dict[tuple[str, int], Walked] = {}
    shown: dict[str, Trajectory] = {}

    def kept(what: str, key: tuple[str, int]) -> Checkpoint:
        about = {"commit": commit}
        return Checkpoint(folder / f"{what}-{endings[key]}", _KINDS[what], robot, about)

    for name, seed in endings:
        taken = kept("score", (name, seed)).load(_walked_like())
        if taken is None:
            continue
        if seed == first:
            walk = kept("walk", (name, seed)).load(_trajectory_like())
            if walk is None:
                continue
            shown[name] = walk[0]
        scored[name, seed] = Walked(*taken[0], commit=taken[1]["commit"])
    missing = [key for key in jobs if key not in scored]
    if missing:
        title = (
            f"{title}; {len(scored)} of {plural(len(jobs), 'walk')} are there" if scored else title
        )
        walks = pipeline.walks_of(pool, config, robot, [jobs[key] for key in missing], title)
        for (name, seed), walk in zip(missing, walks, strict=True):
            found = _walked(config.loss, walk, commit)
            if seed == first:
                shown[name] = at_interval(walk, walk_config.gait.tick)
                kept("walk", (name, seed)).save(shown[name])
            kept("score", (name, seed)).save(tuple(found[:3]))
            scored[name, seed] = found
    return scored, shown


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
    kept = {key: Checkpoint(path, kind, robot, about or {}) for key, path in paths.items()}
    taken = {key: one.load(like) for key, one in kept.items()}
    found = {key: one[0] for key, one in taken.items() if one is not None}
    missing = [key for key in paths if key not in found]
    if missing:
        for key, tree in zip(missing, make(missing), strict=True):
            kept[key].save(tree)
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
    code = ("sim.walk", "sim.parallel", "runs.metrics")
    paths = {
        name: folder / f"{name}-{digest(*key, robot, tuple(jobs), code=code)}.npz"
        for name, jobs in groups.items()
    }

    def make(missing: Sequence[str]) -> Iterator[Tree]:
        jobs = [job for name in missing for job in groups[name]]
        with bar(f"{plural(len(jobs), 'walk')}{title}") as on:
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
