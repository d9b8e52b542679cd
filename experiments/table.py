"""The paper's table: search, tune and evaluate every weight set on every trajectory.

    python experiments/table.py --quick

Writes report.md, table.csv, table.json, table.tex and pictures. Each step reads the results that
are there: an interrupted run continues, and another set or more plants cost only what is new.
"""

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import table_steps as steps
from table_plots import draw
from table_report import Earlier, Fall, Search, Table, load_earlier, write_table
from table_steps import Bench

from hector_jax.cli.flags import Configured, Family, Folder, Iterations, Plants, Processes, Seed
from hector_jax.cli.parse import as_command, as_table, check, read_flags
from hector_jax.control.reference import COMMANDS
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core.console import exit_code, say
from hector_jax.core.environment import environment
from hector_jax.core.files import as_json, locked, make_folder
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.settings import Range, read_json
from hector_jax.report.report import print_table
from hector_jax.robot.model import load_robot
from hector_jax.search.cmaes import SearchConfig, SearchResult
from hector_jax.sim.standin import FAMILIES
from hector_jax.sim.world import Imperfections
from hector_jax.store import nets
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Tuned
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import metrics
from hector_jax.verdict.judging import ScoredWalks
from hector_jax.verdict.metrics import Verdict

PROGRAM = "python experiments/table.py"
SETS = ("nominal", "expert", "search_200", "paper", "without", "with", "with_walks")
LONG_SEARCH = "search_2000"

# limits of `quick`, for a trial of some minutes on two cores
_QUICK = {"seeds": 4, "rollouts": 10, "iterations": 4, "steps": 2, "step_plants": 2}


@dataclass(frozen=True)
class Flags(Configured):
    """Make the table of all weight sets: search, tune and evaluate what is not there yet.

    Example: python experiments/table.py --quick
    """

    trajectories: tuple[str, ...] = COMMANDS  # some of these three
    seeds: Plants = 32  # stand-in plants
    first_seed: Seed = 0  # first plant: 0 in development, 1000 for the final evaluation
    family: Family = "standin"  # of the plants; even: masses drawn evenly about the nominal ones
    # walks of the search, row `search_200`
    rollouts: Annotated[int, Range(SearchConfig.population, 1_000_000)] = 200
    iterations: Iterations = 10  # largest number of steps of each tuning
    steps: Annotated[int, Range(0, 10_000)] = 10  # of row `with_walks`; 0: no such row
    step_plants: Annotated[int, Range(1, 1000)] = 8  # simulator plants for each of these steps
    extra: tuple[str, ...] = ()  # more rows, NAME=FOLDER of straight.json, c.json and s.json
    # folder of row `search_2000`, if it exists
    search_2000: Path = Path("experiments/reports/search_2000")
    earlier: Path | None = None  # table.json of other plants, to compare the order of the sets
    data: Folder = Path("data")  # folder of the walks and the net, which are made if missing
    out: Folder = Path("runs/table")  # folder for the report
    kept: Path | None = None  # folder of results to reuse; by default OUT/kept
    quick: bool = False  # a trial with 4 plants and short tunings, into OUT/quick
    processes: Processes = 2  # worker processes, one core each
    json: bool = False  # print JSON instead of the tables

    @property
    def plants(self) -> range:
        """Seeds of the plants."""
        return range(self.first_seed, self.first_seed + self.seeds)


class Files(NamedTuple):
    """Contents of the files in the flags, read before any computation."""

    sets: Mapping[str, Mapping[str, Weights]]  # of the long searches and extra ones, by trajectory
    long_searches: Mapping[str, Search]  # by trajectory
    earlier: Earlier | None


def main() -> None:
    """Make the table and print it."""
    flags = read_flags(Flags, sys.argv[1:], PROGRAM)
    setup_jax()
    path, by_trajectory = make_table(flags, lambda seeds: list(map(FAMILIES[flags.family], seeds)))
    if flags.json:
        results = {name: metrics.verdict_result(verdict) for name, verdict in by_trajectory.items()}
        print(as_json({"report": str(path), "trajectories": results}))
    else:
        for name, verdict in by_trajectory.items():
            print_table(verdict, f"{name}, {plural(len(verdict.seeds), 'plant')}")
    say(f"the report is {path}")


def make_table(
    flags: Flags, plants: Callable[[range], list[Imperfections]]
) -> tuple[Path, dict[str, Verdict]]:
    """Make the table, from the net to the files.

    Args:
        flags: the flags.
        plants: returns the plants of the verdict, by their seeds.

    Returns:
        report.md, and the verdict of each trajectory.

    Raises:
        InputError: a flag has a wrong value, a file is damaged, or the folder cannot be written.
    """
    command, out = as_command(PROGRAM, flags), flags.out
    if flags.quick:
        flags = replace(flags, **{n: min(getattr(flags, n), most) for n, most in _QUICK.items()})
        out = out / "quick"
    check(flags)
    files = read_files(flags)
    with locked(out):
        return _make_table(flags, files, out, plants, command)


