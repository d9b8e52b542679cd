"""Many tunings as one program: over trajectories, starts, loss weights and variations of the model.

A problem is one weight set to be tuned, on one scenario or on several at once: a scenario is a
command with a start, a phi, weights of the loss and a variation of the model. Several scenarios
become one loss by the mean over the worst share of them, so that one number selects the mean (1),
CVaR (such as 0.25) or the worst case (0); each scenario's loss may be divided by its own scale
first. The rule is that of a single tuning (`difftune.update`), compiled into a loop on the device;
a problem that has ended is frozen.

Problems are independent. The batch is laid out over all devices of a mesh, over hosts too, and each
device computes its own share without communication: `shard_map`, since the loops of the QP would
otherwise wait in every tick for the slowest problem on any device.
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
from hector_jax.tuning.curvature import least_squares
from hector_jax.tuning.difftune import Iteration, TuneConfig, TuneState, Tuning
from hector_jax.tuning.evaluate import Evaluation, Walk, evaluate
from hector_jax.tuning.loss import PAPER_LOSS, Loss
from hector_jax.tuning.parallel_rollout import parallel_rollout
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout
from hector_jax.tuning.status import Stop
from hector_jax.tuning.variation import Variation

AXIS = "problems"
PER_CALL = 11  # evaluations per problem and call of the device: start and ten
TICKS_AT_ONCE = 8 * 400  # most on a GPU that are faster at once than in turn

COMPILER_OPTIONS = {"xla_gpu_command_buffer_scheduling_mode": "CONCURRENT"}
"""For `jax.jit` of rollouts: on a GPU, small kernels that do not need each other run side by side;
a CPU ignores it."""


class BatchScenario(NamedTuple):
    """A rollout of a problem; leading axes of a batch: problems, scenarios."""

    command: Command
    anchor: Anchor
    effect: Int[Array, "*batch"]  # index of a phi of the batch
    loss: Loss  # its weights have the same leading axes
    scale: Float[Array, "*batch"]  # divisor of the loss
    variation: Variation | None = None  # None: the noise and delay of the config


class BatchProblem(NamedTuple):
    """A weight set to be tuned."""

    start: Weights
    scenarios: BatchScenario  # one leading axis
    tail: Float[Array, "*batch"]  # share of the scenarios, worst first: 1 the mean, 0 the worst


def tail_weights(losses: Float[Array, " n"], tail: Float[Array, ""]) -> Float[Array, " n"]:
    """Return weights, of sum 1, that make the mean over the worst share of the losses (CVaR).

    The same weights make the gradient of that mean, except where two losses change places.

    >>> tail_weights(jnp.array([3.0, 1.0, 2.0, 9.0]), jnp.asarray(0.5)).tolist()
    [0.5, 0.0, 0.0, 0.5]
    """
    counted = jnp.maximum(tail * len(losses), 1.0)
    rank = jnp.argsort(jnp.argsort(-losses))
    return jnp.clip(counted - rank, 0.0, 1.0) / counted


def lanes_of(backend: str) -> int:
    """Return the problems to compute in parallel on a device: 1 on a CPU, elsewhere all (0).

    In parallel, every tick waits for the slowest QP; a CPU gains nothing in return, as
    `python -m benchmarks.batch --lanes 1 4 0` shows. Where the cores are several devices it must be
    1: XLA's pool has a thread for each, and batches of factorisations that begin together in it can
    wait for ever (`core.numerics`).
    """
    return 1 if backend == "cpu" else 0


def choose_rollout(platform: str, config: RolloutConfig, rollouts: int) -> Walk:
    """Choose `rollout` or `parallel_rollout` for the rollouts that one device computes.

    A GPU waits in each of a tick's many small steps, so that few rollouts are faster with all their
    ticks at once.
    """
    ticks = rollouts * (config.lead + config.ticks)
    return parallel_rollout if platform == "gpu" and ticks <= TICKS_AT_ONCE else rollout


def _map(lanes: int, function: Callable, stacked: Any) -> Any:
    """Map a function over the first axis, `lanes` elements in parallel; 0 for all."""
    if lanes == 1:
        return jax.lax.map(function, stacked)
    if lanes == 0 or lanes >= len(jax.tree.leaves(stacked)[0]):
        return jax.vmap(function)(stacked)
    return jax.lax.map(function, stacked, batch_size=lanes)


class _Program(NamedTuple):
    """What a program is compiled for."""

    config: TuneConfig
    lanes: int  # problems in parallel on a device, 0 for all
    walk: Walk
    mesh: Mesh


def _evaluate(
    program: _Program,
    robot: Robot,
    effects: jax.tree_util.Partial,
    problem: BatchProblem,
    state: TuneState,
) -> tuple[Evaluation, Float[Array, "n n"]]:
    """Evaluate all scenarios of a problem as one; the matrix is zero if the rule takes none."""
    config, lanes, walk, _ = program
    single = all(len(leaf) == 1 for leaf in jax.tree.leaves(effects))
    weights = difftune.trial_weights(config, state)

    def slope(of: BatchScenario) -> tuple[Evaluation, Array]:
        effect = jax.tree.map(lambda leaf: leaf[0 if single else of.effect], effects)
        scenario = Scenario(robot, of.command, of.anchor, effect, of.variation)
        if config.rule == "gauss_newton":
            options = {"walk": walk, "others": config.others}
            found, matrix = least_squares(config.rollout, scenario, weights, of.loss, **options)
        else:
            found = evaluate(config.rollout, scenario, weights, of.loss, walk=walk)
            matrix = jnp.zeros_like(state.rule.matrix)
        loss, terms, gradient, matrix = jax.tree.map(lambda x: x / of.scale, (*found[:3], matrix))
        return found._replace(loss=loss, terms=terms, gradient=gradient), matrix

    stacked, matrices = _map(lanes, slope, problem.scenarios)
    weighted_sum = partial(jnp.tensordot, tail_weights(stacked.loss, problem.tail), axes=1)
    value, terms, gradient, matrix = jax.tree.map(weighted_sum, (*stacked[:3], matrices))
    fallen, residual = jnp.max(stacked.fallen), jnp.max(stacked.residual)
    return Evaluation(value, terms, gradient, fallen, residual), matrix


@partial(jax.jit, static_argnums=0, compiler_options=COMPILER_OPTIONS)
def _advance(
    program: _Program,
    robot: Robot,
    effects: jax.tree_util.Partial,
    problems: BatchProblem,
    states: TuneState,
) -> tuple[TuneState, Iteration]:
    """Run up to PER_CALL iterations of each problem; returns the states and the iterations."""

    def tune(robot: Robot, effects: jax.tree_util.Partial, inputs: tuple[BatchProblem, TuneState]):
        problem, start = inputs

        def step(state: TuneState) -> tuple[TuneState, Iteration]:
            evaluation, matrix = _evaluate(program, robot, effects, problem, state)
            return difftune.update(program.config, state, evaluation, matrix)

        def record(carry: tuple) -> tuple:
            state, history, row = carry
            state, iteration = step(state)
            history = jax.tree.map(lambda rows, x: rows.at[row].set(x), history, iteration)
            return state, history, row + 1

        shapes = jax.eval_shape(step, start)[1]
        empty = jax.tree.map(lambda x: jnp.zeros((PER_CALL, *x.shape), x.dtype), shapes)

        def active(carry: tuple) -> Array:
            state, _, row = carry
            return (state.stop == Stop.GOING) & (row < PER_CALL)

        return jax.lax.while_loop(active, record, (start, empty, 0))[:2]

    def on_device(robot, effects, problems, states):
        return _map(program.lanes, partial(tune, robot, effects), (problems, states))

    replicated, split = PartitionSpec(), PartitionSpec(AXIS)
    return jax.shard_map(
        on_device,
        mesh=program.mesh,
        in_specs=(replicated, replicated, split, split),
        out_specs=split,
        check_vma=False,
    )(robot, effects, problems, states)


def _place(mesh: Mesh, tree: Any) -> Any:
    """Lay host arrays, the same on every host, out over the mesh."""
    sharding = NamedSharding(mesh, PartitionSpec(AXIS))
    array_of = partial(jax.make_array_from_callback, sharding=sharding)
    return jax.tree.map(lambda x: array_of(x.shape, data_callback=lambda index: x[index]), tree)


def _fetch(tree: Any) -> Any:
    """Gather distributed arrays on every host."""
    gather = partial(multihost_utils.process_allgather, tiled=True)
    return jax.tree.map(lambda x: np.asarray(x if x.is_fully_addressable else gather(x)), tree)


def tune_batch(
    config: TuneConfig,
    robot: Robot,
    problems: BatchProblem,
    effects: jax.tree_util.Partial,
    *,
    devices: Sequence[Any] | None = None,
    lanes: int | None = None,
    walk: Walk | None = None,
    report_progress: Callable[[int, int, str], None] = lambda done, total, message: None,
) -> Tuning:
    """Tune all problems of a batch.

    Args:
        config: the settings; its loss is ignored, each scenario has its own.
        robot: the body that the controllers assume.
        problems: stacked, see `stack`; the same on every host.
        effects: phis, stacked too; `BatchScenario.effect` is the index into them.
        devices: on which to compute; None takes all.
        lanes: problems in parallel on a device, 0 for all; None takes `lanes_of` the backend.
        walk: `rollout` or `parallel_rollout`; None takes `choose_rollout`.
        report_progress: takes the number of problems that have ended, the number of all problems
            and a message; see `console.bar`.

    Returns:
        The results, on every host. A problem whose start is rejected keeps its start, and its
        `stop` is `Stop.BAD_START`.

    Raises:
        ValueError: no problem, or an index of a phi, a delay, a share or `lanes` out of range.
    """
    count = _check_problems(config, problems, effects)
    devices = list(devices or jax.devices())
    problems_each = math.ceil(count / len(devices))
    rollouts = problems_each * np.shape(problems.scenarios.scale)[1]
    walk = walk or choose_rollout(devices[0].platform, config.rollout, rollouts)
    lanes = _checked_lanes(lanes, devices[0].platform)
    mesh = Mesh(np.array(devices), (AXIS,))
    robot, effects, problems = jax.tree.map(np.asarray, (robot, effects, problems))
    config = replace(config, loss=PAPER_LOSS)  # unused, and so one program for all losses
    states = jax.tree.map(np.asarray, jax.vmap(partial(difftune.init, config))(problems.start))
    # problems that only fill up the last device are stopped before they start
    rows = np.minimum(np.arange(problems_each * len(devices)), count - 1)
    filled, states = jax.tree.map(lambda x: x[rows], (problems, states))
    states.stop[count:] = Stop.LIMIT
    filled, states = _place(mesh, filled), _place(mesh, states)

    program, histories, active = _Program(config, lanes, walk, mesh), [], count
    report_progress(0, count, f"compiling for {len(devices)} devices ({devices[0].device_kind})")
    while active:
        states, history = _advance(program, robot, effects, filled, states)
        stop, loss = _fetch((states.stop, states.rule.value))
        histories.append(_fetch(history))
        active = int(np.sum(stop[:count] == Stop.GOING))
        report_progress(count - active, count, f"median L {np.median(loss[:count]):.4g}")
    final = jax.tree.map(lambda x: x[:count], _fetch(states))
    history = jax.tree.map(
        lambda *parts: np.concatenate(parts, axis=1)[:count, : config.iterations + 1], *histories
    )
    return jax.device_get(jax.vmap(partial(difftune.result, config))(final, history))


def _checked_lanes(lanes: int | None, backend: str) -> int:
    usual = lanes_of(backend)
    if usual == 1 and lanes not in (None, 1) and len(jax.local_devices(backend="cpu")) > 1:
        raise ValueError(f"lanes must be 1 where a CPU is several devices, got {lanes}")
    return usual if lanes is None else lanes


def _check_problems(
    config: TuneConfig, problems: BatchProblem, effects: jax.tree_util.Partial
) -> int:
    """Check the problems of a batch and return their number."""
    scenarios, tail = problems.scenarios, np.asarray(problems.tail)
    if tail.ndim != 1 or not len(tail):
        raise ValueError(
            f"BatchProblem.tail must be stacked, one per problem, got shape {tail.shape}"
        )
    if not ((tail >= 0) & (tail <= 1)).all():
        raise ValueError(f"BatchProblem.tail must be from 0 to 1, got {tail.min()} to {tail.max()}")
    phis = min((len(leaf) for leaf in jax.tree.leaves(effects)), default=1)
    index = np.asarray(scenarios.effect)
    if index.min() < 0 or index.max() >= phis:
        raise ValueError(
            f"BatchScenario.effect must be below {phis}, got {index.min()}..{index.max()}"
        )
    if not (np.asarray(scenarios.scale) > 0).all():
        raise ValueError("BatchScenario.scale must be positive")
    if scenarios.variation is not None:
        delay, tick = np.asarray(scenarios.variation.delay), config.rollout.walk.gait.tick
        if delay.min() < 0 or delay.max() > tick:
            raise ValueError(
                f"Variation.delay must be from 0 to a tick of {tick} s, "
                f"got {delay.min()} to {delay.max()}"
            )
    return len(tail)
