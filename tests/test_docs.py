"""What the pages say can be done: examples run, commands parse, the site needs no network."""

import ast
import doctest
import functools
import importlib
import itertools
import json
import pkgutil
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from delay import AS_PROPOSED, BEFORE

import hector_jax
from hector_jax.cli import flags, parse
from hector_jax.control.controller import walk_config
from hector_jax.control.parameters import TUNABLES
from hector_jax.control.reference import COMMANDS
from hector_jax.control.weights import nominal
from hector_jax.control.weights_file import best
from hector_jax.core.tree_file import tree_hash
from hector_jax.robot.model import load_robot
from hector_jax.sim.margin import delay_lines

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
REPORTS = ROOT / "experiments" / "reports"
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


SHOWN = [  # of some a gradient has to be compiled
    pytest.param(p, id=p.stem, marks=[pytest.mark.slow] * (p.stem in ("tutorial", "loss")))
    for p in PAGES
    if ">>>" in p.read_text()
]


@pytest.mark.parametrize("page", SHOWN)
def test_examples_in_pages_say_what_comes_out(page):
    run_examples("\n".join(blocks(page.read_text(), "python")), {}, page.stem)


def lines_of(path, program):
    """Calls of a program in a page, of the blocks that are fenced or indented."""
    text = path.read_text()
    lines = [line for block in blocks(text) for line in block.splitlines()]
    lines += re.findall(rf"^    ({program} .*)$", text, re.MULTILINE)
    lines = [line.strip().removeprefix(".venv/bin/") for line in lines]
    return [line for line in lines if line.startswith(f"{program} ") and "<" not in line]


CALLS = sorted({(path.name, line) for path in READ for line in lines_of(path, "hector")})
NAMED = sorted({n for path in READ for n in re.findall(r"`hector ([a-z]+)", path.read_text())})


@pytest.mark.parametrize("name", NAMED)
def test_commands_that_pages_name_are_there(name):
    assert name in flags.COMMANDS


@pytest.mark.parametrize(("page", "line"), CALLS)
def test_commands_in_pages_parse(page, line, capsys):
    words = shlex.split(line, comments=True)[1:]
    if "--config" in words:  # a file of the reader's
        at = words.index("--config")
        del words[at : at + 2]
    code = 0
    try:
        parse.from_line(words)
    except SystemExit as left:  # after --help, too
        code = left.code
    assert code == 0, capsys.readouterr().err


def test_the_tests_behind_the_promises_are_there():
    page, there = (DOCS / "reliability.md").read_text(), {}
    for name, test, more in re.findall(r"(test_\w+)\.py(?:::(test_\w+)(\.\.\.)?)?", page):
        text = there.setdefault(name, (ROOT / "tests" / f"{name}.py").read_text())
        assert f"def {test}" + ("" if more or not test else "(") in text, (name, test)
    assert len(there) > 15


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


@pytest.mark.parametrize("path", READ, ids=lambda path: path.stem)
def test_files_that_pages_name_are_there(path):
    named = re.findall(r"\b(?:experiments|examples|assets)/[\w/.-]+\.\w+", path.read_text())
    assert [name for name in named if not (ROOT / name).exists()] == []


FORMER = re.compile(r"(mean|worst)[- ]of[- ]all|\bceiling\b|integral-best-limited", re.I)


def test_a_weight_set_has_one_name():
    kinds = {".j2", ".json", ".md", ".png", ".py", ".webp"}
    folders = (DOCS, ROOT / "experiments", ROOT / "hector_jax")
    files = [p for folder in folders for p in folder.rglob("*") if p.suffix in kinds]
    files = [path for path in files if not MADE & set(path.parts)]
    assert len(files) > 200
    for path in [ROOT / "README.md", ROOT / "Makefile", *files]:
        text = "" if path.suffix in (".png", ".webp") else path.read_text()
        found = FORMER.search(path.name + "\n" + text)
        assert not found, (path, found)


def test_the_page_of_commands_is_written_from_the_code():
    page = runpy.run_path(str(DOCS / "commands.py"))["page"]()
    assert (DOCS / "commands.md").read_text() == page, "run python docs/commands.py"


def test_tests_that_pages_name_are_there():
    text = "\n".join(path.read_text() for path in PAGES)
    named = set(re.findall(r"(test_\w+\.py)::(test_\w+)", text))
    assert len(named) > 10
    for file, name in sorted(named):  # `test_a_name...` stands for the tests that begin so
        assert f"\ndef {name}" in (ROOT / "tests" / file).read_text(), f"{file}::{name}"