def read_files(flags: Flags) -> Files:
    """Read the files that the flags name.

    Raises:
        InputError: one line with the flag or the file.
    """
    folders: dict[str, Path] = {}
    for text in flags.extra:
        name, _, folder = text.partition("=")
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or not folder:
            raise InputError(f"--extra must be NAME=FOLDER, NAME of letters and digits, got {text}")
        if name in (*SETS, LONG_SEARCH, *folders):
            raise InputError(f"--extra {text}: there is a set '{name}' already")
        folders[name] = Path(folder)
    sets, long_searches = {}, {}
    for name in flags.trajectories:
        if name not in COMMANDS:
            raise InputError(f"--trajectories must be of {', '.join(COMMANDS)}, got {name}")
        paths = {key: folder / f"{name}.json" for key, folder in folders.items()}
        if (file := flags.search_2000 / f"{name}.json").exists():
            paths = {LONG_SEARCH: file, **paths}
            long_searches[name] = _read_card(file.with_name(f"{name}-card.json"))
        sets[name] = {key: load_weights(path) for key, path in paths.items()}
    earlier = (
        None if flags.earlier is None else load_earlier(flags.earlier, flags.plants, flags.family)
    )
    return Files(sets, long_searches, earlier)


def _read_card(path: Path) -> Search:
    content = read_json(path, "the card of a search")
    try:
        return Search(content["walks"], content["best_at"], content["L"]["best"], content["stop"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not the card of a search: {error!r}") from None


def _make_table(
    flags: Flags,
    files: Files,
    out: Path,
    plants: Callable[[range], list[Imperfections]],
    command: str,
) -> tuple[Path, dict[str, Verdict]]:
    robot, folder, about = load_robot(), flags.kept or flags.out / "kept", environment()
    config, budget = TuneConfig(iterations=flags.iterations), SearchConfig(budget=flags.rollouts)
    for path in (out / "pictures", folder):
        make_folder(path)
    with workers(flags.processes) as pool:
        params = nets.load_or_train(pool, robot, flags.data).params
        bench = Bench(Setup(pool, config, robot, about.get("commit", "")), params, folder)
        searches = steps.search(bench, budget, flags.trajectories)
        tunings = {
            name: steps.tune(bench, name, flags.steps, flags.step_plants)
            for name in flags.trajectories
        }
        # no tuning or search may run after the plants of the verdict are made
        standins, walks = plants(flags.plants), {}
        for name, extra in files.sets.items():
            sets = _rows(tunings[name], searches[name], extra)
            walks[name] = steps.judge(bench, name, sets, standins, flags.plants)
            for key, weights in sets.items():
                save_weights(out / "weights" / key / f"{name}.json", weights)
    by_trajectory = {
        name: metrics.make_verdict(config.loss, flags.plants, {name: scored.scores})
        for name, scored in walks.items()
    }
    commits = {tuned.commit for by_set in tunings.values() for tuned in by_set.values()}
    commits |= {w.commit for scored in walks.values() for ws in scored.walks.values() for w in ws}
    settings = {"flags": as_table(flags), "tune": config.as_table(), "search": asdict(budget)}
    content = Table(
        by_trajectory,
        falls=[fall for name, w in walks.items() for fall in _falls(name, w, flags.plants)],
        tunings={n: {k: t.tuning for k, t in by_set.items()} for n, by_set in tunings.items()},
        searches={
            name: Search(len(s.history) * budget.population, s.walk, s.loss, s.stop)
            for name, s in searches.items()
        },
        long_searches=files.long_searches,
        pictures=draw(out, robot, by_trajectory, {n: w.first for n, w in walks.items()}),
        config=settings,
        environment=about,
        commits=sorted(commits),
        command=command,
        earlier=files.earlier,
        family=flags.family,
    )
    return write_table(out, content), by_trajectory


def _rows(
    tunings: Mapping[str, Tuned], search: SearchResult, extra: Mapping[str, Weights]
) -> dict[str, Weights]:
    """Return all weight sets of a trajectory, in the order of the table."""
    return {
        "nominal": nominal(),
        "expert": expert(),
        "search_200": search.weights,
        **{name: tuned.tuning.weights for name, tuned in tunings.items()},
        **extra,
    }


def _falls(trajectory: str, walks: ScoredWalks, seeds: Sequence[int]) -> list[Fall]:
    return [
        Fall(
            trajectory,
            name,
            seed,
            float(walk.upright),
            float(walk.last.position[2]),
            *(float(angle) for angle in walk.last.euler[:2]),
        )
        for name, scored in walks.walks.items()
        for seed, walk in zip(seeds, scored, strict=True)
        if walk.score.fallen
    ]


if __name__ == "__main__":
    sys.exit(exit_code("table", main))
