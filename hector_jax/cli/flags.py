"""The flags of each command; a field's comment is its help text, its type contains its range."""

import os
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, dataclass_transform

from hector_jax.core.settings import SEED, Range

T = TypeVar("T")

OF_ROBOT = ("nominal", "expert")  # sets that each robot has
OTHER_MASSES = {"light": 0.9, "heavy": 1.1}  # models: the robot's own with all masses times this
NAMED_WEIGHTS = (*OF_ROBOT, "shipped")


class PathKind(Enum):
    """What a flag names; its existence is checked before the slow imports."""

    FILE = "a file"
    LOG = "a log or NAME=LOG"
    BAG = "a file, or the folder of a bag"
    RUN = "the folder of a run of `hector tune`"
    FOLDER = "a folder"  # may not exist yet
    EXPORTABLE = "a run folder, shipped or a weights file"
    WEIGHTS = "nominal, expert, shipped or a weights file"
    SETS = "nominal, expert, shipped, a weights file, or a folder of one for each trajectory"
    TRAJECTORY = "a name or a TOML file"
    MODEL = "light, heavy or a TOML file of a robot"
    ROBOT = "a robot's TOML file: hector robot MODEL --out FOLDER makes one"


def named_file(text: str) -> tuple[str, str]:
    """Return name and file of NAME=FILE; without a name, as in a/b=c or a file a=b, it is ""."""
    name, _, file = text.partition("=")
    return ("", text) if not file or "/" in name or os.path.exists(text) else (name, file)


Processes = Annotated[int, Range(1, 1024)]
PROCESSES = 2
Plants = Annotated[int, Range(1, 10_000)]
Seed = Annotated[int, SEED]
Seconds = Annotated[float, Range(0.01, 600)]  # at least one tick
Footsteps = Literal["footstep_feedback", "footstep_width", "turn_lead"]
Gains = Literal["horizontal_gain", "height_gain", "tilt_gain", "yaw_gain"]
Groups = Literal["weights", "footsteps", "integral", "all"]
Tunables = Literal[Groups, Footsteps, "effort_reference", "friction", Gains]
Variant = Literal["residual", "paper"]
OneEngine = Literal["c", "mjx", "drake", "pinocchio"]
Engine = Literal["auto", OneEngine]
WalkEngine = Literal["c", "drake", "pinocchio"]  # MJX has no plants with estimator errors
JudgingEngine = Literal[OneEngine, "all"]
Gait = Literal["own", "walk", "trot", "pace", "crawl", "stand"]
PlantWorld = Literal["ideal", "hfs", "hfs-varied", "hfs-even", "standin", "standin-even"]
World = Literal["srbm", PlantWorld]
RobotFile = Annotated[Path | None, PathKind.ROBOT]
Weights = Annotated[str, PathKind.WEIGHTS]
WeightSets = Annotated[str, PathKind.SETS]  # with an optional prefix NAME=
Trajectory = Annotated[str, PathKind.TRAJECTORY]
Trajectories = tuple[Trajectory, ...]
Run = Annotated[Path, PathKind.RUN]
Folder = Annotated[Path, PathKind.FOLDER]

COMMANDS: dict[str, type[Any]] = {}  # the flags of each command, by its one or two words
_GROUPS = {"log": ("check", "twin", "foretell", "add"), "steps": ("collect", "train", "grfm")}


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def _command(kind: type[T]) -> type[T]:
    name = kind.__name__.lower()
    group = next((f"{word} " for word, names in _GROUPS.items() if name in names), "")
    COMMANDS[group + name] = kind
    return dataclass(frozen=True)(kind)


@dataclass(frozen=True)
class Flags:
    """The flags of a command."""

    # names of those that the line or its file gave; others have their default
    given: ClassVar[frozenset[str]] = frozenset()
    usual: ClassVar[frozenset[str]] = frozenset()  # all that --help tells; none: it tells each

    def is_given(self, name: str) -> bool:
        """Tell whether a flag was given: on the line, in a file, or in Python by another value."""
        default = next(flag.default for flag in fields(self) if flag.name == name)
        return name in self.given or getattr(self, name) != default


def with_given(flags: T, names: Iterable[str]) -> T:
    """Note which flags were given; `replace` makes flags of which none is."""
    object.__setattr__(flags, "given", frozenset(names))
    return flags


@dataclass(frozen=True, kw_only=True)
class Configured(Flags):
    """A command whose flags may come from a file."""

    config: Path | None = None  # TOML file of flags, or a run's config.json; the line overrides it