def report(name):
    return json.loads((REPORTS / name).read_text())


@functools.cache
def sets(trajectory):
    """Results of the sets on the stand-in."""
    every = report(f"best/{trajectory}.json")["sets"]
    return {name: one["standin"] for name, one in every.items()}


def row(*cells):
    return f"| {' | '.join(cells)} |"


def rms(one):
    """Errors [cm] in the plane and of the height, and of roll, pitch and yaw [degrees]."""
    x, y, z = 100 * np.array(one["rms"]["position"])
    return np.hypot(x, y), z, *np.degrees(one["rms"]["euler"])


def smoothness(name):
    """L_ctrl against that of expert by trajectory: between the switches, and the whole [%]."""
    for trajectory in COMMANDS:
        both = [sets(trajectory)[one] for one in (name, "expert")]
        between = [one["L_ctrl"]["mean"] - one["L_ctrl_switching"] for one in both]
        whole = [one["L_ctrl"]["mean"] for one in both]
        yield between[0] / between[1], round(100 * (whole[0] / whole[1] - 1))


def interval(change, sign=""):
    return "{median:{s}.0f} [{low:{s}.0f}, {high:{s}.0f}]".format(**change, s=sign)


def tracking():
    """What the page of results says of tracking, loss and smoothness."""
    count = {len(one["seeds"]) for t in COMMANDS for one in sets(t).values()}
    assert sum(one["falls"] for t in COMMANDS for one in sets(t).values()) == 0
    yield f"on {count.pop()} plants of the hardware stand-in"
    for name in ("nominal", "expert", "without", "with", "best"):
        errors = [rms(sets(t)[name]) for t in COMMANDS]
        yield row(f"`{name}`", *(f"{e[0]:.1f} cm, {e[1]:.1f} cm, {e[3]:.1f}°" for e in errors))
    for trajectory in COMMANDS:
        start, tuned = (rms(sets(trajectory)[name]) for name in ("nominal", "best"))
        assert tuned[0] < start[0] / 2
        assert tuned[3] < start[3] / 3
    yaw = [rms(sets("s")[name])[4] for name in ("best", "expert")]
    yield f"on S it is off by {yaw[0]:.1f}°, with `expert` by {yaw[1]:.1f}°"
    for name, base in itertools.product(("without", "with", "best"), ("nominal", "expert")):
        changes = [sets(t)[name]["change"][base] for t in COMMANDS]
        assert all(change["counts"] for change in changes)
        yield row(f"`{name}`", f"`{base}`", *map(interval, changes))
    integral = report("integral.json")["sets"]
    yield f"On {len(integral['s']['best']['seeds'])} more plants L changes"
    rows = {
        "nominal with others of best": ("`nominal`", "those of `best`"),
        "with": ("`with`", "none"),
        "best": ("`best`", "its own"),
    }
    for name, head in rows.items():
        yield row(*head, *(interval(integral[t][name]["change"]["nominal"]) for t in COMMANDS))
    for name in ("nominal", "without", "with", "best"):
        cells = smoothness(name)
        yield row(f"`{name}`", *(f"{x:.1f} times, {y:{'+' * bool(y)}} %" for x, y in cells))


DISTURBANCES = {
    "push of 50 N for a tenth of a second": "push 50 N",
    **{f"push of {force} N": f"push {force} N" for force in (75, 100, 125)},
    "floor that turns to a friction of 0.55 to 0.4": r"friction 0\.(55|5|45|4)",
    **{f"floor that turns to {mu}": f"friction {mu}" for mu in (0.35, 0.3)},
    "slope, payload, late motors": "(slope|payload|delay) .*",
    "all": ".*",
}


def disturbances():
    """What the page of results says of disturbances."""
    cells = report("robustness/robustness.json")["cells"]
    assert report("robustness/robustness.json")["weights"]["best"] == tree_hash(best())
    for text, level in DISTURBANCES.items():
        chosen = [one["sets"] for one in cells if re.fullmatch(level, one["level"])]
        counts = [sum(one["best"]["walks"] for one in chosen)]
        counts += [sum(one[name]["falls"] for one in chosen) for name in ("nominal", "best")]
        yield row(text, *map(str, counts))
    assert report("robustness/robustness.json")["totals"]["best"]["falls_more"] == []
    yield f"Of {len(cells)} kinds of scenes"


