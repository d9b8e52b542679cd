"""What the pages say is so: examples run, commands parse, each figure is that of its file."""

import ast
import collections
import contextlib
import doctest
import functools
import importlib
import itertools
import json
import pkgutil
import re
import runpy
import shlex
import tomllib
from dataclasses import fields
from pathlib import Path
from unittest import mock

import jax
import numpy as np
import pytest
from delay import AS_PROPOSED, BEFORE
from diagrams import CHOICES
from pretend import pretend_verdict, python

from hector_jax import load_robot, nominal, walk_config
from hector_jax.cli import flags, parse
from hector_jax.control.parameters import TUNABLES, Q, R, check_in_box
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights_file import load_weights, shipped
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import tree_hash
from hector_jax.sim.margin import delay_lines
from hector_jax.store.nets import CollectConfig
from hector_jax.verdict import foretell
from hector_jax.walk_tuning import best_set
from hector_jax.walk_tuning.starts import START_PLANTS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
REPORTS = ROOT / "experiments" / "reports"
README, RESULTS, LIMITS = ROOT / "README.md", DOCS / "results.md", DOCS / "limits.md"
PAGES = sorted(p for p in DOCS.rglob("*.md") if not {"_build", "reference"} & set(p.parts))
READ = [README, ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *PAGES]


def blocks(text, language=""):
    fenced = re.findall(r"^```(.*)\n((?:.*\n)*?)```$", text, re.MULTILINE)
    return [block for kind, block in fenced if kind == language]


