"""Ways to tune the weights with walks on a simulator, each asked in rounds what it walks next.

An optimizer is a pure function of what was walked: the start alone, then a `Generation` for each of
its rounds. So a benchmark can be cut and taken up, optimizers go in lock-step and think in other
processes. All move in 18 log-weights inside the box, from one start. Those that follow the gradient
of a model learn nothing from the walks: theirs is a `Given` list of weights, which is only judged.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
Steps = Float[np.ndarray, "walks 18"]  # log-weights, less those of the start


@runtime_checkable
class Optimizer(Protocol):
    """Chooses what is walked next."""

    @property
    def most(self) -> int:
        """Walks in a round, at most."""
        ...

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """What to walk next; nothing once it has ended. `past` begins with the start itself."""
        ...


def steps_to(start: Weights, weights: Weights) -> Float[np.ndarray, "18"]:
    """Steps in log-weights from a start to weights whose feet share one R."""
    flat = [np.asarray(weights_to_vector(w), float) for w in (weights, start)]
    return np.log(flat[0] / flat[1])[directions().argmax(axis=1)]


@dataclass(frozen=True)
class Random:
    """Draws about the start, whatever came."""

    seed: int = 0
    spread: float = 1.0  # standard deviation of each log-weight
    most: int = 10

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """The next draws, those outside the box moved to its edge."""
        draws = np.random.default_rng([self.seed, len(past)]).normal(size=(self.most, DIM))
        return np.clip(self.spread * draws, *log_bounds(start).T)


@dataclass(frozen=True)
class CmaEs:
    """The search of `search.cmaes`."""

    config: SearchConfig = SearchConfig()

    @property
    def most(self) -> int:
        """Its population."""
        return self.config.population

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """Its next generation."""
        search = CmaSearch(self.config, start)
        search.replay(past[1:])
        return np.zeros((0, DIM)) if search.stop else search.ask()


@dataclass(frozen=True)
class Bayes:
    """Bayesian optimisation: the largest expected improvement under a Gaussian process.

    The process is fitted to log L with a Matern 5/2 kernel that has a length for each weight, and
    noise. The first round is that of `Random`; later ones are chosen one by one, what is chosen
    being taken for the best loss so far until it is walked (constant liar).
    """

    seed: int = 0
    reach: float = math.inf  # largest step of a log-weight; by default as far as the box
    spread: float = 1.0  # of the first round
    most: int = 10

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """The next round.

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
            warnings.simplefilter("ignore")  # lengths at their bounds
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
        lengths: Any = np.full(DIM, 3.0)  # the stubs say float, the page of the class an array too
        matern = Matern(lengths, length_scale_bounds=(0.3, 100.0), nu=2.5)
        kernel = ConstantKernel(1.0, (1e-2, 1e2)) * matern + WhiteKernel(1e-2, (1e-6, 1.0))
        fitted = GaussianProcessRegressor(
            kernel,
            normalize_y=True,
            n_restarts_optimizer=1,
            random_state=int(rng.integers(2**31)),
        ).fit(steps, logs)
        keep: Any = None  # the kernel; the stubs do not know that it can be None
        process = GaussianProcessRegressor(fitted.kernel_, optimizer=keep, normalize_y=True)
        for _ in range(self.most):
            process.fit(steps, logs)
            near = steps[np.argsort(logs)[:5]]
            spot = _most_promising(
                rng, box, near, lambda x: process.predict(x, return_std=True), logs.min()
            )
            steps, logs = np.vstack([steps, spot]), np.append(logs, logs.min())
        return steps[-self.most :]


def _most_promising(
    rng: np.random.Generator,
    box: Float[np.ndarray, "18 2"],
    near: Float[np.ndarray, "best 18"],
    predict: Callable,
    least: float,
) -> Float[np.ndarray, "18"]:
    """Where the expected improvement is largest: draws all over, about the best, then refined."""

    def gain(at: np.ndarray) -> np.ndarray:
        mean, deviation = predict(at)
        z = (least - mean) / np.maximum(deviation, 1e-12)
        return deviation * (z * norm.cdf(z) + norm.pdf(z))

    low, high = box.T
    width = np.exp(rng.uniform(np.log(0.03), 0.0, (2048, 1)))
    about = near[rng.integers(len(near), size=2048)] + width * rng.normal(size=(2048, DIM))
    tried = np.clip(np.vstack([rng.uniform(low, high, (2048, DIM)), about]), low, high)
    gains = gain(tried)
    for width in (0.3, 0.2, 0.1, 0.05, 0.02):
        best, most = tried[gains.argmax()], gains.max()
        around = np.clip(best + width * rng.normal(size=(256, DIM)), low, high)
        tried, gains = np.vstack([best, around]), np.append(most, gain(around))
    return tried[gains.argmax()]