@dataclass(frozen=True, kw_only=True)
class Parallel(Flags):
    """A command that computes in several processes."""

    processes: Processes = PROCESSES  # worker processes, one core each
    cluster: str | None = None  # HOST:PORT of a scheduler of dask, whose workers compute instead


@dataclass(frozen=True, kw_only=True)
class Printed(Flags):
    """A command that prints a result."""

    json: bool = False  # print JSON instead of text


@dataclass(frozen=True, kw_only=True)
class ForRobot(Flags):
    """A command for any robot."""

    robot: RobotFile = None  # TOML file of another robot; HECTOR by default


@dataclass(frozen=True, kw_only=True)
class ByWalker(Flags):
    """A command whose walks a program of the user can make."""

    walker: Annotated[Path | None, PathKind.FILE] = None  # program that walks (docs/howto/own.md)
    walker_limit: Annotated[float, Range(1, 86_400)] = 600.0  # longest time of one of its walks [s]
    walker_uses: tuple[Path, ...] = ()  # files and folders that decide its walks too


@dataclass(frozen=True, kw_only=True)
class ByPlanner(Flags):
    """A command that may ask a program of the user for its plans."""

    # program that plans as the controller of the walks does, in place of a twin (docs/howto/own.md)
    planner: Annotated[Path | None, PathKind.FILE] = None


@dataclass(frozen=True, kw_only=True)
class ByMapping(Flags):
    """A command whose logs may be bags."""

    # TOML file of the topics of a ROS 2 bag, if the log is one (docs/howto/walks.md; extra: bags)
    mapping: Annotated[Path | None, PathKind.FILE] = None


@_command
class Collect(ForRobot, Parallel):
    """Walk on the high-fidelity simulator and record the measured ground forces.

    Example: hector steps collect --walks 128 --out data/more
    """

    out: Folder = Path("data/walks")  # for the walks; its default names settings of your own
    walks: Annotated[int, Range(3, 100_000)] = 64  # number of walks
    seconds: Annotated[float, Range(0, 600, above=True)] = 4.0  # length of each walk [s]
    seed: Seed = 0  # seed of all random numbers: commands, weights, plants, pushes
    engine: Engine = "auto"  # c: MuJoCo, one walk per process; mjx: all at once; auto: mjx on a GPU


@_command
class Train(ForRobot, Printed):
    """Train GRFM-Net on collected walks.

    Example: hector steps train --data data/more --out data/more.npz
    """

    data: Folder = Path("data/walks")  # folder of the walks
    out: Path | None = None  # file for the net; by default beside DATA, grfm.npz for a tuning
    variant: Variant = "residual"  # architecture of the net
    epochs: Annotated[int, Range(1, 100_000)] = 200  # passes over the samples


@_command
class Grfm(Parallel, Printed):
    """Report how well the nets predict the ground forces of walks that they never saw.

    Example: hector steps grfm --seeds 0
    """

    data: Folder = Path("data")  # folder of the walks and nets, which are made if they are missing
    out: Folder = Path("runs/grfm")  # folder for the report
    seeds: Annotated[int, Range(0, 10_000)] = 2  # stand-in plants, for information; 0: none


@_command
class Tune(Configured, ByWalker, ByPlanner, Parallel):
    """Tune the MPC weights for trajectories, with and without the net, and evaluate them.

    Example: hector tune --traj straight c s --seeds 32
    """

    usual = frozenset("traj start tune seeds smooth safe walks robot walker out resume".split())
    traj: Trajectories = ("straight",)  # straight, c, s, all, TOML files: one set for all of them
    # trajectories that no set may make 10 % worse, which a --walker walks too
    keep: Trajectories = ()
    start: Weights = "nominal"  # where to start: nominal, expert, shipped or a weights file
    # weights: Q and R; also footsteps, integral, all, or numbers by name;
    # `best` has the gains of the integral action in any case
    tune: tuple[Tunables, ...] = ("weights",)
    seeds: Plants = 8  # stand-in plants to evaluate on
    iterations: Annotated[int, Range(1, 10_000)] = 10  # largest number of steps of each tuning
    variant: Variant = "residual"  # architecture of the net
    alpha: Literal["paper", "auto"] = "paper"  # loss weights; auto makes the gradient norms alike
    # price in `best` of changes of the command between switches of stance: more, smoother commands
    smooth: Annotated[float, Range(0, 1000)] = 5.0
    # limit [m] of the position error of `best`; by default 0.19 of the height of the centre of mass
    safe: Annotated[float | None, Range(0.001, 10)] = None
    data: Folder = Path("data")  # folder of the walks and the net, which are made if missing
    net: Annotated[Path | None, PathKind.FILE] = None  # another net, instead of that in DATA
    out: Path | None = None  # the run folder, which must not exist; by default runs/TRAJ/TIME
    resume: Annotated[Path | None, PathKind.RUN] = None  # interrupted run folder to continue
    video: bool = True  # make a film of the nominal and the best weights
    # walks to spend on row `best` after the choice of its start; 0 for none; by default four sets
    # walk on twelve drawn plants (docs/howto/walks.md)
    walks: Annotated[int | None, Range(0, 100_000)] = None
    # drawn plants of these walks, 0 for the simulator; by default twelve, or as --walks allows
    walk_plants: Annotated[int | None, Range(0, 1000)] = None
    # of Q and R with a --walker: by its --planner, or the plans of the robot's file; or by walks
    slopes: Literal["plans", "walks"] = "plans"
    walk_engine: WalkEngine = "c"  # of these walks; c: MuJoCo; extras: drake, pinocchio
    json: bool = False  # print JSON instead of the table; `run` is the folder
    robot: RobotFile = None  # another robot's TOML: data in DATA/NAME, runs in runs/NAME; or HECTOR