def few_walks():
    """What the page of results says of the race."""
    methods = report("race/nominal/race.json")["s"]
    at = {n: [np.median(r["own"][w]) / 1e6 for w in ("0", "5", "200")] for n, r in methods.items()}
    start, five, last = at.pop("nominal walks")
    rival = min(losses[-1] for losses in at.values())
    yield f"From an L of {start:.2f}e6 it reaches {five:.2f}e6 after five walks"
    yield f"and {last:.2f}e6 after 200. The best of three"
    yield f"then has {rival:.2f}e6."


PUBLISHED = {
    "spot": "Spot",
    "go2": "Unitree Go2",
    "go1": "Unitree Go1",
    "t1": "Booster T1",
    "b2": "Unitree B2",
    "anymal_b": "ANYmal B",
    "anymal_c": "ANYmal C",
    "adam_lite": "Adam Lite",
    "g1": "Unitree G1",
}


def robots():
    """What the page of results says of other robots."""
    results = report("robots/robots.json")

    def cell(of, world):
        start, tuned = (of["sets"][name][world] for name in ("nominal", "best"))
        text, falls = interval(tuned["change"]["nominal"], "+"), (start["falls"], tuned["falls"])
        return (
            text if falls == (0, 0) else f"{text}; nominal fell {falls[0]} times, `best` {falls[1]}"
        )

    names = {"go2": "Unitree Go2", "h1": "Unitree H1"}
    for robot in ("quadruped", "go2", "humanoid", "h1"):
        cells = [cell(results["all"][robot][traj], "standin-even") for traj in COMMANDS]
        yield row(names.get(robot, f"`examples/{robot}`"), *cells)
    tuned = results["all"]["humanoid"]["straight"]["sets"]["best"]["standin-even"]
    plants = len(tuned["seeds"])
    yield f"on {plants} plants of `standin-even`"
    worse = round(plants * (1 - tuned["change"]["nominal"]["wins"]))
    yield f"with `nominal` on {worse} plant of {plants}"
    more = results["more_on_s"]
    falls = [
        more[robot]["sets"][name]["standin-even"]["falls"]
        for robot, name in itertools.product(("quadruped", "go2"), ("nominal", "best"))
    ]
    yield f"On {len(more['go2']['sets']['best']['standin-even']['seeds'])} more plants"
    told = (
        "the quadruped falls {} time with `nominal` and {} times with `best`, Go2 {} and {} times"
    )
    yield told.format(*falls)
    drake = [one["sets"] for runs in results["drake"].values() for one in runs.values()]
    medians = [one["best"]["standin-even"]["change"]["nominal"]["median"] for one in drake]
    yield f"on {len(drake[0]['best']['standin-even']['seeds'])} of the plants, the medians are"
    yield f"{min(medians):.0f} to {max(medians):.0f} %"
    fell = {name: sum(one[name]["standin-even"]["falls"] for one in drake) for name in drake[0]}
    assert fell == {"nominal": 0, "best": 1}
    assert results["drake"]["humanoid"]["s"]["sets"]["best"]["standin-even"]["falls"] == 1
    yield "the humanoid falls 1 time on S with `best`"
    for robot, name in PUBLISHED.items():
        runs = results["straight"][robot]
        tuned = runs["straight"]["sets"]["best"]["standin"]
        falls = [runs[traj]["sets"]["nominal"]["standin"]["falls"] for traj in ("c", "s")]
        yield row(name, interval(tuned["change"]["nominal"], "+"), "{}, {}".format(*falls))
        assert tuned["falls"] == 0
    yield f"on {len(tuned['seeds'])} plants of the stand-in, without a fall"


def engines():
    """What the page of results says of other engines."""
    result = report("verdict/verdict.json")
    of = result["sets"]["best"]
    for base in ("nominal", "expert"):
        one = of["against"][base]
        yield f"below `{base}` in {one['below']} of {one['cells']} cases"
    falls = {name: one["falls"] for name, one in result["sets"].items()}
    yield f"falls in {falls['best']} of {of['walks']} walks, `nominal` in {falls['nominal']}"


