"""`hector search`: weights found on walks of the simulator, without gradients."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from hector_jax.cli import arguments
from hector_jax.cli.flags import Search
from hector_jax.control.reference import COMMANDS
from hector_jax.control.weights import expert
from hector_jax.control.weights_file import save_weights
from hector_jax.core.console import say
from hector_jax.core.environment import versions
from hector_jax.core.files import as_json, make_folder, write_json
from hector_jax.core.runtime import workers
from hector_jax.robot.model import load_robot
from hector_jax.runs import searches, tunings
from hector_jax.search.cmaes import SearchConfig
from hector_jax.sim.engine import choose_engine
from hector_jax.tuning.loss import alphas


def search(args: Search) -> None:
    """Search for weights on the simulator, without gradients."""
    robot = load_robot(args.robot)
    texts = COMMANDS if args.traj == "all" else (args.traj,)
    courses = [arguments.course(text, robot) for text in texts]
    commands = {one.name: one.command for one in courses}
    config = SearchConfig(args.budget, args.population, args.seed, args.spread)
    engine = choose_engine(args.engine)
    tune = arguments.with_length(tunings.tune_config(robot), courses[0])
    start = arguments.weights(args.start, robot)
    out = arguments.default_of(args.out, Search.out, args.robot, robot)
    make_folder(out)
    with workers(args.processes) as pool:
        results = searches.search(
            pool,
            config,
            tune,
            robot,
            dict.fromkeys(commands, start),
            commands=commands,
            engine=engine,
            folder=args.record or out,
        )
        say("walking with the start, expert and best weights")
        sets = {name: [start, expert(robot), results[name].weights] for name in commands}
        at_once = config.population * len(commands)
        compared = searches.losses_on_hfs(
            pool, tune, robot, sets, commands=commands, engine=engine, at_once=at_once
        )
    cards = {}
    for name, one in results.items():
        at_start, at_expert, again = compared[name].tolist()
        losses = {"start": at_start, "best": one.loss, "best_again": again, "expert": at_expert}
        cards[name] = {
            "trajectory": name,
            "L": losses,
            "walks": len(one.history) * config.population,
            "best_at": one.walk,
            "stop": one.stop,
            "search": asdict(config),
            "start": args.start,
            "engine": engine.name,
            "rollout": asdict(tune.rollout),
            "loss": alphas(tune.loss),
            "versions": versions(),
        }
        save_weights(out / f"{name}.json", one.weights)
        write_json(out / f"{name}-card.json", cards[name])
    if args.json:
        print(as_json({"weights": str(out), "cards": cards}))
    else:
        _print(cards)
    say(f"the weights are in {out}")


def _print(cards: Mapping[str, Mapping[str, Any]]) -> None:
    print("L in 1e6 on the high-fidelity simulator")
    print(f"{'':10s}{'start':>9s}{'best':>9s}{'expert':>9s}{'walks':>8s}{'best at':>9s}")
    for name, card in cards.items():
        losses = "".join(f"{card['L'][x] / 1e6:9.3f}" for x in ("start", "best", "expert"))
        print(f"{name:10s}{losses}{card['walks']:8d}{card['best_at']:9d}")
