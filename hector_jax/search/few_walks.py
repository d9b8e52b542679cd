"""Which weights to walk next, where walks are dear: proposals that follow from the walks so far.

Points are steps of the log-weights in the metric of the model: its Gauss-Newton matrix is near the
identity there, so that no walk is spent on learning which directions matter. A point comes from one
of three methods:

- `model`: the least loss, in a trust region about the best walk, of the rigid-body model grounded
  on that walk (tuning/grounded.py). This goes on until two walks in a row gain less than 1 %;
  a point that was walked already is left to the surrogate.
- `surrogate`: the largest expected improvement, in the trust region, by a Gaussian process on the
  log-losses of all walks, times the probability of a margin against falls. It sees what the model
  does not feel.
- `evolution`: a sample of CMA-ES, each fourth walk from then on, in case both are wrong.

The trust region grows where a walk gains what was predicted, and shrinks where it does not
(ratio test: Conn, Gould, Toint, "Trust region methods", 2000). A proposal follows from the history
alone; nothing else is remembered.
"""

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError

_FLAT = 0.25  # added to the eigenvalues of the metric: a flat direction's unit step is two e-folds
_FIRST, _LEAST, _MOST = 1.0, 0.3, 4.0  # radius of the trust region
_GAIN = 0.01  # least gain in log-loss that counts
_STALLED = 2  # walks of the model in a row without it, after which the surrogate takes over
_EVERY, _POPULATION, _SPREAD = 4, 8, 0.3  # of CMA-ES: how often, how many, first deviation
_SAME = 0.02  # nearer to a walk the model's point is not walked
_STARTS = 6  # of the maximisation of the expected improvement
_ROWS = 16  # histories are filled up to multiples of this, so that few programs are compiled
# of the processes, log-normal: amplitude, length, noise of one walk (their deviations below)
_PRIOR = np.log([0.3, 3.0, 0.01]), np.array([0.7, 0.7, 0.5])