def examples():
    """Those of docstrings, which are read from the source that no wrapper hides, and of pages."""
    for path in sorted((ROOT / "hector_jax").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                text = ast.get_docstring(node) or ""
                if ">>>" in text:
                    yield pytest.param(name, text, id=f"{name}.{getattr(node, 'name', '')}")
    for path in PAGES:
        if ">>>" in path.read_text():
            # of some a gradient has to be compiled
            marks = [pytest.mark.slow] * (path.stem in ("tutorial", "loss"))
            text = "\n".join(blocks(path.read_text(), "python"))
            yield pytest.param(None, text, id=path.stem, marks=marks)


@pytest.mark.parametrize(("module", "text"), list(examples()))
def test_examples_say_what_comes_out(module, text):
    names = dict(vars(importlib.import_module(module))) if module else {}
    example = doctest.DocTestParser().get_doctest(text, names, "example", None, None)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    with mock.patch.dict(TUNABLES):  # to which a page adds one of its own
        runner.run(example)
    assert runner.tries
    assert not runner.failures


def lines_of(path, program):
    """Calls of a program in a page, of the blocks that are fenced or indented."""
    text = path.read_text()
    lines = [line for block in blocks(text) for line in block.splitlines()]
    lines += re.findall(rf"^    ({program} .*)$", text, re.MULTILINE)
    lines = [line.strip().removeprefix(".venv/bin/") for line in lines]
    return [line for line in lines if line.startswith(f"{program} ") and "<" not in line]


@pytest.mark.parametrize("path", READ, ids=lambda path: path.stem)
def test_commands_of_a_page_parse_and_what_it_names_is_there(path, capsys):
    """Commands, targets of make, and tests."""
    codes = {}
    for line in lines_of(path, "hector"):
        words = shlex.split(line, comments=True)[1:]
        if "--config" in words:  # a file of the reader's
            at = words.index("--config")
            del words[at : at + 2]
        try:
            asked = parse.from_line(words)
        except SystemExit as left:  # after --help, too
            codes[line] = left.code
            continue
        given = (getattr(asked, flag, ()) for flag in ("weights", "start", "walked"))
        for text in (x for one in given for x in ([one] if isinstance(one, str) else one)):
            file = flags.named_file(str(text))[1]
            assert file in flags.NAMED_WEIGHTS or Path(file).suffix or "/" in file, line
    assert not any(codes.values()), (codes, capsys.readouterr().err)
    text = path.read_text()
    named = set(re.findall(r"`hector ((?:(?:log|steps) )?[a-z]+)", text))
    assert named <= flags.COMMANDS.keys()
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for line in lines_of(path, "make"):
        words = shlex.split(line, comments=True)[1:]
        assert {word for word in words if "=" not in word} <= targets, line
    for name, test, more in re.findall(r"(test_\w+)\.py(?:::(test_\w+)(\.\.\.)?)?", text):
        tests = (ROOT / "tests" / f"{name}.py").read_text()
        assert f"def {test}" + ("" if more or not test else "(") in tests, (name, test)


def test_commands_of_the_tree_parse():
    for *_, commands in CHOICES:
        for line in commands:
            program, *words = line.split()
            assert program == "hector"
            parse.from_line(words)


PACKAGE = ROOT / "hector_jax"
FOREIGN = {"help", "help-all", "no-NAME", "tyro-print-completion"}
FOREIGN |= {"nworkers", "nthreads", "inplace", "xla", "param-file", "paths"}
TABLES = {
    "feet",
    "joints",
    "limits",
    "loss",
    "numbers",
    "plants",
    "slip",
    "tuning",
    "twin",
    "weights",
}
TABLES |= {"footstep", "gait", "legs", "mpc"}  # of a robot's file
MEANS = {"footstep": "FootstepConfig", "gait": "GaitConfig", "legs": "LegConfig"}
MEANS |= {"mpc": "MpcConfig", "slip": "SlipConfig", "tuning": "TuningSettings"}
MEANS |= {"effect": "Wrench", "contact": "Wrench", "reference": "State", "weights": "Weights"}


def sentences():
    """Files with what they tell: pages, templates, texts and comments of the code."""
    for path in [*READ, *sorted(PACKAGE.rglob("*.j2"))]:
        yield path, [path.read_text()]
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text()
        nodes = ast.walk(ast.parse(text))
        told = [x.value for x in nodes if isinstance(x, ast.Constant) and isinstance(x.value, str)]
        comments = re.findall(r"(?:^ *#.*\n)+|#.*$", text, re.MULTILINE)
        yield path, told + [comment.replace("#", " ") for comment in comments]


@functools.cache
def known_flags():
    """Of `hector`, and of the scripts."""
    known = {flag.name for command in flags.COMMANDS.values() for flag in fields(command)}
    for path in [*ROOT.glob("experiments/*.py"), *ROOT.glob("benchmarks/*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                known |= {x.target.id for x in node.body if isinstance(x, ast.AnnAssign)}
            elif isinstance(node, ast.FunctionDef):
                known |= {x.arg for x in (*node.args.args, *node.args.kwonlyargs)}
    return {name.replace("_", "-") for name in known}


@functools.cache
def names_inside():
    """Names that modules and classes of the package have, by the last part of theirs."""
    inside = collections.defaultdict(set)
    for path in PACKAGE.rglob("*.py"):
        inside[path.parent.name].add(path.stem)
        tree = ast.parse(path.read_text())
        for node in (tree, *(x for x in ast.walk(tree) if isinstance(x, ast.ClassDef))):
            module = path.parent.name if path.stem == "__init__" else path.stem
            names = inside[getattr(node, "name", module)]
            for child in node.body:
                targets = getattr(child, "targets", [getattr(child, "target", child)])
                names |= {getattr(x, "name", getattr(x, "id", "")) for x in targets}
                names |= {x.asname or x.name for x in getattr(child, "names", []) if x != "*"}
    return inside


def is_there(name):
    """Tell whether `a.b` is of a module or class, a robot's file, a log or a file that is written.

    What begins with a name that is none of ours may be anything.
    """
    first, second, *_ = name.split(".")
    inside = names_inside()
    if first == "hector_jax":
        with contextlib.suppress(AttributeError, ImportError):
            return pkgutil.resolve_name(name) is not None
        return False
    if first not in inside.keys() | MEANS.keys():
        return True
    if second in inside.get(first, set()) | inside.get(MEANS.get(first, ""), set()):
        return True
    code = (path.read_text() for path in PACKAGE.rglob("*.py"))
    word = re.escape(second if first == "loss" else name)
    return any(re.search(rf"[\"/]{word}\"", text) for text in code)


def test_flags_sections_files_and_names_that_anything_tells_are_there():
    missing = []
    for path, texts in sentences():
        for text in texts:
            told = set(re.findall(r"(?<![\w-])--([a-z](?:[a-zA-Z-]*[a-zA-Z])?)", text)) - FOREIGN
            told = {flag for flag in told if flag.removeprefix("no-") not in known_flags()}
            if path.name != "environment.py":  # which asks git
                missing += [(path.name, f"--{flag}") for flag in told]
            heads = re.findall(r"`\[(\w+)\]`", text)
            missing += [(path.name, x) for x in heads if x not in TABLES]
            folders = "docs|hector_jax|tests|experiments|examples|assets|benchmarks"
            files = re.findall(rf"\b(?:{folders})/[\w/.-]*\w\.\w+", text)
            missing += [(path.name, file) for file in files if not (ROOT / file).exists()]
            names = re.findall(r"`((?:[a-zA-Z]\w*\.)+[a-zA-Z]\w*)`", text)
            missing += [(path.name, name) for name in names if not is_there(name)]
    assert missing == []


def test_a_page_that_code_cites_has_words_of_the_sentence_that_cites_it():
    """A third of the long ones at least; an ending may differ."""
    cited = 0
    for path, texts in sentences():
        for text in texts if path.suffix == ".py" else ():
            for found in re.finditer(r"docs/[\w/-]+\.md", text):
                sentence = re.split(r"\.\s|\n\n", text[: found.start()])[-1]
                long = {word[:6].lower() for word in re.findall(r"[A-Za-z]{6,}", sentence)}
                page = (ROOT / found.group()).read_text().lower()
                there = [word for word in long if word in page]
                assert 3 * len(there) >= len(long), (path.name, found.group(), long - set(there))
                cited += 1
    assert cited > 5


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


def test_each_page_is_two_links_from_readme():
    pages, reached = {README}, {README}
    for _ in range(2):
        links = [(p, one) for p in pages for one in re.findall(r"\]\(([^)#\s]+)", p.read_text())]
        pages = {(path.parent / link).resolve() for path, link in links} & {*READ}
        reached |= pages
    assert {*PAGES} <= reached


def test_what_pages_show_of_files_and_code_is_what_is_there(tmp_path):
    page = runpy.run_path(str(DOCS / "commands.py"))["page"]()
    assert (DOCS / "commands.md").read_text() == page, "run python docs/commands.py"
    slalom = blocks((DOCS / "howto" / "trajectory.md").read_text(), "toml")
    assert slalom == [(ROOT / "examples" / "slalom.toml").read_text()]
    (told,) = blocks((DOCS / "howto" / "outputs.md").read_text(), "toml")
    (tmp_path / "night.toml").write_text(told)
    assert parse.from_file(flags.Tune, tmp_path / "night.toml").seeds == 32
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


def test_the_file_of_another_mpc_that_a_page_shows_is_read_and_tuned_from(tmp_path):
    shown, part = blocks((DOCS / "howto" / "numbers.md").read_text())
    robot, file = load_robot(ROOT / "examples" / "quadruped" / "robot.toml"), tmp_path / "mine.cpp"
    file.write_text(shown)
    weights = load_weights(file, robot)
    assert weights.Q.ang_velocity.tolist() == [0.01, 0.01, 0.3]
    assert {*weights.R.force.ravel()} == {4e-5}
    check_in_box(weights)  # whose bounds the page has
    assert (Q.lower, Q.upper, R.lower, R.upper) == (0.01, 1e4, 1e-7, 1.0)
    for text, refused in {
        shown.replace("0.01, 0.01", "0, 0"): "Q.ang_velocity must be a number from",
        shown.replace("[all][all]", "[all]"): "takes 3 numbers, found 1",
        part: "missing weight",
    }.items():
        file.write_text(text)
        with pytest.raises(InputError, match=refused):
            load_weights(file, robot)


def words(text):  # a bar of a table is no word
    return sum(any(map(str.isalnum, word)) for word in text.split())


def test_pages_keep_their_budgets():
    count = {page: words(page.read_text()) for page in PAGES if page.stem != "commands"}
    assert sum(count.values()) <= 18_000
    assert {page.name for page, n in count.items() if n > 1200} <= {"decisions.md"}
    assert count[DOCS / "decisions.md"] <= 2000
    for name, most in {"CHANGELOG.md": 900, "experiments/notes.md": 2500}.items():
        assert words((ROOT / name).read_text()) <= most, name
    assert sum(path.is_file() for path in REPORTS.rglob("*")) <= 40
    for page in PAGES:
        heads = re.findall(r"^\s*\|(?:---\|)+", page.read_text(), re.MULTILINE)
        assert max((head.count("---") for head in heads), default=0) <= 5, page
    readme = README.read_text()
    assert readme.count("\n") <= 130
    assert words(readme) <= 900
    prose = re.sub(r"\]\([^)]*\)|```(?:python|bibtex).*?```", "", readme, flags=re.DOTALL)
    assert len(re.findall(r"(?<![\w.])\d+(?:\.\d+)*", prose)) <= 70
    assert not re.search(r"\bseeds?\b|\[-?\d+, -?\d+\]", readme)


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
    """Errors [cm] in the plane and of the height, and of pitch and yaw [degrees]."""
    x, y, z = 100 * np.array(one["rms"]["position"])
    return np.hypot(x, y), z, *np.degrees(one["rms"]["euler"][1:])


def errors_of(name, *, height=True):
    """Cells of a set: errors in the plane, of height and of pitch by trajectory."""
    for plane, up, pitch, _ in (rms(sets(t)[name]) for t in COMMANDS):
        yield f"{plane:.1f} cm, " + f"{up:.1f} cm, " * height + f"{pitch:.1f}°"


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
    assert sum(one["falls"] for t in COMMANDS for one in sets(t).values()) == 0
    (count,) = {len(one["seeds"]) for t in COMMANDS for one in sets(t).values()}
    assert [float(named_command(t).velocity[0, 0]) for t in COMMANDS] == [0.5, 0.25, 0.5]
    yield README, f"on {count} other simulated robots; no walk fell"
    yield RESULTS, f"on {count} plants of the hardware stand-in"
    for name in ("nominal", "expert", "without", "with", "shipped"):
        yield RESULTS, row(f"`{name}`", *errors_of(name))
    labels = {"nominal": "plain", "expert": "by hand, by the laboratory for its own controller"}
    labels |= {"shipped": "tuned for all three, comes with the code (`--weights shipped`)"}
    for name, label in labels.items():
        yield README, row(f"`{name}`: {label}", *errors_of(name, height=False))
    for trajectory in COMMANDS:
        start, tuned = (rms(sets(trajectory)[name]) for name in ("nominal", "shipped"))
        assert tuned[0] < start[0] / 2
        assert tuned[2] < start[2] / 3
    yaw = [rms(sets("s")[name])[3] for name in ("shipped", "expert")]
    yield RESULTS, "on S it is off by {:.1f}°, with `expert` by {:.1f}°".format(*yaw)


def losses():
    for name, base in itertools.product(("without", "with", "shipped"), ("nominal", "expert")):
        changes = [sets(t)[name]["change"][base] for t in COMMANDS]
        assert all(change["counts"] for change in changes)
        yield RESULTS, row(f"`{name}`", f"`{base}`", *map(interval, changes))
    integral = report("integral.json")
    assert integral["weights"]["shipped"] == tree_hash(shipped())
    yield RESULTS, f"On {len(integral['sets']['s']['shipped']['seeds'])} more plants L changes"
    alone = "nominal with others of shipped"
    heads = {alone: ("`nominal`", "those of `shipped`"), "with": ("`with`", "none")}
    for name, head in (heads | {"shipped": ("`shipped`", "its own")}).items():
        changes = [integral["sets"][t][name]["change"]["nominal"] for t in COMMANDS]
        assert all(change["counts"] for change in changes)
        yield RESULTS, row(*head, *map(interval, changes))


def changes_of_the_command():
    for name in ("nominal", "without", "with", "shipped"):
        cells = [f"{x:.1f} times, {y:{'+' * bool(y)}} %" for x, y in smoothness(name)]
        yield RESULTS, row(f"`{name}`", *cells)
    tuned, paper = ([one for one, _ in smoothness(name)] for name in ("shipped", "with"))
    yield LIMITS, f"{min(tuned):.1f} to {max(tuned):.1f} times those of `expert` with `shipped`"
    yield LIMITS, f"{min(paper):.1f} to {max(paper):.1f} times with `with`"
    yield LIMITS, f"at most {max(whole for _, whole in smoothness('shipped'))} % above"
    touch = [sets("s")[name]["legs_touch"] for name in ("shipped", "nominal")]
    walked = 4 * len(sets("s")["shipped"]["seeds"])
    yield LIMITS, f"for {touch[0]:.1f} s of {walked} s, with `nominal` for {touch[1]:.1f} s"


DISTURBANCES = {
    "push of 50 N for a tenth of a second": "push 50 N",
    **{f"push of {force} N": f"push {force} N" for force in (75, 100, 125)},
    "floor that turns to a friction of 0.55 to 0.4": r"friction 0\.(55|5|45|4)",
    **{f"floor that turns to {mu}": f"friction {mu}" for mu in (0.35, 0.3)},
    "slope, payload, late motors": "(slope|payload|delay) .*",
    "all": ".*",
}


def disturbances():
    result = report("robustness/robustness.json")
    assert result["weights"]["shipped"] == tree_hash(shipped())
    assert result["totals"]["shipped"]["falls_more"] == []
    of_worlds = [words.split("=")[1].split("-") for words in result["flags"]["plants"]]
    assert [int(last) - int(first) + 1 for first, last in of_worlds] == [8, 8]
    scenes = {f"{c['traj']} {c['world']} {c['level']}": c["sets"] for c in result["cells"]}
    yield RESULTS, f"Of {len(result['cells'])} kinds of scenes"

    def count(pattern):
        chosen = [one for name, one in scenes.items() if re.fullmatch(pattern, name)]
        falls = [sum(one[name]["falls"] for one in chosen) for name in ("nominal", "shipped")]
        return sum(one["shipped"]["walks"] for one in chosen), *falls

    for text, level in DISTURBANCES.items():
        yield RESULTS, row(text, *map(str, count(rf"\w+ \S+ {level}")))
    for pattern, text in {
        ".* push 125 N": "Under 125 N {name} falls in {2} of {0} walks, and `nominal` in {1}",
        "s standin push (?!125).*": "50 to 100 N on S {name} falls in {2} of {0}, `nominal` in {1}",
        "s .* friction 0.3": "0.3 both fall in most walks: {name} in {2} of {0}, `nominal` in {1}",
    }.items():
        walks, *falls = count(pattern)
        yield LIMITS, text.format(walks, *falls, name="`shipped`")
    assert min(falls) > walks / 2
    (_, *pushed), (_, *slipped) = count(".* push .*"), count(".* friction .*")
    assert pushed[0] > pushed[1]
    assert slipped[0] == slipped[1]
    text = "ver all pushes it falls less often than `nominal`, on slippery floors as often"
    yield README, text
    yield DOCS / "howto" / "weights.md", text


def race():
    methods = report("race/nominal/race.json")["s"].items()
    median = lambda own: {walks: np.median(losses) / 1e6 for walks, losses in own.items()}  # noqa: E731
    at = {name: median(one["own"]) for name, one in methods}
    ours, bayes = at.pop("tuner"), at["nominal turbo on model"]["200"]
    evolution = at["nominal lq-cma-es"]["200"]
    rival = min(one["200"] for one in at.values())
    assert ours["5"] < rival  # as the picture's words have it
    assert ours["50"] == ours["5"]  # so it ends
    text = f"From an L of {ours['0']:.2f}e6 it reaches {ours['5']:.2f}e6 after five walks"
    yield RESULTS, f"{text} and ends there. The best of three"
    yield RESULTS, f"has {rival:.2f}e6 after 200."
    yield README, f"{ours['0']:.2f} million with plain weights"
    text = f"| 200 | {evolution:.2f}; {bayes:.2f} |"
    yield README, f"| lq-CMA-ES; Bayesian optimisation (TuRBO) {text}"
    yield README, f"| its step on walks, alone | 5 | {ours['5']:.2f} |"
    best_walks = best_set.SETS * best_set.PLANTS + 3 * START_PLANTS  # one is not anew
    run_of = report("race/nominal/race.json")["hector tune"]["L"]
    assert run_of["nominal"] == pytest.approx(1e6 * ours["0"], rel=0.01)  # the same plant
    cells = f"{CollectConfig().walks + best_walks} | {run_of['best'] / 1e6:.2f}"
    yield README, f"| `hector tune` | {cells} | an MPC in JAX |"


ROBOTS = {"hector": "HECTOR", "quadruped": "`examples/quadruped`", "go2": "Unitree Go2"}
ROBOTS |= {"b2": "Unitree B2", "spot": "Spot", "anymal_c": "ANYmal C"}
ROBOTS |= {"humanoid": "`examples/humanoid`", "h1": "Unitree H1", "g1": "Unitree G1"}
ROBOTS |= {
    "t1": "Booster T1",
    "adam_lite": "Adam Lite",
    "kuavo": "Kuavo S45",
    "openloong": "OpenLoong",
}


def robots():
    lower, higher, fell = np.zeros(2, int), set(), {}
    for robot, name in ROBOTS.items():
        one = report("robots/robots.json")["robots"][robot]
        start, tuned = ([one[t][x] for t in COMMANDS] for x in ("nominal", "best"))
        plants = len(tuned[0]["seeds"])
        errors = np.array([[rms(x) for x in sets] for sets in (start, tuned)])[..., [0, 2]]
        lower += (errors[1] < errors[0]).sum(axis=0)
        far = errors[1, :, 0] > 1.05 * errors[0, :, 0]
        higher |= {(robot, t) for t, more in zip(COMMANDS, far, strict=True) if more}
        falls = [[x["falls"] for x in sets] for sets in (start, tuned)]
        fell |= {robot: falls} if np.any(falls) else {}
        assert np.sum(falls) == falls[0][2] + falls[1][2]  # on S alone
        fell_text = "{}, then {}".format(*map(sum, falls)) if np.any(falls) else "none"
        pairs = errors.transpose(1, 0, 2)
        cells = ["{:.1f}/{:.1f}, {:.1f}/{:.1f}".format(*pair.T.ravel()) for pair in pairs]
        yield RESULTS, row(name, *cells, fell_text)
        if robot in ("go2", "h1", "humanoid"):
            off = ["{:.1f} to {:.1f} cm".format(*pairs[i][:, 0]) for i in (0, 2)]
            wins = [x["change"]["nominal"]["wins"] for x in tuned]
            worse = sum(round(plants * (1 - share)) for share in wins)
            yield README, row(name, *off, fell_text, str(worse))
            yield README, f"counts of {3 * plants} walks"
        yield RESULTS, f"on {plants} plants of `standin-even`"
        yield RESULTS, f"falls in {3 * plants} walks"
    cells = 3 * len(ROBOTS)
    text = "error in the plane is lower in {} of {cells} cells, pitch in {}"
    yield RESULTS, text.format(*lower, cells=cells)
    assert higher == {(r, "s") for r in ("b2", "t1", "adam_lite")} | {
        ("openloong", t) for t in COMMANDS
    }
    more = [robot for robot, (before, after) in fell.items() if sum(after) > sum(before)]
    assert (more, len(fell) - len(more)) == (["anymal_c", "humanoid", "t1"], 3)
    yield RESULTS, "three robots fall less often and three more often"
    before, after = np.array([[sum(x) > 0 for x in both] for both in fell.values()]).sum(axis=0)
    assert (after, before) == (6, 5)
    yield LIMITS, "six robots fall with `best`, and five with `nominal`"
    rose = {
        robot: sum(
            round(plants * (1 - one[t]["best"]["change"]["nominal"]["wins"])) for t in COMMANDS
        )
        for robot, one in report("robots/robots.json")["robots"].items()
    }
    text = "L rose in {openloong} of {walks} walks of OpenLoong and in {adam_lite} of Adam Lite"
    yield LIMITS, text.format(**rose, walks=3 * plants)


def engines():
    result = report("verdict/verdict.json")
    assert result["config"]["flags"]["engine"] == ["c", "drake", "pinocchio"]
    of, falls = result["sets"]["shipped"], {n: one["falls"] for n, one in result["sets"].items()}
    expert = of["against"]["expert"]
    for base, one in of["against"].items():
        yield RESULTS, f"below `{base}` in {one['below']} of {one['cells']} cases"
    text = "falls in {shipped} of {walks} walks, `nominal` in {nominal}"
    yield RESULTS, text.format(walks=of["walks"], **falls)
    assert expert["below"] == expert["cells"]
    assert falls["shipped"] == 0 < falls["nominal"]


def run():
    """What a run prints, and what README says of robot and controller."""
    result = report("run.json")
    whole, tuning = map(round, result["minutes"])
    for page in (README, DOCS / "start.md"):
        yield page, f"{whole} minutes on two cores with set-up, then {tuning}"
    size = result["gigabytes"]
    yield DOCS / "start.md", f"{np.ceil(size):.0f} GB of disk"
    each = {name: rms(result["sets"][name])[:3] for name in ("best", "nominal", "expert")}
    text = "best is {:.1f} cm off, {:.1f} cm in height, {:.1f} degrees in pitch (RMS)"
    rest = ["{} {:.1f}, {:.1f}, {:.1f}".format(name, *each[name]) for name in [*each][1:]]
    yield README, "; ".join([text.format(*each["best"]), *rest]) + "."
    falls = ", ".join(f"{name} {result['sets'][name]['falls']}" for name in each)
    walks = result["sets"]["best"]["plants"]
    yield README, f"Falls in {walks} walks on robots that the tuning has not seen: {falls}."
    robot = load_robot()
    config, weights = walk_config(robot), nominal(robot)
    assert len(robot.description.joints) == 10
    yield DOCS / "concepts.md", f"a biped of {float(robot.mass):.0f} kg with five joints"
    assert (config.mpc.horizon, config.mpc.step_ticks, config.gait.tick) == (10, 3, 0.01)
    yield DOCS / "concepts.md", "for ten steps of 30 ms, anew every 10 ms"
    state, wrench = (sum(x.size for x in jax.tree.leaves(tree)) for tree in (weights.Q, weights.R))
    text = (
        f"(forces and moments of the feet): {state + wrench // 2} numbers"  # R is that of both feet
    )
    yield DOCS / "concepts.md", text
    assert {*weights.Q.euler, *weights.Q.position} == {50.0}
    assert {*weights.Q.ang_velocity, *weights.Q.velocity} == {1.0}


def laboratory():
    """The laboratory's controller, tuned three times by calls and three times by its twin."""
    of = report("own_controller.json")["laboratory"]
    hows = of["by calls"], of["by twin"]
    sets = [*hows[0], *hows[1]]
    commands = [
        x for each in (*sets, {"commands": of["shipped"]}) for x in each["commands"].values()
    ]
    assert not any(x["falls"] for x in commands)
    assert all(each["L [%]"]["high"] < -10 and each["walks"] <= 60 for each in sets)

    def ends(values):
        return min(values), max(values)

    gains = [ends([-each["L [%]"]["mean"] for each in how]) for how in (sets, *hows)]
    walks = ends([each["walks"] for each in sets])
    text = "after {} to {} walks L was {:.0f} to {:.0f} % lower on 64 other plants; none"
    yield DOCS / "howto" / "own.md", text.format(*walks, *gains[0])
    notes = ROOT / "experiments" / "notes.md"
    text = "L falls by {:.0f} to {:.0f} % by calls and by {:.0f} to {:.0f} % by the twin"
    yield notes, text.format(*gains[1], *gains[2])
    least = min(-x["L [%]"]["mean"] for each in sets for x in each["commands"].values())
    yield notes, f"on no command by less than {least:.0f} %"
    assert max(one["seconds"] for one in sets) < 600
    yield README, "This took minutes for a laboratory's C++ controller."
    for command, page in (
        ("straight", notes),
        ("turn", notes),
        ("turn", DOCS / "howto" / "own.md"),
    ):
        plane = ends([each["commands"][command]["plane [cm]"] for each in sets])
        before = of["shipped"][command]["plane [cm]"]
        yield page, "from {} to {:.0f} or {:.0f}".format(before, *plane)


def held_of(pairs, group):
    """Number of the pairs whose interval, by the errors of a group, holds what was walked."""
    known = foretell.calibrated(group)["L"]
    ends = [(foretell.interval(x["foretold"]["L"], known), x["walked"]["L"]) for x in pairs]
    return sum(low <= came <= high for (_, low, high), came in ends)


def other_pages():
    """Figures of paper, notes, late motors, and of the delay that a robot bears."""
    losses = report("paper.json")["losses"]
    for traj, name in {"straight": "straight", "c": "C curve", "s": "S curve"}.items():
        cells, of = [], {who: x["L"] for who, x in losses[traj].items()}
        for base in ("nominal", "expert"):
            cells.append(f"{100 * (of['with'] / of[base] - 1):.0f}")
            cells.append(f"{sets(traj)['with']['change'][base]['median']:.0f}")
        yield DOCS / "paper.md", row(name, *cells)

    cells = []
    for of in report("own_controller.json")["trajectories"].values():
        cells += [100 * np.hypot(*of[name]["rms"]["position"][:2]) for name in ("expert", "best")]
    text = "from {:.1f} to {:.1f} cm on straight, {:.1f} to {:.1f} on s, {:.1f} to {:.1f} on "
    text += "sideways and {:.1f} to {:.1f} on turn"
    yield DOCS / "howto" / "own.md", text.format(*cells)
    text = "from {:.1f} to {:.1f} cm on straight and from {:.1f} to {:.1f} on S; none fell"
    yield README, text.format(*cells[:4])
    rolls = [
        np.degrees([of[name]["rms"]["euler"][0] for name in ("expert", "best")])
        for of in report("own_controller.json")["trajectories"].values()
    ]
    assert all(best > before for before, best in rolls)
    yield README, "none fell, but they roll more"
    ends = min(best for _, best in rolls), max(best for _, best in rolls)
    yield DOCS / "howto" / "own.md", "roll grew to {:.1f} to {:.1f}°".format(*ends)
    found, cells = report("own_numbers.json"), []
    for of in found["trajectories"].values():
        cells.append(-of["best"]["change"]["start"]["median"])
        assert of["best"]["falls"] == of["start"]["falls"] == 0
    text = "took L down by {:.0f} % on straight and {:.0f} % on s on 16".format(*cells)
    yield DOCS / "howto" / "own.md", text
    plane = (100 * np.hypot(*of[name]["rms"]["position"][:2]) for name in ("start", "best"))
    yield DOCS / "howto" / "own.md", "s went from {:.1f} to {:.1f} cm".format(*plane)
    of_two = found["with --walk-plants 2"]["trajectories"]
    assert {name: of["best"]["falls"] for name, of in of_two.items()} == {"straight": 0, "s": 3}
    yield DOCS / "howto" / "own.md", "With `--walk-plants 2` three fell on s."
    walks_page = DOCS / "howto" / "walks.md"
    pairs = [pair for pair in report("foretell/standin.json")["pairs"] if pair["far"]]
    text = f"On {len({x['seed'] for x in pairs})} plants {held_of(pairs, foretell.HERE)} of "
    text += f"{len(pairs)} intervals held the walked L; {0.9 * len(pairs):.0f} should"
    yield walks_page, text
    cases = report("foretell/cases.json")
    shifted = [pair for pair in cases["pairs"] if pair["world"] == "shifted"]
    text = "{refused} of {logs} logs were refused; of the".format(**cases["refused"]["shifted"])
    held = held_of(shifted, foretell.HERE)
    yield walks_page, f"{text} {len(shifted)} forecasts by the others {held} held"
    even = [pair for pair in cases["pairs"] if pair["world"] == "standin-even"]
    here = [x for x in even if (x["robot"], x["engine"]) == ("hector", "c")]
    text = "{refused} of {logs} logs were refused; ".format(**cases["refused"]["even"])
    yield walks_page, f"{text}{held_of(here, foretell.HERE)} of {len(here)} held"
    others = [x for x in even if x not in here]
    assert len({x["robot"] for x in others} - {"hector"}) == 5
    text = f"{held_of(others, foretell.ELSEWHERE)} of {len(others)} forecasts in Drake and "
    yield walks_page, f"{text}Pinocchio and on five other robots"
    off = [x["walked"]["L"] - x["foretold"]["L"] for x in cases["pairs"] if x["robot"] == "own"]
    close = sum(abs(x) < 0.12 for x in off)
    text = (
        f"Of {len(off)} forecasts for the [planner](own.md#the-planner) of the example {close} were"
    )
    yield DOCS / "howto" / "walks.md", text
    assert [round(np.exp(x)) for x in sorted(off)[close:]] == [2, 5, 5]
    carried = foretell.carry(pretend_verdict(8), "with")
    text = f"held {carried.held} of {carried.walks} walks of the other set"
    yield DOCS / "howto" / "walks.md", text
    (many,) = report("performance/nvidia-h200.json")["sections"]["batch"]["rows"]
    text = f"1024 tunings took {float(many[3]):.1f} s, after {many[6]} s of compiling"
    yield DOCS / "howto" / "gpu.md", text
    notes, walks = ROOT / "experiments" / "notes.md", report("many-plants/walks.json")["L"]
    best_of_then, searched = (np.array([*walks[name].values()]) for name in ("best", "search"))
    lower = -100 * np.expm1(np.log(searched / best_of_then).mean(axis=1))
    yield notes, "by {:.0f}, {:.0f} and {:.0f} % on straight, C and S".format(*lower)
    rows = report("transfer/transfer.json")["rows"]
    for kind, words in {
        "net": "gives cosines of {}, {} and {} on straight, C and S at nominal weights",
        "paper": "the paper's net {}, {} and {} with wide intervals",
        "command": "no net {}, {} and {} ([report]",
        "net without legs": "Without that part the cosines are {}, {} and {}.",
    }.items():
        cosines = [f"{rows[traj][kind]['cosine']['value']:.2f}" for traj in COMMANDS]
        yield notes, words.format(*cosines)
    straight = f"{rows['straight']['net']['cosine']['value']:.2f} at nominal on straight"
    yield DOCS / "decisions.md", straight

    for robot in ("quadruped", "quadruped-s", "humanoid"):
        numbers = report(f"delay/{robot}/delay.json")
        (trajectories,) = numbers["walks"].values()
        (changes,) = trajectories.values()
        motors = list(zip(numbers["delays"], numbers["lags"], strict=True))
        for name, change in {"whole, 30 rad/s": BEFORE, "as proposed": AS_PROPOSED}.items():
            cells = []
            for column in ((2.0, 4.0), (5.0, 6.0), (8.0, 6.0)):
                walks = changes[change][motors.index(column)]
                loss = np.median([walk["L"] for walk in walks]) / 1e6
                falls = sum(walk["fell"] for walk in walks)
                cells.append(f"{loss:#.3g}".rstrip(".") if loss > 10 else f"{loss:.2f}")
                cells[-1] += f", {falls} fell" if falls else ""
            yield DOCS / "decisions.md", row(name, *cells)
    robot = load_robot(ROOT / "examples" / "quadruped" / "robot.toml")
    lines = delay_lines(robot, walk_config(robot), nominal(robot))
    yield DOCS / "howto" / "robot.md", f"delay {' '.join(' '.join(lines).split())}"


def test_each_number_of_readme_results_and_limits_is_that_of_its_file():
    functions = (tracking, losses, changes_of_the_command, disturbances, race, robots)
    told = [(RESULTS, "95 %"), (LIMITS, "Python 3.11 to 3.13"), (LIMITS, "64 bits")]
    for function in (*functions, engines, run, laboratory, other_pages):
        told += function()
    left = {}
    for page, words in told:
        text = " ".join(page.read_text().replace("**", "").split())
        assert words in text, f"{page.name} must say: {words}"
        left[page] = left.get(page, text).replace(words, "")
    for page in (RESULTS, LIMITS):
        rest = re.sub(r"\]\([^)]*\)|`[^`]*`|\b[GH][o0-9]2?\b", "", left[page])
        assert re.findall(r"\S*\d\S*", rest) == [], page.name  # numbers that no file is behind


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_asks_nobody_for_anything(tmp_path):
    done = python("-m", "sphinx", "-W", "--keep-going", "-q", DOCS, tmp_path / "site")
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
    assert numbers == [str(n) for n in range(1, 17)]  # as in the paper


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
    shown = python(example, cwd=ROOT, check=True).stdout
    row = r"^(\w+): ([\d.]+) cm off, ([\d.]+) degrees in pitch, fell: False$"
    rows = re.findall(row, shown, re.MULTILINE)
    assert [name for name, *_ in rows] == ["plain", "tuned"]
    for plain, tuned in zip(rows[0][1:], rows[1][1:], strict=True):
        assert float(tuned) < float(plain)
