"""Optimizers of the weights by walks on a simulator, which propose the walks of each round.

An optimizer is a pure function of the walks so far: the start alone, then a `Generation` for each
of its rounds. So a benchmark can be interrupted and continued, optimizers run in lock-step and
compute in other processes. All move in 18 log-weights inside the box, from one start. Methods that
follow the gradient of a model learn nothing from the walks: they are a `Given` list of weights,
which is only evaluated.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float
from scipy.stats import norm

from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import (
    Weights,
    direction_names,
    directions,
    vector_to_weights,
    weights_to_vector,
)
from hector_jax.core.inputs import InputError
from hector_jax.robot.model import Robot
from hector_jax.search.cmaes import CmaSearch, Generation, SearchConfig, log_bounds, project
from hector_jax.tuning.difftune import Iteration, TuneConfig, step_status, step_weights, tune_step

DIM = len(direction_names())
Steps = Float[np.ndarray, "walks 18"]  # log-weights less those of the start


@runtime_checkable
class Optimizer(Protocol):
    """Method that proposes the next walks."""

    @property
    def most(self) -> int:
        """Largest number of walks in a round."""
        ...

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """Return the steps to walk next, none after the end. `past` begins with the start."""
        ...


def steps_to(start: Weights, weights: Weights) -> Float[np.ndarray, "18"]:
    """Return the steps in log-weights from a start to weights whose feet share one R."""
    flat = [np.asarray(weights_to_vector(w), float) for w in (weights, start)]
    return np.log(flat[0] / flat[1])[directions().argmax(axis=1)]


@dataclass(frozen=True)
class Random:
    """Random draws about the start."""

    seed: int = 0
    spread: float = 1.0  # standard deviation of each log-weight
    most: int = 10

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """Return the next draws, clipped to the box."""
        draws = np.random.default_rng([self.seed, len(past)]).normal(size=(self.most, DIM))
        return np.clip(self.spread * draws, *log_bounds(start).T)


@dataclass(frozen=True)
class CmaEs:
    """The search of `search.cmaes`."""

    config: SearchConfig = SearchConfig()

    @property
    def most(self) -> int:
        """Population of the search."""
        return self.config.population

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """Return the next generation."""
        search = CmaSearch(self.config, start)
        search.replay(past[1:])
        return np.zeros((0, DIM)) if search.stop else search.ask()


@dataclass(frozen=True)
class Bayes:
    """Bayesian optimisation: the largest expected improvement under a Gaussian process.

    The process is fitted to log L with a Matern 5/2 kernel that has a length for each weight, and
    noise. The first round is that of `Random`; in later rounds the points are chosen one by one,
    and until a chosen point is walked its loss is assumed to be the best so far (constant liar).
    """

    seed: int = 0
    reach: float = math.inf  # largest step of a log-weight; by default as far as the box
    spread: float = 1.0  # of the first round
    most: int = 10

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """Return the next round.

        Raises:
            InputError: scikit-learn, of the extra `race`, is not installed.
        """
        if find_spec("sklearn") is None:
            raise InputError(
                'Bayesian optimisation needs scikit-learn: pip install "hector-jax[race]"'
            )
        from threadpoolctl import threadpool_limits

        box = np.clip(log_bounds(start), -self.reach, self.reach)
        if len(past) == 1:
            first = Random(self.seed, self.spread, self.most).ask(start, past)
            return np.clip(first, *box.T)
        rng = np.random.default_rng([self.seed, len(past)])
        with threadpool_limits(1), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of lengths at their bounds
            return self._choose(rng, box, past)

    def _choose(
        self, rng: np.random.Generator, box: np.ndarray, past: Sequence[Generation]
    ) -> Steps:
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

        steps = np.concatenate([generation.steps for generation in past])
        losses = np.concatenate([generation.losses for generation in past])
        losses = np.where(np.isfinite(losses), losses, losses[np.isfinite(losses)].max())
        logs = np.log(losses)
        lengths: Any = np.full(DIM, 3.0)  # the stubs say float, the documentation also an array
        matern = Matern(lengths, length_scale_bounds=(0.3, 100.0), nu=2.5)
        kernel = ConstantKernel(1.0, (1e-2, 1e2)) * matern + WhiteKernel(1e-2, (1e-6, 1.0))
        fitted = GaussianProcessRegressor(
            kernel,
            normalize_y=True,
            n_restarts_optimizer=1,
            random_state=int(rng.integers(2**31)),
        ).fit(steps, logs)
        fixed: Any = None  # no fit of the kernel; the stubs do not know that it can be None
        process = GaussianProcessRegressor(fitted.kernel_, optimizer=fixed, normalize_y=True)
        for _ in range(self.most):
            process.fit(steps, logs)
            near = steps[np.argsort(logs)[:5]]
            predict = partial(process.predict, return_std=True)
            point = _most_promising(rng, box, near, predict, logs.min())
            steps, logs = np.vstack([steps, point]), np.append(logs, logs.min())
        return steps[-self.most :]


def _most_promising(
    rng: np.random.Generator,
    box: Float[np.ndarray, "18 2"],
    near: Float[np.ndarray, "best 18"],
    predict: Callable,
    least: float,
) -> Float[np.ndarray, "18"]:
    """Maximise the expected improvement: draws in the box and near the best, then refined."""

    def gain(points: np.ndarray) -> np.ndarray:
        mean, deviation = predict(points)
        z = (least - mean) / np.maximum(deviation, 1e-12)
        return deviation * (z * norm.cdf(z) + norm.pdf(z))

    low, high = box.T
    width = np.exp(rng.uniform(np.log(0.03), 0.0, (2048, 1)))
    about = near[rng.integers(len(near), size=2048)] + width * rng.normal(size=(2048, DIM))
    points = np.clip(np.vstack([rng.uniform(low, high, (2048, DIM)), about]), low, high)
    gains = gain(points)
    for width in (0.3, 0.2, 0.1, 0.05, 0.02):
        best, most = points[gains.argmax()], gains.max()
        around = np.clip(best + width * rng.normal(size=(256, DIM)), low, high)
        points, gains = np.vstack([best, around]), np.append(most, gain(around))
    return points[gains.argmax()]


@dataclass(frozen=True)
class Differences:
    """DiffTune's step along a gradient of the simulator, by forward differences.

    A round of 18 walks gives a gradient, one more walk evaluates the step; a step that raises the
    loss is halved and tried again along the same gradient.
    """

    tune: TuneConfig
    step: float = math.log(1.05)  # of the differences, in log-weights
    most: int = DIM

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """Return the 18 neighbours of the current point, or the next step."""
        box = log_bounds(start)
        point, loss = past[0].steps[0], past[0].losses[0]
        scale, gradient, offsets = 1.0, None, self._offsets(box, point)
        for generation in past[1:]:
            if gradient is None:
                slopes = (generation.losses - loss) / offsets
                gradient = np.where(np.isfinite(slopes), slopes, 0.0)
            elif generation.losses[0] < loss:
                point, loss = generation.steps[0], generation.losses[0]
                scale, gradient, offsets = min(1.0, 2.0 * scale), None, self._offsets(box, point)
            else:
                scale /= 2.0
        if gradient is None:
            return np.asarray(point + np.diag(offsets))
        if scale < self.tune.smallest_step:
            return np.zeros((0, DIM))
        return self._step_from(start, point, gradient, scale)[None]

    def _offsets(self, box: np.ndarray, point: np.ndarray) -> Float[np.ndarray, "18"]:
        return np.where(point + self.step > box[:, 1], -self.step, self.step)

    def _step_from(
        self, start: Weights, point: np.ndarray, gradient: np.ndarray, scale: float
    ) -> Float[np.ndarray, "18"]:
        weights = project(start, point)
        flat = (gradient @ directions()) / np.asarray(weights_to_vector(weights))
        tree = jax.tree.map(np.asarray, vector_to_weights(jnp.asarray(flat)))
        return steps_to(start, step_weights(self.tune, weights, tree, scale))


@dataclass(frozen=True)
class Given:
    """Weights from elsewhere, in their order."""

    steps: tuple[tuple[float, ...], ...]
    most: int = 10

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """Return the next weights."""
        done = sum(len(generation.losses) for generation in past[1:])
        return np.array(self.steps[done : done + self.most], float).reshape(-1, DIM)


def adam(
    config: TuneConfig,
    rate: float,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
) -> list[Iteration]:
    """Run Adam in log-weights on the model with one R for all feet, projected onto the box.

    Weights that fall or cannot be solved are rejected: the step is undone and the rate halved.

    Args:
        config: rollouts, loss, number of iterations and limits of the rejection.
        rate: of Adam, in log-weights.
        robot, weights, command, anchor, effect: see `difftune.tune`.
        on_iteration: called after each iteration; the start is iteration 0.

    Raises:
        InputError: the starting weights fall or cannot be solved on the model.
    """
    optimiser, box = optax.adam(1.0), log_bounds(weights)
    history: list[Iteration] = []

    def evaluate(steps: np.ndarray, scale: float) -> Iteration:
        trial = project(weights, steps)
        evaluation = jax.device_get(tune_step(config, robot, trial, command, anchor, effect))
        row = len(history), trial, evaluation, step_status(config, evaluation), scale
        iteration = Iteration(*jax.tree.map(np.asarray, row))
        history.append(iteration)
        on_iteration(iteration)
        return iteration

    steps = np.zeros(DIM)
    best, state, scale = evaluate(steps, 0.0), optimiser.init(steps), 1.0
    if not best.accepted:
        raise InputError(f"the starting weights cannot be tuned from: {best.reason}")
    for _ in range(config.iterations):
        logs = jax.tree.map(np.multiply, best.evaluation.gradient, best.weights)
        gradient = directions() @ np.asarray(weights_to_vector(logs))
        update, next_state = optimiser.update(gradient, state)
        trial = np.clip(steps + scale * rate * np.asarray(update), *box.T)
        iteration = evaluate(trial, scale)
        if iteration.accepted:
            steps, best, state, scale = trial, iteration, next_state, min(1.0, 2.0 * scale)
        else:
            scale /= 2.0
        if scale < config.smallest_step:
            break
    return history
