"""Proposals of the weights to walk next, from the history of walks, if walks are expensive.

Points are steps of the log-weights in the metric of the model: its Gauss-Newton matrix is near the
identity there, so that no walk is needed to learn which directions matter. A point comes from one
of two methods:

- `model`: the least loss, in a trust region about the best walk, of the rigid-body model grounded
  on that walk (tuning/grounded.py), until two walks in a row gain less than 1 %. If its point was
  walked already, the surrogate takes over. A model can also be grounded on all walks, where they
  never repeat: one tells little of a gain, so the region is about the last that was no worse than
  the start, and grows with each of these.
- `surrogate`: the largest expected improvement, in the trust region, by a Gaussian process on the
  log-losses of all walks, times the probability of a margin against falls. It learns what the model
  does not contain.

The trust region grows if a walk gains what was predicted, and shrinks if it does not (ratio test:
Conn, Gould, Toint, "Trust region methods", 2000). A proposal is a function of the history alone.
"""

from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float
from scipy.optimize import LinearConstraint, NonlinearConstraint, minimize

from hector_jax.core.arrays import Array
from hector_jax.core.inputs import require_package
from hector_jax.tuning import step_rules
from hector_jax.tuning.step_rules import StepState

# added to the eigenvalues of the metric: a flat direction has a unit step of two e-folds
_FLAT = 0.25
_FIRST, _LEAST, _MOST = 1.0, 0.3, 4.0  # radius of the trust region
GAIN = 0.01
"""Smallest significant gain in log-loss."""
_STALLED = 2  # walks of the model in a row without such a gain before the surrogate takes over
_STEPS, _MANY_STEPS = 2, 5  # for a proposal on the model of one walk, and of all
_SAME = 0.02  # the model's point counts as walked within this distance of a walk
_STARTS, _SQP = 6, 40  # of the maximisation of the expected improvement: starts, iterations
_ROWS = 16  # histories are padded to multiples of this, so that few programs are compiled
# means and deviations of the processes' log-normal amplitude, length and noise of one walk
_PRIOR = np.log([0.3, 3.0, 0.01]), np.array([0.7, 0.7, 0.5])


