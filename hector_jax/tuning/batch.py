"""Many tunings as one program: over trajectories, starts, loss weights and variations of the model.

A problem is one weight set to be tuned, on one scenario or on several at once: a scenario is a
command with a start, a phi, weights of the loss and a variation of the model. Several scenarios
become one loss by the mean over the worst share of them, so that mean (1), CVaR (such as 0.25) and
worst case (0) are one number; each scenario's loss may be divided by a scale of its own first. The
rule is that of a single tuning (`difftune.update`), compiled into a loop on the device; a problem
that has ended is frozen.

Problems are independent. The batch is laid out over all devices of a mesh, over hosts too, and each
device walks its own share without a word to the others: `shard_map`, since the loops of the QP
would otherwise wait in every tick for the slowest problem on any device.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float, Int

from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.robot.model import Robot
from hector_jax.tuning import difftune
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Iteration, TuneConfig, TuneState
from hector_jax.tuning.evaluate import Evaluation, evaluate
from hector_jax.tuning.loss import PAPER_LOSS, Loss
from hector_jax.tuning.rollout import Variation
from hector_jax.tuning.status import Stop

AXIS = "problems"
PER_CALL = PAPER_ITERATIONS + 1  # rollouts of each problem in one call of the device: start and ten


class Scenario(NamedTuple):
    """One walk of a problem; leading axes of a batch: problems, scenarios."""

    command: Command
    anchor: Anchor
    effect: Int[Array, "*batch"]  # which of the batch's phis
    loss: Loss  # its weights with the same leading axes
    scale: Float[Array, "*batch"]  # of the loss, which is divided by it
    variation: Variation | None = None


class Problem(NamedTuple):
    """One weight set to be tuned."""

    start: Weights
    scenarios: Scenario  # one leading axis
    tail: Float[Array, "*batch"]  # share of the worst scenarios that count: 1 mean, 0 worst alone


class Tunings(NamedTuple):
    """A batch of tunings, problems first."""

    ten: Weights
    converged: Weights
    loss: Float[np.ndarray, " problems"]  # of the converged weights
    stop: Int[np.ndarray, " problems"]  # a `status.Stop`
    iterations: Int[np.ndarray, " problems"]  # rollouts behind each, the start not counted
    history: Iteration  # (problems, iterations + 1); zero after the end


def tail_weights(losses: Float[Array, " n"], tail: Float[Array, ""]) -> Float[Array, " n"]:
    """Weights, of sum 1, that make the mean over the worst share of some losses (CVaR).

    By them the gradients add up to the gradient of that mean, but where two losses change places.

    >>> tail_weights(jnp.array([3.0, 1.0, 2.0, 9.0]), jnp.asarray(0.5)).tolist()
    [0.5, 0.0, 0.0, 0.5]
    """
    counted = jnp.maximum(tail * len(losses), 1.0)
    rank = jnp.argsort(jnp.argsort(-losses))
    return jnp.clip(counted - rank, 0.0, 1.0) / counted


def lanes_of(backend: str) -> int:
    """Problems that walk side by side on a device: all (0) but on a CPU, one after the other.

    Side by side, the slowest QP is waited for in every tick; a CPU gains nothing in return.
    `python -m benchmarks.batch --lanes 1 4 0` tells.
    """
    return 1 if backend == "cpu" else 0


def choose_devices(rollouts: int) -> list[Any]:
    """Devices for some rollouts at once: a core each where there are enough, else all devices.

    A GPU waits in each of a tick's many small steps: one rollout takes it almost as long as a
    hundred, and longer than a CPU core (docs/performance.md).
    """
    devices = jax.devices()
    if jax.process_count() > 1:
        return devices
    try:
        cores = jax.local_devices(backend="cpu")
    except RuntimeError:  # JAX_PLATFORMS leaves the CPU out
        return devices
    return cores if rollouts <= len(cores) else devices


def _over(lanes: int, one: Callable, several: Any) -> Any:
    count = len(jax.tree.leaves(several)[0])
    if lanes == 1:
        return jax.lax.map(one, several)
    if lanes == 0 or lanes >= count:
        return jax.vmap(one)(several)
    return jax.lax.map(one, several, batch_size=lanes)


def _evaluate(
    config: TuneConfig,
    lanes: int,
    robot: Robot,
    effects: jax.tree_util.Partial,
    problem: Problem,
    weights: Weights,
) -> Evaluation:
    """All scenarios of a problem as one evaluation."""
    single = all(len(leaf) == 1 for leaf in jax.tree.leaves(effects))

    def walk(scenario: Scenario) -> Evaluation:
        which = 0 if single else scenario.effect
        evaluation = evaluate(
            config.rollout,
            robot,
            weights,
            scenario.command,
            scenario.anchor,
            jax.tree.map(lambda leaf: leaf[which], effects),
            scenario.loss,
            scenario.variation,
        )
        loss, terms, gradient = jax.tree.map(
            lambda x: x / scenario.scale, (evaluation.loss, evaluation.terms, evaluation.gradient)
        )
        return evaluation._replace(loss=loss, terms=terms, gradient=gradient)

    each = _over(lanes, walk, problem.scenarios)
    by = tail_weights(each.loss, problem.tail)
    loss, terms, gradient = jax.tree.map(
        lambda x: jnp.tensordot(by, x, axes=1), (each.loss, each.terms, each.gradient)
    )
    return Evaluation(loss, terms, gradient, jnp.max(each.fallen), jnp.max(each.residual))


@partial(jax.jit, static_argnums=(0, 1, 2))
def _advance(
    config: TuneConfig,
    lanes: int,
    mesh: Mesh,
    robot: Robot,
    effects: jax.tree_util.Partial,
    problems: Problem,
    states: TuneState,
) -> tuple[TuneState, Iteration]:
    """Up to PER_CALL iterations of each problem, and what they did."""

    def tune(robot: Robot, effects: jax.tree_util.Partial, one: tuple[Problem, TuneState]):
        problem, begin = one

        def step(state: TuneState) -> tuple[TuneState, Iteration]:
            evaluation = _evaluate(config, lanes, robot, effects, problem, state.trial)
            return difftune.update(config, state, evaluation)

        def record(carry: tuple) -> tuple:
            state, history, row = carry
            state, iteration = step(state)
            history = jax.tree.map(lambda rows, x: rows.at[row].set(x), history, iteration)
            return state, history, row + 1

        shapes = jax.eval_shape(step, begin)[1]
        empty = jax.tree.map(lambda x: jnp.zeros((PER_CALL, *x.shape), x.dtype), shapes)
        going = lambda carry: (carry[0].stop == Stop.GOING) & (carry[2] < PER_CALL)  # noqa: E731
        return jax.lax.while_loop(going, record, (begin, empty, 0))[:2]

    def on_device(robot, effects, problems, states):
        return _over(lanes, partial(tune, robot, effects), (problems, states))

    whole, split = PartitionSpec(), PartitionSpec(AXIS)
    return jax.shard_map(
        on_device,
        mesh=mesh,
        in_specs=(whole, whole, split, split),
        out_specs=split,
        check_vma=False,
    )(robot, effects, problems, states)


def _place(mesh: Mesh, tree: Any) -> Any:
    """Host arrays, the same on every host, laid out over the mesh."""
    sharding = NamedSharding(mesh, PartitionSpec(AXIS))
    lay = lambda x: jax.make_array_from_callback(x.shape, sharding, lambda at: x[at])  # noqa: E731
    return jax.tree.map(lay, tree)


def _fetch(tree: Any) -> Any:
    """The whole of laid-out arrays on every host."""
    gather = partial(multihost_utils.process_allgather, tiled=True)
    return jax.tree.map(lambda x: np.asarray(x if x.is_fully_addressable else gather(x)), tree)


def tune_batch(
    config: TuneConfig,
    robot: Robot,
    problems: Problem,
    effects: jax.tree_util.Partial,
    *,
    devices: Sequence[Any] | None = None,
    lanes: int | None = None,
    tell: Callable[[int, int, str], None] = lambda done, of, remark: None,
) -> Tunings:
    """Tune all problems of a batch.

    Args:
        config: how; its loss is not read, those of the scenarios are.
        robot: the body that the controllers believe in.
        problems: stacked, see `stack`; the same on every host.
        effects: phis stacked likewise, of which the scenarios name theirs by number.
        devices: what to walk on; None takes `choose_devices`.
        lanes: problems side by side on a device, 0 for all; None takes `lanes_of` the backend.
        tell: told of problems that have ended, of how many, and a remark; see `console.bar`.

    Returns:
        What came out, on every host. A problem whose start is refused keeps it and says so in
        `stop`.

    Raises:
        ValueError: no problem, or one that asks for a phi, delay or share that there is not.
    """
    count = _check_problems(config, problems, effects)
    devices = (
        choose_devices(np.size(problems.scenarios.scale)) if devices is None else list(devices)
    )
    lanes = lanes_of(devices[0].platform) if lanes is None else lanes
    mesh = Mesh(np.array(devices), (AXIS,))
    robot, effects, problems = jax.tree.map(np.asarray, (robot, effects, problems))
    config = replace(config, loss=PAPER_LOSS)  # the scenarios' counts: no program for each
    states = jax.tree.map(np.asarray, jax.vmap(partial(difftune.init, config))(problems.start))
    # what fills the last device up has ended before it begins
    rows = np.minimum(np.arange(math.ceil(count / len(devices)) * len(devices)), count - 1)
    filled, states = jax.tree.map(lambda x: x[rows], (problems, states))
    states.stop[count:] = Stop.LIMIT
    filled, states = _place(mesh, filled), _place(mesh, states)

    histories, left = [], count
    tell(0, count, f"compiling for {len(devices)} devices ({devices[0].device_kind})")
    while left:
        states, history = _advance(config, lanes, mesh, robot, effects, filled, states)
        stop, loss = _fetch((states.stop, states.loss))
        histories.append(_fetch(history))
        left = int(np.sum(stop[:count] == Stop.GOING))
        tell(count - left, count, f"median L {np.median(loss[:count]):.4g}")
    final = jax.tree.map(lambda x: x[:count], _fetch(states))
    history = jax.tree.map(
        lambda *parts: np.concatenate(parts, axis=1)[:count, : config.iterations + 1], *histories
    )
    return Tunings(final.ten, final.best, final.loss, final.stop, final.iteration - 1, history)


def _check_problems(config: TuneConfig, problems: Problem, effects: jax.tree_util.Partial) -> int:
    """Check the problems of a batch; returns their number."""
    scenarios, tail = problems.scenarios, np.asarray(problems.tail)
    if tail.ndim != 1 or not len(tail):
        raise ValueError(f"Problem.tail must be stacked, one per problem, got shape {tail.shape}")
    if not ((tail >= 0) & (tail <= 1)).all():
        raise ValueError(f"Problem.tail must be from 0 to 1, got {tail.min()} to {tail.max()}")
    phis = min((len(leaf) for leaf in jax.tree.leaves(effects)), default=1)
    index = np.asarray(scenarios.effect)
    if index.min() < 0 or index.max() >= phis:
        raise ValueError(f"Scenario.effect must be below {phis}, got {index.min()}..{index.max()}")
    if not (np.asarray(scenarios.scale) > 0).all():
        raise ValueError("Scenario.scale must be positive")
    if scenarios.variation is not None:
        delay, tick = np.asarray(scenarios.variation.delay), config.rollout.walk.gait.tick
        if delay.min() < 0 or delay.max() > tick:
            raise ValueError(
                f"Variation.delay must be from 0 to a tick of {tick} s, "
                f"got {delay.min()} to {delay.max()}"
            )
    return len(tail)