@_command
class Propose(ForRobot, ByPlanner, Printed):
    """Say which weights a robot, or a simulator elsewhere, is to walk with next.

    Example: hector propose runs/robot --traj s
    """

    folder: Folder  # of this tuning; a later call needs no other flag
    traj: Trajectories = ("straight",)  # straight, c, s, all, TOML files: one set for all of them
    start: Weights = "shipped"  # of the first walk: nominal, expert, shipped or a weights file
    # weights: Q and R; also footsteps, integral, all, or numbers by name
    tune: tuple[Tunables, ...] = ("weights",)


@_command
class Add(ByMapping, Printed):
    """Take the logs of the walks with the weights that `hector propose` named.

    Example: hector log add runs/robot log.npz
    """

    folder: Folder  # of `hector propose`
    # one of each trajectory, in their order or as NAME=FILE (docs/howto/walks.md)
    logs: tuple[Annotated[str, PathKind.LOG], ...] = field(metadata={"or": "undo"})
    undo: bool = False  # take no logs, but take back the last ones: their walk is waited for again


@_command
class Evaluate(Configured, ForRobot, ByWalker, Parallel, Printed):
    """Compare weight sets on simulated robots, and say what may be claimed; or compare runs.

    Example: hector evaluate --weights nominal expert mine=runs/tuned --traj all --plant light heavy
    """

    usual = frozenset("weights runs traj world engine plant seeds until_clear robot out".split())
    # nominal, expert, shipped, files, runs, folders of straight.json, c.json, ...; or NAME=one
    weights: tuple[WeightSets, ...] = OF_ROBOT
    runs: tuple[Run, ...] = ()  # instead: finished runs of `hector tune`, side by side
    traj: Trajectories = ("straight",)  # names (all: straight, c and s) or TOML files
    world: PlantWorld = "standin"  # world of the plants; standin-even: masses drawn evenly
    # c: MuJoCo; mjx: it knows its state exactly; extras: drake, pinocchio; all: all but mjx
    engine: tuple[JudgingEngine, ...] = ("c",)
    # other models of the robot: light and heavy (its masses times 0.9 and 1.1), TOML files
    plant: tuple[Annotated[str, PathKind.MODEL], ...] = ()
    seeds: Plants = 8  # number of plants of the first model, in the first engine
    other_seeds: Plants = 8  # number of plants of each other model and engine
    first_seed: Seed = 0  # first plant
    # stop before the last plant if every set is clearly better, worse or no different
    until_clear: bool = False
    seconds: Seconds = 4.0  # length of each walk [s]; a whole eight takes 8
    # folder for a report; a later call continues there
    out: Annotated[Path | None, PathKind.FOLDER] = None


@_command
class Walk(Configured, ForRobot, ByWalker, Printed):
    """Walk once and report losses and tracking errors.

    Example: hector walk --traj s --world standin --seed 3 --weights expert --video walk.mp4
    """

    traj: Trajectory = "straight"  # straight, c, s, sideways, turn, eight, stop-and-go or a file
    world: World = "hfs"  # where to walk
    seed: Seed = 0  # seed of the plant and of the estimator's noise
    weights: Weights = "nominal"  # nominal, expert, shipped or a weights file
    seconds: Seconds = 4.0  # length of the walk [s]
    out: Path | None = None  # file for the trajectory (.npz)
    video: Path | None = None  # file for a film beside nominal weights (.mp4; .webp for a page)
    plant: RobotFile = None  # TOML file of another model of the robot, which is walked on
    gait: Gait = "own"  # that of the robot's file, walk, trot, pace, crawl or stand
    engine: OneEngine = "c"  # c: MuJoCo; mjx: it knows its state exactly; extras: drake, pinocchio