@dataclass(frozen=True)
class Differences:
    """DiffTune's step along a gradient of the simulator itself, by forward differences.

    A round of 18 walks makes a gradient, one more walk judges the step; a step that raises the loss
    is halved and tried again along the same gradient.
    """

    tune: TuneConfig
    step: float = math.log(1.05)  # of the differences, in log-weights
    most: int = DIM

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """The 18 neighbours of where it is, or the next step."""
        box = log_bounds(start)
        at, loss = past[0].steps[0], past[0].losses[0]
        share, gradient, offsets = 1.0, None, self._offsets(box, at)
        for generation in past[1:]:
            if gradient is None:
                slopes = (generation.losses - loss) / offsets
                gradient = np.where(np.isfinite(slopes), slopes, 0.0)
            elif generation.losses[0] < loss:
                at, loss = generation.steps[0], generation.losses[0]
                share, gradient, offsets = min(1.0, 2.0 * share), None, self._offsets(box, at)
            else:
                share /= 2.0
        if gradient is None:
            return np.asarray(at + np.diag(offsets))
        if share < self.tune.smallest_step:
            return np.zeros((0, DIM))
        return self._step_from(start, at, gradient, share)[None]

    def _offsets(self, box: np.ndarray, at: np.ndarray) -> Float[np.ndarray, "18"]:
        return np.where(at + self.step > box[:, 1], -self.step, self.step)

    def _step_from(
        self, start: Weights, at: np.ndarray, gradient: np.ndarray, share: float
    ) -> Float[np.ndarray, "18"]:
        weights = project(start, at)
        flat = (gradient @ directions()) / np.asarray(weights_to_vector(weights))
        tree = jax.tree.map(np.asarray, vector_to_weights(jnp.asarray(flat)))
        return steps_to(start, step_weights(self.tune, weights, tree, share))


@dataclass(frozen=True)
class Given:
    """Weights that were found elsewhere, in their order."""

    steps: tuple[tuple[float, ...], ...]
    most: int = 10

    def ask(self, start: Weights, past: Sequence[Generation]) -> Steps:
        """The next of them."""
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
    """Adam in log-weights on the model, the feet sharing one R, projected onto the box.

    Args:
        config: rollouts, loss, how many iterations, and what is refused: weights that fall or
            cannot be solved, from which it goes back and halves its rate.
        rate: of Adam, in log-weights.
        robot, weights, command, anchor, effect: as of `difftune.tune`.
        on_iteration: called after each iteration, the start being iteration 0.

    Raises:
        InputError: the starting weights fall or cannot be solved on the model.
    """
    optimiser, box = optax.adam(1.0), log_bounds(weights)
    history: list[Iteration] = []

    def look(steps: np.ndarray, share: float) -> Iteration:
        at = project(weights, steps)
        evaluation = jax.tree.map(np.asarray, tune_step(config, robot, at, command, anchor, effect))
        row = len(history), at, evaluation, step_status(config, evaluation), share
        iteration = Iteration(*jax.tree.map(np.asarray, row))
        history.append(iteration)
        on_iteration(iteration)
        return iteration

    at = np.zeros(DIM)
    best, state, share = look(at, 0.0), optimiser.init(at), 1.0
    if not best.accepted:
        raise InputError(f"the starting weights cannot be tuned from: {best.reason}")
    for _ in range(config.iterations):
        flat = jax.tree.map(np.multiply, best.evaluation.gradient, best.weights)
        gradient = directions() @ np.asarray(weights_to_vector(flat))
        update, later = optimiser.update(gradient, state)
        trial = np.clip(at + share * rate * np.asarray(update), *box.T)
        iteration = look(trial, share)
        if iteration.accepted:
            at, best, state, share = trial, iteration, later, min(1.0, 2.0 * share)
        else:
            share /= 2.0
        if share < config.smallest_step:
            break
    return history
