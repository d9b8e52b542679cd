"""What the pages say can be done: examples run, commands parse, the site needs no network."""

import ast
import doctest
import importlib
import json
import pkgutil
import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from delay import AS_PROPOSED, BEFORE
from table import PROGRAM, SETS
from table import Flags as Table

import hector_jax
from hector_jax.cli import flags, parse
from hector_jax.control.controller import walk_config
from hector_jax.control.parameters import TUNABLES
from hector_jax.control.reference import COMMANDS
from hector_jax.control.weights import nominal
from hector_jax.robot.model import load_robot
from hector_jax.sim.margin import delay_lines

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
MADE = {"_build", "reference"}  # by a build of the site
PAGES = sorted(p for p in DOCS.rglob("*.md") if not MADE & set(p.parts))
READ = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *PAGES]
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(hector_jax.__path__, "hector_jax.")
    if not module.ispkg
)


def blocks(text, language=""):
    """Fenced blocks of a page."""
    fenced = re.findall(r"^```(.*)\n((?:.*\n)*?)```$", text, re.MULTILINE)
    return [block for kind, block in fenced if kind == language]


def docstrings():
    """Those with examples, by module and name; read from the source, which no wrapper hides."""
    for name in MODULES:
        tree = ast.parse((ROOT / f"{name.replace('.', '/')}.py").read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                text = ast.get_docstring(node) or ""
                if ">>>" in text:
                    yield pytest.param(name, text, id=getattr(node, "name", name))


def run_examples(text, names, title):
    example = doctest.DocTestParser().get_doctest(text, names, title, None, None)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    with mock.patch.dict(TUNABLES):  # to which a page adds one of its own
        runner.run(example)
    assert runner.tries
    assert not runner.failures


@pytest.mark.parametrize(("module", "text"), list(docstrings()))
def test_examples_in_docstrings_say_what_comes_out(module, text):
    run_examples(text, dict(vars(importlib.import_module(module))), module)


@pytest.mark.parametrize(
    "page",
    [
        # a gradient has to be compiled
        pytest.param(
            page,
            id=page.stem,
            marks=pytest.mark.slow if page.stem in ("tutorial", "loss") else (),
        )
        for page in PAGES
        if ">>>" in page.read_text()
    ],
)
def test_examples_in_pages_say_what_comes_out(page):
    run_examples("\n".join(blocks(page.read_text(), "python")), {}, page.stem)


def lines_of(path, program):
    """Calls of a program in a page, of the blocks that are fenced or indented."""
    text = path.read_text()
    lines = [line for block in blocks(text) for line in block.splitlines()]
    lines += re.findall(rf"^    ({program} .*)$", text, re.MULTILINE)
    lines = [line.strip().removeprefix(".venv/bin/") for line in lines]
    return [line for line in lines if line.startswith(f"{program} ") and "<" not in line]


CALLS = sorted(
    {
        (path.name, line)
        for path in READ
        for name in ("hector", PROGRAM)
        for line in lines_of(path, name)
        if "# now: " not in line  # how an old table was made
    }
)
NAMED = sorted({n for path in READ for n in re.findall(r"`hector ([a-z]+)", path.read_text())})


@pytest.mark.parametrize("name", NAMED)
def test_commands_that_pages_name_are_there(name):
    names = set(flags.COMMANDS)
    assert name in names | {"table"}  # of which test_cli says what it answers


def test_pages_show_commands():
    assert len(CALLS) > 20


@pytest.mark.parametrize(("page", "line"), CALLS)
def test_commands_in_pages_parse(page, line, capsys):
    table = line.startswith(PROGRAM)
    words = shlex.split(line, comments=True)[2 if table else 1 :]
    if "--config" in words:  # a file of the reader's
        at = words.index("--config")
        del words[at : at + 2]
    code = 0
    try:
        parse.read_flags(Table, words, PROGRAM) if table else parse.from_line(words)
    except SystemExit as left:  # after --help, too
        code = left.code
    assert code == 0, capsys.readouterr().err


def test_settings_in_pages_are_read(tmp_path):
    (told,) = blocks((DOCS / "howto" / "outputs.md").read_text(), "toml")
    (tmp_path / "night.toml").write_text(told)
    assert parse.from_file(flags.Tune, tmp_path / "night.toml").seeds == 32


@pytest.mark.parametrize("path", READ, ids=lambda path: path.stem)
def test_targets_of_make_in_pages_are_there(path):
    there = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for line in lines_of(path, "make"):
        words = shlex.split(line, comments=True)[1:]
        assert {word for word in words if "=" not in word} <= there, line


@pytest.mark.parametrize("quick", ["", "1"])
def test_make_table_ends_with_a_verdict_of_its_sets(quick):
    call = ["make", "-n", "--no-print-directory", "table", f"QUICK={quick}"]
    said = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    last = parse.from_line(shlex.split(said.replace("\\\n", " ").splitlines()[-1])[1:])
    folder = Path("runs/table/quick" if quick else "runs/table")
    own = [text.split("=") for text in last.weights if f"={folder}" in text]
    assert own == [[name, f"{folder}/weights/{name}"] for name in ("without", "with", "search_200")]
    assert {name for name, _ in own} <= set(SETS)
    assert last.out == folder / "verdict"


@pytest.mark.parametrize("path", READ, ids=lambda path: path.stem)
def test_files_that_pages_name_are_there(path):
    named = re.findall(r"\b(?:experiments|examples|assets)/[\w/.-]+\.\w+", path.read_text())
    assert [name for name in named if not (ROOT / name).exists()] == []


# names that sets had: shared_mean, shared_worst, search_200, search_2000, integral, search
FORMER = re.compile(
    r"""(mean|worst)[-\ ]of[-\ ]all | ceiling | race/tuned | integral-best-limited
    | ["`](integral,\ limited | search,\ weights | search,\ all)["`]
    | (["'`*,]|\|\ |median_|against\ )(searched|shared)(["'`*,]|\ \||\ against)
    | \b(searched|shared)= | ^(searched|shared)\ & """,
    re.IGNORECASE | re.MULTILINE | re.VERBOSE,
)
RECORDED = r"hector table .*|runs/docs/ceiling"  # how the table was made, with the names of then


def test_a_weight_set_has_one_name():
    for text in (
        "`shared` is",
        "| searched |",
        "s,searched,L",
        "median_searched,",
        "shared=a.json",
    ):
        assert FORMER.search(text), text
    for text in ("the shared sets", "batch.py shared", "L_where_searched", "is searched for"):
        assert not FORMER.search(text), text
    kinds = {".csv", ".j2", ".json", ".md", ".png", ".py", ".tex", ".webp"}
    folders = (DOCS, ROOT / "experiments", ROOT / "hector_jax")
    files = [ROOT / "README.md", ROOT / "Makefile"]
    files += [p for folder in folders for p in folder.rglob("*") if p.suffix in kinds]
    files = [path for path in files if not MADE & set(path.parts)]
    assert len(files) > 300
    for path in files:
        name = path.relative_to(ROOT).as_posix()
        text = "" if path.suffix in (".png", ".webp") else path.read_text()
        found = FORMER.search(name + "\n" + re.sub(RECORDED, "", text))
        assert not found, (name, found)


@pytest.mark.parametrize("kind", [*flags.COMMANDS.values(), Table], ids=lambda kind: kind.__name__)
def test_every_flag_has_a_row_among_the_commands(kind):
    text = (DOCS / "commands.md").read_text()
    program = "experiments/table.py" if kind is Table else f"hector {kind.__name__.lower()}"
    section = text.split(f"\n### {program}\n")[1].split("\n#")[0]
    for field in fields(kind):
        name = field.name.replace("_", "-")
        assert f"| `--{name}` |" in section or f"| `{name.upper()}` |" in section


def test_tests_that_pages_name_are_there():
    text = "\n".join(path.read_text() for path in PAGES)
    named = set(re.findall(r"(test_\w+\.py)::(test_\w+)", text))
    assert len(named) > 40
    for file, name in sorted(named):  # `test_a_name...` stands for the tests that begin so
        assert f"\ndef {name}" in (ROOT / "tests" / file).read_text(), f"{file}::{name}"


def changes(seeds):
    """Change of L in % by trajectory, set and baseline, of a table of the results."""
    table = json.loads((DOCS / "results" / seeds / "table.json").read_text())["trajectories"]
    return {
        (name, which): one["standin"]["change"]
        for name, trajectory in table.items()
        for which, one in trajectory["sets"].items()
    }


def rows(path):
    """Cells of a page's table, by the weight set that its row begins with."""
    lines = re.findall(r"^\| `(\w+)`.*? \| (-.*) \|$", path.read_text(), re.MULTILINE)
    return {name: cells.split(" | ") for name, cells in lines}


def test_the_table_of_the_results_page_is_that_of_its_files():
    shown, files = rows(DOCS / "results.md"), (changes("."), changes("seeds-1000"))
    for which in ("with", "with_walks", "shared_mean", "search_2000"):
        for name, text in zip(COMMANDS, shown[which][: len(COMMANDS)], strict=True):
            each = [one[name, which] for one in files]
            pairs = [f"{x['nominal']['median']:.0f} / {x['expert']['median']:.0f}" for x in each]
            assert text == f"{pairs[0]} ({pairs[1]})", (which, name)


def shown_change(sets, world):
    """Change of `best` against nominal as a cell of the page of results has it."""
    start, tuned = (sets[name][world] for name in ("nominal", "best"))
    change, falls = tuned["change"]["nominal"], (start["falls"], tuned["falls"])
    text = "{median:+.0f} [{low:+.0f}, {high:+.0f}]".format(**change)
    assert change["counts"] == (falls == (0, 0))
    return text if change["counts"] else f"{text}; nominal fell {falls[0]} times, `with` {falls[1]}"


def test_the_table_of_other_robots_is_that_of_its_file():
    robots = json.loads((DOCS / "results" / "robots.json").read_text())
    names = {
        "quadruped": "`examples/quadruped`",
        "go2": "Unitree Go2",
        "humanoid": "`examples/humanoid`",
        "h1": "Unitree H1",
    }
    assert robots["all"].keys() == names.keys()
    page = " ".join((DOCS / "results.md").read_text().split())
    for robot, name in names.items():
        each = [robots["all"][robot][traj]["sets"] for traj in COMMANDS]
        assert all(sets["best"]["standin-even"] == sets["with"]["standin-even"] for sets in each)
        cells = [shown_change(sets, "standin-even") for sets in each]
        assert f"| {' | '.join([name, *cells])} |" in page
    go2, g1 = (
        shown_change(robots["straight"][robot]["straight"]["sets"], "standin")
        for robot in ("go2", "g1")
    )
    assert f"Go2 is at {go2} and Unitree G1 at {g1} %, and nothing falls" in page


def test_the_table_of_late_motors_is_that_of_its_reports():
    page = (DOCS / "decisions.md").read_text()
    table = page.partition("| robot, trajectory | controller |")[2].partition("\n\n")[0]
    shown = [line.split("|")[2:-1] for line in table.splitlines()[2:]]
    expected = []
    for report in ("quadruped", "quadruped-s", "humanoid"):
        numbers = json.loads((DOCS / "delay" / report / "delay.json").read_text())
        (trajectories,) = numbers["walks"].values()
        (changes,) = trajectories.values()
        motors = list(zip(numbers["delays"], numbers["lags"], strict=True))
        for name, change in {"whole, 30 rad/s": BEFORE, "as proposed": AS_PROPOSED}.items():
            cells = [name]
            for column in ((2.0, 4.0), (5.0, 6.0), (8.0, 6.0)):
                walks = changes[change][motors.index(column)]
                loss = np.median([walk["L"] for walk in walks]) / 1e6
                falls = sum(walk["fell"] for walk in walks)
                cells.append(f"{loss:#.3g}".rstrip(".") if loss > 10 else f"{loss:.2f}")
                cells[-1] += f", {falls} fell" if falls else ""
            expected.append(cells)
    assert [[cell.strip() for cell in cells] for cells in shown] == expected


def test_the_page_of_robots_shows_the_delay_that_the_quadruped_bears():
    robot = load_robot(ROOT / "examples" / "quadruped" / "robot.toml")
    lines = delay_lines(robot, walk_config(robot), nominal(robot))
    page = (DOCS / "howto" / "robot.md").read_text()
    assert f"    delay    {lines[0]}\n             {lines[1]}\n" in page


@pytest.mark.parametrize("path", READ, ids=lambda path: path.stem)
def test_no_text_is_taken_for_a_comment(path):
    assert re.findall(r"^\s*% .*", path.read_text(), re.MULTILINE) == []


def test_pages_have_titles_of_their_own():
    titles = [re.search(r"^# (.+)$", path.read_text(), re.MULTILINE).group(1) for path in PAGES]
    assert sorted(titles) == sorted(set(titles))


def test_equations_carry_the_papers_numbers():
    labels = re.findall(r"\$\$ \(eq(\d+)\)", (DOCS / "theory.md").read_text())
    assert [int(label) for label in labels] == list(range(1, 17))


def test_the_citation_is_of_this_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_asks_nobody_for_anything(tmp_path):
    build = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", DOCS, tmp_path / "site"]
    done = subprocess.run(build, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    outside = re.compile(r"<(?:script|link|img|iframe)[^>]+(?:src|href)=\"(?:https?:)?//", re.I)
    for path in (tmp_path / "site").rglob("*.html"):
        assert not outside.search(path.read_text()), path
    styles = list((tmp_path / "site").rglob("*.css"))
    assert styles
    for path in styles:
        assert not re.search(r"@import|url\([\"']?(?:https?:)?//", path.read_text()), path
    theory = (tmp_path / "site" / "theory.html").read_text()
    assert theory.count("<math") > 40
    numbers = re.findall(r'class="eqno"[^>]*>\((\d+)\)', theory)
    assert numbers == [str(n) for n in range(1, 17)]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tune", "phi"])
def test_notebooks_run_to_their_end(name, tmp_path):
    nbclient, nbformat = (pytest.importorskip(module) for module in ("nbclient", "nbformat"))
    notebook = nbformat.read(DOCS / "notebooks" / f"{name}.ipynb", as_version=4)
    assert any(cell.get("outputs") for cell in notebook.cells)  # the site shows these
    where = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=900, resources=where).execute()


@pytest.mark.parametrize(
    ("race", "traj", "losses"),
    [
        ("nominal", "s", {5: (1.44, 5.83), 10: (1.44, 4.23), 25: (1.42, 2.66), 50: (1.38, 2.17)}),
        ("nominal", "s", {100: (1.33, 1.59), 200: (1.30, 1.53)}),
        ("shared_mean-200", "s", {50: (1.41, 1.50), 100: (1.38, 1.43), 200: (1.34, 1.40)}),
        (
            "shared_mean-s",
            "s",
            {5: (1.54, 1.82), 10: (1.49, 1.69), 25: (1.43, 1.63), 50: (1.40, 1.49)},
        ),
        ("drake", "s", {5: (1.54, 7.17), 25: (1.49, 3.85)}),
        ("humanoid", "straight", {5: (1.34, 1.40), 10: (1.29, 1.32)}),
    ],
)
def test_the_race_is_told_as_its_files_have_it(race, traj, losses):
    methods = json.loads((DOCS / "race" / race / "race.json").read_text())[traj]
    page = (DOCS / "notes.md").read_text().partition("## Race against searches")[2]
    page = page.partition("\n## ")[0]
    for walks, told in losses.items():
        median = {name: np.median(each["own"][str(walks)]) for name, each in methods.items()}
        ours = next(name for name in median if name.endswith(" walks"))
        best = min(loss for name, loss in median.items() if name != ours)
        assert [f"{loss / 1e6:.2f}" for loss in (median[ours], best)] == [f"{x:.2f}" for x in told]
        assert all(f" {value:.2f}" in page for value in told)
    assert not any(methods[ours]["falls"])


def test_the_race_on_other_plants_is_told_as_its_file_has_it():
    races = json.loads((DOCS / "race" / "shared_mean" / "race.json").read_text())
    page, told = (DOCS / "notes.md").read_text(), {}
    for walks in ("0", "5", "10", "25", "50"):
        cells = []
        for plants in ("own", "others"):
            for traj in ("straight", "c", "s"):
                losses = {n: np.median(r[plants][walks]) / 1e6 for n, r in races[traj].items()}
                ours = losses.pop("shared_mean walks")
                best = min(losses.values())
                told[plants, traj, walks] = ours
                cells.append(f"{ours:.2f}" if walks == "0" else f"{ours:.2f}, {best:.2f}")
        assert f"| {walks} | {' | '.join(cells)} |" in page, cells


def test_what_a_part_is_worth_is_told_as_its_file_has_it():
    parts = json.loads((DOCS / "race" / "parts" / "race.json").read_text())["s"]
    page = " ".join((DOCS / "notes.md").read_text().split())
    names = {
        "walks": "all of it",
        "no grounding": "without grounding",
        "no gradients": "without the model's gradients",
        "no metric": "without the metric",
        "no surrogate": "without the surrogate",
        "no evolution": "without evolution",
    }
    for method, words in names.items():
        losses = parts[f"shared_mean {method}"]["own"]
        told = re.search(rf"{words} ([\d. ]+\d)", page).group(1).split()
        assert told == [f"{np.median(losses[n]) / 1e6:.2f}" for n in ("5", "10", "25", "50")]


def test_the_table_of_the_search_over_many_plants_is_that_of_its_walks():
    walks = json.loads((DOCS / "results/many-plants/walks.json").read_text())
    pushed, losses = walks["s_100_N"], walks["L"]
    page = (DOCS / "results.md").read_text().split("\n## A search over many plants\n")[1]
    nominal, best = (np.array([*losses[name].values()]) for name in ("nominal", "best"))
    assert f"| nominal | | 0 | 0 | 0 | | {pushed['falls']['nominal']} | 1 |" in page
    for name in losses.keys() - {"nominal", "expert"}:
        L = np.array([*losses[name].values()])
        medians = [f"{x:.0f}" for x in 100 * (np.median(L / nominal, axis=1) - 1)]
        means = " ".join(f"{x:.0f}" for x in 100 * np.expm1(np.log(L / best).mean(axis=1)))
        end = ["", ""]
        if name in pushed["falls"]:
            end = [pushed["falls"][name], f"{pushed['L_ratio_where_both_stay_up'][name]:.2f}"]
        cells = [*medians, means, *end]
        row = re.search(rf"^\| {name} \| [\d,]+ \| (.*) \|$", page, re.MULTILINE).group(1)
        assert [cell.strip() for cell in row.split("|")] == [str(cell) for cell in cells]
    there = {n: np.array([*x.values()]) for n, x in walks["L_where_searched"].items()}
    ratios = {name: np.median(L / there["nominal"], axis=1) for name, L in there.items()}
    of_weights, of_all = (
        " ".join(f"{x:.0f}" for x in 100 * (ratios[name] - 1)) for name in ("search", "search_all")
    )
    assert f"is {of_weights} (weights) and {of_all} % (all)" in page


@pytest.mark.slow
def test_the_example_tunes_in_25_lines_and_walks_better():
    example = ROOT / "examples" / "tune.py"
    assert len(example.read_text().splitlines()) <= 25
    shown = subprocess.run(
        [sys.executable, example], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    row = r"^(\w+): ([\d.]+) cm off, ([\d.]+) degrees in pitch, fell: False$"
    rows = re.findall(row, shown, re.MULTILINE)
    assert [name for name, *_ in rows] == ["plain", "tuned"]
    for plain, tuned in zip(rows[0][1:], rows[1][1:], strict=True):
        assert float(tuned) < float(plain)