def limits():
    """What the page of limits says."""
    tuned, paper = ([one for one, _ in smoothness(name)] for name in ("best", "with"))
    yield f"{min(tuned):.1f} to {max(tuned):.1f} times those of `expert` with `best`"
    yield f"{min(paper):.1f} to {max(paper):.1f} times with `with`"
    yield f"at most {max(whole for _, whole in smoothness('best'))} % above"
    touch = [sets("s")[name]["legs_touch"] for name in ("best", "nominal")]
    walked = 4 * len(sets("s")["best"]["seeds"])
    yield f"for {touch[0]:.1f} s of {walked} s, with `nominal` for {touch[1]:.1f} s"
    cells = report("robustness/robustness.json")["cells"]
    scenes = {f"{c['traj']} {c['world']} {c['level']}": c["sets"] for c in cells}
    texts = {
        ".* push 125 N": "Under 125 N `best` falls in {} of {} walks, and `nominal` in {}",
        "s standin push (?!125).*": "50 to 100 N on S `best` falls in {} of {}, `nominal` in {}",
        "s .* friction 0.3": "0.3 both fall in most walks: `best` in {} of {}, `nominal` in {}",
    }
    for pattern, text in texts.items():
        chosen = [one for name, one in scenes.items() if re.fullmatch(pattern, name)]
        walks, falls = (
            {name: sum(one[name][what] for one in chosen) for name in ("best", "nominal")}
            for what in ("walks", "falls")
        )
        yield text.format(falls["best"], walks["best"], falls["nominal"])


def test_each_number_of_results_and_limits_is_that_of_its_file():
    results = (*tracking(), *disturbances(), *few_walks(), *robots(), *engines(), "95 %")
    for page, told in {
        "results.md": results,
        "limits.md": (*limits(), "Python 3.11 to 3.13", "64 bits"),
    }.items():
        text = " ".join((DOCS / page).read_text().split())
        for words in told:
            assert words in text, f"{page} must say: {words}"
            text = text.replace(words, "")
        rest = re.sub(r"\]\([^)]*\)|`[^`]*`|\b[GH][o0-9]2?\b", "", text)
        assert re.findall(r"\S*\d\S*", rest) == [], page  # numbers that no file is behind


def shown_numbers(trajectory, name):
    """All numbers that a table may show of a set."""
    one, changes = sets(trajectory)[name], sets(trajectory)[name]["change"]
    numbers = {f"{x:.1f}" for x in (*rms(one), *(100 * x for x in one["rms"]["position"]))}
    whole = [x for c in changes.values() for x in (c["median"], c["low"], c["high"])]
    return numbers | {f"{x:.0f}" for x in whole} | {str(len(one["seeds"])), str(one["falls"])}


def test_the_tables_of_the_readme_are_those_of_the_results():
    words = {"plain": "nominal", "laboratory": "expert", "lab's": "expert", "tuned": "best"}
    checked = 0
    for table in re.findall(r"(?:^\|.*\|\n)+", (ROOT / "README.md").read_text(), re.MULTILINE):
        head, _, *lines = [line.strip("|\n").split("|") for line in table.splitlines()]
        columns = [re.search(r"\b(straight|[CS])\b", cell, re.I) for cell in head]
        for name, *cells in lines if sum(map(bool, columns[1:])) > 2 else ():
            named = re.search(r"`(\w+)`", name)
            at = (named[1],) if named else [s for word, s in words.items() if word in name.lower()]
            if at and at[0] in sets("s"):
                for column, cell in zip(columns[1:], cells, strict=True):
                    shown = re.findall(r"-?\d+(?:\.\d+)?", cell) if column else []
                    there = shown_numbers(column[1].lower(), at[0]) if column else set()
                    assert set(shown) <= there, (name, cell)
                    checked += len(shown)
    assert checked > 8


def test_the_figures_of_the_paper_stand_beside_ours():
    page = (DOCS / "paper.md").read_text()
    losses = report("paper.json")["losses"]
    for traj, name in {"straight": "straight", "c": "C curve", "s": "S curve"}.items():
        of = {who: x["L"] for who, x in losses[traj].items()}
        pairs = [
            (100 * (of["with"] / of[base] - 1), sets(traj)["with"]["change"][base]["median"])
            for base in ("nominal", "expert")
        ]
        assert row(name, *(f"{x:.0f}" for pair in pairs for x in pair)) in page