class Space(NamedTuple):
    """Coordinates in which a loss is nearly round, and the box in them."""

    to_steps: Float[np.ndarray, "n n"]  # steps of the tuned numbers = to_steps @ point
    to_point: Float[np.ndarray, "n n"]  # its inverse
    curvature: Float[np.ndarray, " n"]  # of the log-loss along each coordinate
    box: Float[np.ndarray, "n 2"]  # of the steps

    def clip(self, point: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The point whose steps are those of `point`, inside the box."""
        return self.to_point @ np.clip(self.to_steps @ point, *self.box.T)


def space_of(matrix: Float[np.ndarray, "m m"], box: Float[np.ndarray, "n 2"]) -> Space:
    """Space of a loss.

    Args:
        matrix: its Gauss-Newton matrix divided by the loss, for the first m steps. Of the others
            nothing is known: a unit step of each is one coordinate.
        box: of the steps.
    """
    sizes, vectors = np.linalg.eigh(matrix)
    sizes, others = np.maximum(sizes, 0.0), len(box) - len(matrix)
    roots = np.append(np.sqrt(sizes + _FLAT), np.ones(others))
    axes = np.eye(len(box))
    axes[: len(matrix), : len(matrix)] = vectors
    curvature = np.append(sizes / (sizes + _FLAT), np.zeros(others))
    return Space(axes / roots, (axes * roots).T, curvature, box)


class Walked(NamedTuple):
    """A proposal, and what its walk came to."""

    point: Float[np.ndarray, " n"]
    method: str  # "start" for the first
    predicted: float | None  # log-loss; None where nothing was
    loss: float  # log-loss; infinite where the robot fell
    margin: float  # share of the way to a fall; 1 where it fell


class Proposal(NamedTuple):
    """What to walk next."""

    point: Float[np.ndarray, " n"]
    method: str
    predicted: float | None


Model = Callable[[Float[np.ndarray, " n"]], tuple[float, Float[np.ndarray, " n"]]]
"""Log-loss of the grounded model at a point, and its gradient."""


class _Region(NamedTuple):
    """Where the next point is looked for: a ball, and the methods' turn."""

    center: int  # of the history
    radius: float
    stalled_at: int | None  # length of the history when the model gave way to the surrogate


def _region(history: Sequence[Walked]) -> _Region:
    """Walk through a history; see the module's docstring."""
    best, radius, stalls, stalled_at = 0, _FIRST, 0, None
    for i, row in enumerate(history[1:], 1):
        if row.method == "surrogate" and stalled_at is None:  # the model had nothing new to say
            stalled_at, radius = i, _FIRST
        low = history[best].loss
        gain = low - row.loss
        if row.predicted is not None:
            expected = max(low - row.predicted, _GAIN)
            if gain < 0.1 * expected:
                radius = max(radius / 1.6, _LEAST)
            elif gain > 0.5 * expected:
                radius = min(radius * 1.6, _MOST)
        if row.method == "model":
            stalls = 0 if gain > _GAIN else stalls + 1
            if stalls == _STALLED:
                stalled_at, radius = i + 1, _FIRST
        if gain > 0.0:
            best = i
    return _Region(best, radius, stalled_at)


def incumbent(space: Space, history: Sequence[Walked]) -> int:
    """Index of the walk to believe in: of the least posterior mean, not of the luckiest walk.

    Until there are walks enough for a posterior, of the least loss.
    """
    if _region(history).stalled_at is None:
        return int(np.argmin([row.loss for row in history]))
    return _fit_losses(space, history)[1]


def needs_model(history: Sequence[Walked]) -> bool:
    """Whether the next proposal asks the model, grounded on the walk `best_walk`."""
    return bool(history) and _region(history).stalled_at is None


def best_walk(history: Sequence[Walked]) -> int:
    """Index of the walk with the least loss."""
    return _region(history).center


def propose(
    space: Space, history: Sequence[Walked], model: Model | None = None, seed: int = 0
) -> Proposal:
    """What to walk next.

    Args:
        space: coordinates.
        history: walks so far, the start first.
        model: grounded on the best walk; asked where `needs_model`.
        seed: of the draws.

    Raises:
        InputError: the packages of the extra `search` are not installed.
    """
    size = len(space.box)
    if not history:
        return Proposal(np.zeros(size), "start", None)
    region = _region(history)
    if region.stalled_at is None:
        if model is None:
            raise ValueError("the next proposal needs the model")
        center = history[region.center].point
        point, predicted = _minimise_in(space, center, region.radius, model, center, 15)
        point = space.clip(point)
        if min(np.linalg.norm(point - row.point) for row in history) > _SAME:
            return Proposal(point, "model", float(predicted))
        region = region._replace(radius=_FIRST)
    elif (len(history) - region.stalled_at) % _EVERY == _EVERY - 1:
        return Proposal(space.clip(_evolved(history, region, seed)), "evolution", None)
    return _improve(space, history, region.radius, np.random.default_rng([seed, len(history)]))


def _minimise_in(
    space: Space,
    center: Float[np.ndarray, " n"],
    radius: float,
    objective: Model,
    first: Float[np.ndarray, " n"],
    iterations: int,
) -> tuple[Float[np.ndarray, " n"], float]:
    """Least value that sequential quadratic programming sees in a ball and the box, and where."""
    lower, upper = space.box.T
    ball = {
        "type": "ineq",
        "fun": lambda x: radius**2 - np.sum((x - center) ** 2),
        "jac": lambda x: -2.0 * (x - center),
    }
    box = {
        "type": "ineq",
        "fun": lambda x: np.append(space.to_steps @ x - lower, upper - space.to_steps @ x),
        "jac": lambda x: np.append(space.to_steps, -space.to_steps, axis=0),
    }
    seen: list[tuple[float, Any]] = []

    def value(x: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        loss, gradient = objective(x)
        if np.linalg.norm(x - center) <= 1.02 * radius:
            seen.append((float(loss), np.array(x)))
        return float(loss), np.asarray(gradient, float)

    options = {"maxiter": iterations, "ftol": 1e-5}
    minimize(value, first, jac=True, method="SLSQP", constraints=[ball, box], options=options)
    if not seen:
        return center, float(objective(center)[0])
    loss, point = min(seen, key=lambda one: one[0])
    return point, loss


# The surrogate


class _Fitted(NamedTuple):
    """A Gaussian process with its numbers, fitted to a history; factored once."""

    process: Any  # tinygp's, of the values less `offset` and `_bowl`
    y: Array
    curvature: Array
    offset: float


def _process(theta: Any, X: Any, used: Any) -> Any:
    """Process on a history that is filled up with rows that are not `used`."""
    from tinygp import GaussianProcess, kernels

    amplitude, length, noise = jnp.exp(theta)
    distance = kernels.distance.L2Distance()
    near = kernels.RationalQuadratic(scale=length, distance=distance, alpha=2.0)
    # a slope is as large as the loss itself where nothing was walked
    kernel = amplitude**2 * near + kernels.DotProduct() + kernels.Constant(1.0)
    return GaussianProcess(kernel, X, diag=jnp.where(used, noise**2, 1e8))


_factored = jax.jit(_process)


def _bowl(curvature: Any, x: Any) -> Any:
    """What the metric says of the log-loss at points x (..., n)."""
    return 0.5 * (curvature * x**2).sum(axis=-1)


@jax.jit
def _misfit(theta: Array, X: Array, used: Array, y: Array) -> tuple[Array, Array]:
    """Negative log posterior of the process's numbers, and its gradient."""
    mean, deviation = map(jnp.asarray, _PRIOR)

    def objective(theta: Array) -> Array:
        prior = 0.5 * jnp.sum(((theta - mean) / deviation) ** 2)
        return prior - _process(theta, X, used).log_probability(y)

    return jax.value_and_grad(objective)(theta)


def _fit(
    points: Float[np.ndarray, "m n"],
    values: Float[np.ndarray, " m"],
    curvature: Float[np.ndarray, " n"],
) -> _Fitted:
    count, offset = len(values), float(np.mean(values))
    more = -count % _ROWS
    X, used = jnp.asarray(np.pad(points, ((0, more), (0, 0)))), jnp.arange(count + more) < count
    y = jnp.asarray(np.pad(values - offset - _bowl(curvature, points), (0, more)))
    mean, deviation = _PRIOR

    def misfit(theta: Float[np.ndarray, "3"]) -> tuple[float, Float[np.ndarray, "3"]]:
        value, gradient = _misfit(jnp.asarray(theta), X, used, y)
        return float(value), np.asarray(gradient, float)

    box = np.stack([mean - 3 * deviation, mean + 3 * deviation], axis=1)
    found = minimize(misfit, mean, jac=True, method="L-BFGS-B", bounds=box)
    process = _factored(jnp.asarray(found.x), X, used)
    return _Fitted(process, y, jnp.asarray(curvature), offset)


def _posterior(fitted: _Fitted, point: Array) -> tuple[Array, Array]:
    """Mean and standard deviation at a point."""
    there = fitted.process.condition(fitted.y, point[None]).gp
    mean = there.loc[0] + _bowl(fitted.curvature, point) + fitted.offset
    return mean, jnp.sqrt(jnp.maximum(there.variance[0], 1e-12))


_means = jax.jit(jax.vmap(lambda fitted, point: _posterior(fitted, point)[0], (None, 0)))


def _log_improvement(mean: Array, deviation: Array, low: Array | float) -> Array:
    """Log of the expected improvement on `low`, by its asymptote where it underflows."""
    u = (low - mean) / deviation
    normal = jax.scipy.stats.norm
    near = jnp.log(jnp.maximum(normal.pdf(u) + u * normal.cdf(u), 1e-30))
    far = normal.logpdf(u) - 2.0 * jnp.log(jnp.maximum(-u, 1.0))
    return jnp.log(deviation) + jnp.where(u > -5.0, near, far)


@jax.jit
def _acquisition(
    losses: _Fitted, margins: _Fitted, low: Array | float, most: Array | float, point: Array
) -> tuple[Array, Array]:
    """Negative log of expected improvement times the probability of a margin, and its gradient."""

    def objective(point: Array) -> Array:
        mean, deviation = _posterior(margins, point)
        safe = jax.scipy.stats.norm.logcdf((most - mean) / deviation)
        return -_log_improvement(*_posterior(losses, point), low) - safe

    return jax.value_and_grad(objective)(point)


def _fit_losses(space: Space, history: Sequence[Walked]) -> tuple[_Fitted, int, float]:
    """The process of the losses; which walk has the least posterior mean, and that mean."""
    if find_spec("tinygp") is None:
        raise InputError(
            'walks beyond the model need the package tinygp: pip install "hector-jax[search]"'
        )
    stood = [i for i, row in enumerate(history) if np.isfinite(row.loss)]
    points = np.array([history[i].point for i in stood])
    fitted = _fit(points, np.array([history[i].loss for i in stood]), space.curvature)
    means = np.asarray(_means(fitted, fitted.process.X))[: len(stood)]
    which = int(np.argmin(means))
    return fitted, stood[which], float(means[which])


def _improve(
    space: Space, history: Sequence[Walked], radius: float, rng: np.random.Generator
) -> Proposal:
    """Point of the largest expected improvement that keeps a margin."""
    losses, which, low = _fit_losses(space, history)
    points = np.array([row.point for row in history])
    margins = _fit(points, np.array([row.margin for row in history]), np.zeros(len(space.box)))
    most = 0.5 * (1.0 + history[0].margin)  # half of what the start had left may be used up
    center = history[which].point

    def objective(x: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        value, gradient = _acquisition(losses, margins, low, most, jnp.asarray(x))
        return float(value), np.asarray(gradient, float)

    found = []
    for start in range(_STARTS):
        away = rng.standard_normal(len(center)) * 0.7 * radius / np.sqrt(len(center))
        first = center + (away if start else 0.0)
        found.append(_minimise_in(space, center, radius, objective, first, 40))
    point = space.clip(min(found, key=lambda one: one[1])[0])
    mean, _ = _posterior(losses, jnp.asarray(point))
    return Proposal(point, "surrogate", float(mean))


# The evolution strategy


def _evolved(history: Sequence[Walked], region: _Region, seed: int) -> Float[np.ndarray, " n"]:
    """The next sample of CMA-ES, which was told all walks since the model stalled."""
    if find_spec("cmaes") is None:
        raise InputError('walks need the package cmaes: pip install "hector-jax[search]"')
    from cmaes import CMA

    since = region.stalled_at or 0
    first = history[best_walk(history[:since])]
    evolution = CMA(first.point, _SPREAD, seed=seed, population_size=_POPULATION)
    worst = max(row.loss for row in history if np.isfinite(row.loss))
    told: list[tuple[Any, float]] = []
    for row in history[since:]:
        if row.method == "evolution":
            evolution.ask()  # draws what was drawn then
        told.append((row.point, row.loss if np.isfinite(row.loss) else worst + 1.0))
        if len(told) == _POPULATION:
            evolution.tell(told)
            told = []
    return evolution.ask()