@_command
class Check(ForRobot, ByMapping, Printed):
    """Say what in the log of a walk no weights can fix: mass, delay, joints, units and so on.

    Example: hector log check mine.npz --traj straight
    """

    log: Annotated[Path, PathKind.BAG]  # of any controller (docs/howto/own.md)
    traj: Trajectory = "straight"  # that was walked: a name or a TOML file
    seconds: Seconds = 4.0  # length of the walk [s]


@_command
class Twin(Check, ByPlanner):
    """Plan a log again, by the robot's file or by a program, and say how far these plans are off.

    Example: hector log twin mine.npz --robot mine.toml --traj straight --weights mine.json
    """

    weights: Weights = "nominal"  # of the walk: nominal, expert, shipped or a weights file


@_command
class Foretell(ForRobot, ByPlanner, ByMapping, Printed):
    """Foretell from logs of walks what other weights would bring on the robot that walked.

    Example: hector log foretell mine.npz --walked nominal --weights expert shipped
    """

    logs: tuple[Annotated[Path, PathKind.BAG], ...]  # of one robot and one trajectory
    walked: Weights = "nominal"  # of the walks: nominal, expert, shipped or a weights file
    weights: tuple[Weights, ...] = ("shipped",)  # that are foretold
    traj: Trajectory = "straight"  # that was walked: a name or a TOML file
    seconds: Seconds = 4.0  # length of the walks [s]


@_command
class Robot(Flags):
    """Report what a robot's model holds and what is wrong with it, and convert it.

    Of a TOML file: check it, and fill in what it leaves out.
    Example: hector robot h1.xml --out h1
    """

    file: Annotated[Path, PathKind.FILE]  # MJCF, URDF, or the TOML file of a robot
    out: Path | None = None  # new folder for the robot, its TOML file and model; else it is printed
    weld: tuple[str, ...] = ()  # joints to fix, as toes and the rods of parallel ankles


@_command
class Doctor(Printed):
    """Report versions, devices, precision, cache and video of this machine, and test it.

    The exit code is 1 if something is broken. Example: hector doctor --json
    """


@_command
class Export(Printed):
    """Export weights, lines for the open C++ controller, and the controller as C.

    Example: hector export latest
    """

    run: Annotated[Path, PathKind.EXPORTABLE]  # run folder, `latest`, `shipped` or a weights file
    set: str = "best"  # weight set of the run
    out: Path | None = None  # folder; by default `export` in the run or beside the weights file
    seconds: Seconds = 1.0  # length of the walk of its check after the start-up [s]
    prefix: str = "controller"  # of the C program's files and names, for two in one program
    robot: RobotFile = None  # TOML file, with a weights file; HECTOR by default
    # write no controller, but a copy of this file of another one with the weights at its tags
    into: Annotated[Path | None, PathKind.FILE] = None
    # the same of a file with formulas: {{ Q.euler[0] }}, ..
    template: Annotated[Path | None, PathKind.FILE] = None


@_command
class View(Flags):
    """Show a run in the browser, before and after; or a live walk, of which all can be turned.

    Example: hector view latest --world standin
    """

    # folder of a run of `hector tune`, finished or in progress, or `latest`
    run: tuple[Run, ...] = field(metadata={"or": "live"})
    live: bool = False  # instead: walk in real time, turn weights, push, tune step by step
    robot: RobotFile = None  # TOML file of the robot of a live walk; HECTOR by default
    weights: tuple[Weights, ...] = ("nominal",)  # of a live walk, one or two: names or files
    at: tuple[str, ...] = ()  # numbers of a live walk, as its page repeats them: ahead=0.3 mass=1.1
    # weight sets of the run: before and after; while it is tuned, `with` in place of `best`
    sets: tuple[str, str] = ("nominal", "best")
    world: World = "hfs"  # where both walk
    seed: Seed = 0  # seed of the plant and of the estimator's noise
    seconds: Annotated[float, Range(0.1, 600)] = 4.0  # length of each walk [s]
    host: str = "127.0.0.1"  # address to listen on; the default admits only this machine
    port: Annotated[int, Range(0, 65535)] = 8080  # port; if it is in use, a free one is taken
    out: Path | None = None  # folder for a film and pictures, in place of the page