def test_the_figures_of_notes_and_performance_are_those_of_their_files():
    notes = " ".join((ROOT / "experiments" / "notes.md").read_text().split())
    walks = report("many-plants/walks.json")["L"]
    best_of_then, searched = (np.array([*walks[name].values()]) for name in ("best", "search"))
    lower = -100 * np.expm1(np.log(searched / best_of_then).mean(axis=1))
    assert "by {:.0f}, {:.0f} and {:.0f} % on straight, C and S".format(*lower) in notes
    rows = report("transfer/transfer.json")["rows"]
    told = {
        "net": "gives cosines of {} on straight, C and S at nominal weights",
        "paper": "the paper's net {} with wide intervals",
        "command": "no net {} ([report]",
        "net without legs": "Without that part the cosines are {}.",
    }
    for kind, words in told.items():
        cosines = [f"{rows[traj][kind]['cosine']['value']:.2f}" for traj in COMMANDS]
        assert words.format("{}, {} and {}".format(*cosines)) in notes
    straight = f"{rows['straight']['net']['cosine']['value']:.2f} at nominal on straight"
    assert straight in (DOCS / "decisions-tuning.md").read_text()
    page = (DOCS / "performance.md").read_text()
    files = [report(f"performance/{name}.json") for name in ("qp_layer", "closed_loop")]
    rows = {r[0]: r for f in files for section in f["sections"].values() for r in section["rows"]}
    qp, many = rows["ours f64, lax.map"], rows["256 rollouts at once, 400 ticks"]
    times = [qp[1], qp[3], rows["DAQP"][1], rows["jaxopt BoxOSQP 1e-5, lax.map"][3]]
    told = [f"{time} us" for time in times]
    told.append("{} ms, {} ms of processor time".format(*rows["CPU"][1:3]))
    told.append(f"{rows['1 rollout, 400 ticks, cold cache'][2]} s of processor time")
    told.append(f"{float(many[2]):.0f} s of processor time, {float(many[3]):.1f} GiB")
    assert re.findall(r"^\|.* \| (.*) \|$", page, re.MULTILINE)[1:] == told


def words(path):  # a bar of a table is no word
    return sum(any(map(str.isalnum, word)) for word in path.read_text().split())


def test_pages_keep_their_budgets():
    count = {page: words(page) for page in PAGES if page.stem != "commands"}
    assert sum(count.values()) <= 16_000
    assert {page.name: n for page, n in count.items() if n > 1200} == {}
    assert sum(n for page, n in count.items() if page.stem.startswith("decisions")) <= 2500
    for name, most in {"CHANGELOG.md": 900, "experiments/notes.md": 2500}.items():
        assert words(ROOT / name) <= most, name
    assert sum(path.is_file() for path in REPORTS.rglob("*")) <= 40
    for page in PAGES:
        heads = re.findall(r"^\s*\|(?:---\|)+", page.read_text(), re.MULTILINE)
        assert max((head.count("---") for head in heads), default=0) <= 5, page


@pytest.mark.parametrize("path", READ, ids=lambda path: path.stem)
def test_pages_have_no_history_and_read_well_on_github(path):
    text = path.read_text()
    assert not re.search(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,40}\b", text)  # a commit
    assert path not in PAGES or not re.search(r"\bseeds \d+-\d", text)
    raw = set(re.findall(r"(?:^```|(?<!\w))\{([\w-]+)\}(?:`|$)", text, re.MULTILINE))
    assert raw <= ({"toctree"} if path.stem == "index" else set())


def slugs(path):
    heads = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


def test_links_lead_somewhere():
    files = [*READ, ROOT / "CHANGELOG.md", *(ROOT / "experiments").rglob("*.md")]
    for path in files:
        for link in re.findall(r"\]\(([^)\s]+)\)", path.read_text()):
            name, _, anchor = link.partition("#")
            there = path.parent / name if name else path
            if "://" not in link:
                assert there.exists(), f"{path.name}: {link}"
                assert not anchor or anchor in slugs(there), f"{path.name}: {link}"


def test_names_of_the_code_in_pages_are_there():
    for name in {n for p in PAGES for n in re.findall(r"`(hector_jax(?:\.\w+)+)`", p.read_text())}:
        pkgutil.resolve_name(name)


def test_the_page_shows_the_file_of_the_slalom():
    page = (DOCS / "howto" / "trajectory.md").read_text()
    assert blocks(page, "toml") == [(ROOT / "examples" / "slalom.toml").read_text()]


def test_the_table_of_late_motors_is_that_of_its_reports():
    page = (DOCS / "decisions.md").read_text()
    table = page.partition("| robot, trajectory | controller |")[2].partition("\n\n")[0]
    shown = [line.split("|")[2:-1] for line in table.splitlines()[2:]]
    expected = []
    for robot in ("quadruped", "quadruped-s", "humanoid"):
        numbers = report(f"delay/{robot}/delay.json")
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