class Space(NamedTuple):
    """Coordinates in which the level sets of a loss are nearly spheres, and the box."""

    to_steps: Float[np.ndarray, "n n"]  # steps of the tuned numbers = to_steps @ point
    to_point: Float[np.ndarray, "n n"]  # its inverse
    curvature: Float[np.ndarray, " n"]  # of the log-loss along each coordinate
    box: Float[np.ndarray, "n 2"]  # of the steps

    def clip(self, point: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the point whose steps are those of `point`, clipped to the box."""
        return self.to_point @ np.clip(self.to_steps @ point, *self.box.T)


def space_of(matrix: Float[np.ndarray, "m m"], box: Float[np.ndarray, "n 2"]) -> Space:
    """Return the space of a loss.

    Args:
        matrix: its Gauss-Newton matrix divided by the loss, for the first m steps. The curvature of
            the others is unknown: a unit step of each is one coordinate.
        box: of the steps.
    """
    eigenvalues, vectors = np.linalg.eigh(matrix)
    eigenvalues, others = np.maximum(eigenvalues, 0.0), len(box) - len(matrix)
    roots = np.append(np.sqrt(eigenvalues + _FLAT), np.ones(others))
    axes = np.eye(len(box))
    axes[: len(matrix), : len(matrix)] = vectors
    curvature = np.append(eigenvalues / (eigenvalues + _FLAT), np.zeros(others))
    return Space(axes / roots, (axes * roots).T, curvature, box)


class WalkResult(NamedTuple):
    """A proposal, and the result of its walk."""

    point: Float[np.ndarray, " n"]
    method: str  # "start" for the first
    predicted: float | None  # log-loss; None without a prediction
    loss: float  # log-loss; infinite after a fall
    margin: float  # share of the way to a fall; 1 after a fall


class Proposal(NamedTuple):
    """The point to walk next."""

    point: Float[np.ndarray, " n"]
    method: str
    predicted: float | None


class Model(NamedTuple):
    """Functions of a point on the grounded model."""

    # loss relative to the start, infinite if the model falls, and its gradient
    evaluate: Callable[[Float[np.ndarray, " n"]], tuple[float, Float[np.ndarray, " n"]]]
    matrix: Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, "n n"]]  # Gauss-Newton matrix
    every_walk: bool = False  # grounded on all walks, not on the best


class _Region(NamedTuple):
    """The trust region of the next point, and the method."""

    center: int  # index of the best walk in the history
    radius: float
    stalled_at: int | None  # length of the history when the surrogate took over from the model


def _region(history: Sequence[WalkResult]) -> _Region:
    """Compute the trust region from a history; see the module's docstring."""
    best, radius, stalls, stalled_at = 0, _FIRST, 0, None
    for i, row in enumerate(history[1:], 1):
        if row.method != "model" and stalled_at is None:  # the model repeated a point, or is absent
            stalled_at, radius = i, _FIRST
        best_loss = history[best].loss
        gain = best_loss - row.loss
        if row.predicted is not None:
            expected = max(best_loss - row.predicted, GAIN)
            if gain < 0.1 * expected:
                radius = max(radius / 1.6, _LEAST)
            elif gain > 0.5 * expected:
                radius = min(radius * 1.6, _MOST)
        if row.method == "model":
            stalls = 0 if gain > GAIN else stalls + 1
            if stalls == _STALLED:
                stalled_at, radius = i + 1, _FIRST
        if gain > 0.0:
            best = i
    return _Region(best, radius, stalled_at)


def incumbent(space: Space, history: Sequence[WalkResult]) -> int:
    """Return the index of the walk of the least posterior mean, not of the luckiest walk.

    Before the surrogate takes over, of the walk of the least loss.
    """
    if _region(history).stalled_at is None:
        return int(np.argmin([row.loss for row in history]))
    return _fit_losses(space, history)[1]


def needs_model(history: Sequence[WalkResult]) -> bool:
    """Return True if the next proposal may use the model, grounded on the walk `best_walk`."""
    return bool(history) and _region(history).stalled_at is None


def best_walk(history: Sequence[WalkResult]) -> int:
    """Return the index of the walk with the least loss."""
    return _region(history).center


def propose(
    space: Space,
    history: Sequence[WalkResult],
    model: Model | None = None,
    seed: int = 0,
) -> Proposal:
    """Propose the point to walk next.

    Args:
        space: coordinates.
        history: walks so far, the start first.
        model: grounded on the best walk; only used if `needs_model`. None: the surrogate proposes.
        seed: of the draws.

    Raises:
        InputError: the packages of the extra `search` are not installed.
    """
    if not history:
        return Proposal(np.zeros(len(space.box)), "start", None)
    region = _region(history)
    if model is not None and needs_model(history):
        center, radius = region.center, region.radius
        if model.every_walk:
            no_worse = [i for i, row in enumerate(history) if row.loss <= history[0].loss]
            center, radius = no_worse[-1], min(_FIRST * len(no_worse), _MOST)
        point, predicted = _descend_in(space, history[center].point, radius, model)
        if min(np.linalg.norm(point - row.point) for row in history) > _SAME:
            return Proposal(point, "model", float(predicted))
        region = region._replace(radius=_FIRST)
    return _improve(space, history, region.radius, np.random.default_rng([seed, len(history)]))


def _descend_in(
    space: Space, center: Float[np.ndarray, " n"], radius: float, model: Model
) -> tuple[Float[np.ndarray, " n"], float]:
    """Take Gauss-Newton steps on the model in a ball and the box; returns point and log-loss."""
    rule = step_rules.trust_region(ridge=0.0)
    state = cast(StepState, rule.init(jnp.zeros(len(center))))._replace(size=jnp.asarray(radius))
    point, steps = center, _MANY_STEPS if model.every_walk else _STEPS
    for step in range(steps + 1):
        loss, gradient = model.evaluate(point)
        used = step < steps and loss < state.value  # else the rule leaves the point again
        matrix = model.matrix(point) if used else np.zeros((len(point), len(point)))
        given = {"value": jnp.asarray(loss), "matrix": jnp.asarray(matrix)}
        away = jnp.asarray(point - center)
        updates, state = rule.update(jnp.asarray(gradient), state, away, **given)
        away = optax.projections.projection_l2_ball(optax.apply_updates(away, updates), radius)
        point = space.clip(center + np.asarray(away))
    state = cast(StepState, state)
    return center + np.asarray(state.steps), float(jnp.log(state.value))


def _minimise_in(
    space: Space,
    center: Float[np.ndarray, " n"],
    radius: float,
    objective: Callable[..., Any],
    first: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], float]:
    """Minimise in a ball and the box by SQP; returns the best point evaluated and its value."""
    square = lambda x: np.sum((x - center) ** 2)  # noqa: E731
    slope: Any = lambda x: 2.0 * (x - center)  # noqa: E731
    ball = NonlinearConstraint(square, -np.inf, radius**2, jac=slope)
    box = LinearConstraint(space.to_steps, *space.box.T)
    feasible: list[tuple[float, Any]] = []

    def value(x: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        loss, gradient = objective(x)
        if np.linalg.norm(x - center) <= 1.02 * radius:
            feasible.append((float(loss), np.array(x)))
        return float(loss), np.asarray(gradient, float)

    options = {"maxiter": _SQP, "ftol": 1e-5}
    minimize(value, first, jac=True, method="SLSQP", constraints=[ball, box], options=options)
    if not feasible:
        return center, float(objective(center)[0])
    loss, point = min(feasible, key=itemgetter(0))
    return point, loss


# The surrogate


class _Fit(NamedTuple):
    """A Gaussian process with its hyperparameters, fitted to a history; factored once."""

    process: Any  # of tinygp, for the values less `offset` and `_quadratic`
    y: Array
    curvature: Array
    offset: float


@jax.jit
def _process(theta: Any, X: Any, used: Any) -> Any:
    """Return the process on a history; rows that are not `used` are padding."""
    from tinygp import GaussianProcess, kernels

    amplitude, length, noise = jnp.exp(theta)
    distance = kernels.distance.L2Distance()
    near = kernels.RationalQuadratic(scale=length, distance=distance, alpha=2.0)
    # without walks nearby, a slope is as large as the loss itself
    kernel = amplitude**2 * near + kernels.DotProduct() + kernels.Constant(1.0)
    return GaussianProcess(kernel, X, diag=jnp.where(used, noise**2, 1e8))


def _quadratic(curvature: Any, x: Any) -> Any:
    """Return the log-loss that the metric predicts at points x (..., n)."""
    return 0.5 * (curvature * x**2).sum(axis=-1)


@jax.jit
def _misfit(theta: Array, X: Array, used: Array, y: Array) -> tuple[Array, Array]:
    """Return the negative log posterior of the process's hyperparameters and its gradient."""
    mean, deviation = map(jnp.asarray, _PRIOR)

    def objective(theta: Array) -> Array:
        prior = 0.5 * jnp.sum(((theta - mean) / deviation) ** 2)
        return prior - _process(theta, X, used).log_probability(y)

    return jax.value_and_grad(objective)(theta)


def _fit(
    points: Float[np.ndarray, "m n"],
    values: Float[np.ndarray, " m"],
    curvature: Float[np.ndarray, " n"],
) -> _Fit:
    count, offset = len(values), float(np.mean(values))
    padding = (0, -count % _ROWS)
    X, used = jnp.asarray(np.pad(points, (padding, (0, 0)))), np.pad(np.ones(count, bool), padding)
    y = jnp.asarray(np.pad(values - offset - _quadratic(curvature, points), padding))
    mean, deviation = _PRIOR
    misfit = partial(_misfit, X=X, used=used, y=y)
    box = np.stack([mean - 3 * deviation, mean + 3 * deviation], axis=1)
    theta = minimize(misfit, mean, jac=True, method="L-BFGS-B", bounds=box).x
    return _Fit(_process(theta, X, used), y, jnp.asarray(curvature), offset)


def _posterior(fit: _Fit, point: Array) -> tuple[Array, Array]:
    """Return mean and standard deviation at a point."""
    posterior = fit.process.condition(fit.y, point[None]).gp
    mean = posterior.loc[0] + _quadratic(fit.curvature, point) + fit.offset
    return mean, jnp.sqrt(jnp.maximum(posterior.variance[0], 1e-12))


_means = jax.jit(jax.vmap(lambda fit, point: _posterior(fit, point)[0], (None, 0)))


def _log_improvement(mean: Array, deviation: Array, least: Array | float) -> Array:
    """Return the log of the expected improvement on `least`; its asymptote if it underflows."""
    u = (least - mean) / deviation
    normal = jax.scipy.stats.norm
    near = jnp.log(jnp.maximum(normal.pdf(u) + u * normal.cdf(u), 1e-30))
    far = normal.logpdf(u) - 2.0 * jnp.log(jnp.maximum(-u, 1.0))
    return jnp.log(deviation) + jnp.where(u > -5.0, near, far)


@jax.jit
def _acquisition(
    losses: _Fit, margins: _Fit, least: Array | float, max_margin: Array | float, point: Array
) -> tuple[Array, Array]:
    """Return -log(expected improvement x probability of a margin) and its gradient."""

    def objective(point: Array) -> Array:
        mean, deviation = _posterior(margins, point)
        log_safe = jax.scipy.stats.norm.logcdf((max_margin - mean) / deviation)
        return -_log_improvement(*_posterior(losses, point), least) - log_safe

    return jax.value_and_grad(objective)(point)


def _fit_losses(space: Space, history: Sequence[WalkResult]) -> tuple[_Fit, int, float]:
    """Fit the losses; returns the process, the walk of least posterior mean and that mean."""
    require_package("tinygp", "search", "tuning on walks beyond the model")
    finite = [i for i, row in enumerate(history) if np.isfinite(row.loss)]
    points = np.array([history[i].point for i in finite])
    fit = _fit(points, np.array([history[i].loss for i in finite]), space.curvature)
    means = np.asarray(_means(fit, fit.process.X))[: len(finite)]
    least = int(np.argmin(means))
    return fit, finite[least], float(means[least])


def _improve(
    space: Space, history: Sequence[WalkResult], radius: float, rng: np.random.Generator
) -> Proposal:
    """Propose the point of the largest expected improvement with a margin against falls."""
    losses, best, least = _fit_losses(space, history)
    points = np.array([row.point for row in history])
    margins = _fit(points, np.array([row.margin for row in history]), np.zeros(len(space.box)))
    max_margin = 0.5 * (1.0 + history[0].margin)  # half of the start's reserve may be used
    center = history[best].point
    objective = partial(_acquisition, losses, margins, least, max_margin)
    minima = []
    for start in range(_STARTS):
        offset = rng.standard_normal(len(center)) * 0.7 * radius / np.sqrt(len(center))
        first = center + (offset if start else 0.0)
        minima.append(_minimise_in(space, center, radius, objective, first))
    point = space.clip(min(minima, key=itemgetter(1))[0])
    mean, _ = _posterior(losses, jnp.asarray(point))
    return Proposal(point, "surrogate", float(mean))
