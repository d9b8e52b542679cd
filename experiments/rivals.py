"""Rivals of the tuner on walks: optimizers of a weight set that see one number of each walk.

A rival is a function of a `Task`. It walks points until the budget is spent (`Spent`) or it has
converged, with the settings of its library or its tutorial, but for the first points of TuRBO,
which are drawn about the start. The coordinates are steps of the log-weights from the start.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.inputs import require_package

_FIRST_DRAWS = 10  # walks before the first Gaussian process
_STEP = math.log(1.05)  # of finite differences
_SOURCES = 300  # walks of the model that the prior mean of a Gaussian process is fitted to


class Spent(Exception):  # noqa: N818, the end of a budget is no error
    """The budget of walks is spent."""


class Task(NamedTuple):
    """What a rival is given. The start is the origin, with log-loss zero: it has walked."""

    walk: Callable[[Float[np.ndarray, " n"]], float]  # log-loss of a point; raises Spent
    model: Callable[[Float[np.ndarray, " n"]], float]  # its log-loss on the model, which is free
    box: Float[np.ndarray, "n 2"]  # of the points
    spread: float  # first standard deviation
    seed: int

    def draw(self, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Draw a point about the start."""
        return np.clip(self.spread * rng.standard_normal(len(self.box)), *self.box.T)


def search(rival: Callable[[Task], None], task: Task, budget: int) -> tuple[np.ndarray, np.ndarray]:
    """Run a rival on a budget of walks, the start's included; return its points and log-losses."""
    points, losses = [np.zeros(len(task.box))], [0.0]

    def walk(point: Float[np.ndarray, " n"]) -> float:
        if len(points) == budget:
            raise Spent
        loss = task.walk(point)
        points.append(point)
        losses.append(loss if np.isfinite(loss) else max(losses) + 1.0)  # a fall is the worst yet
        return losses[-1]

    with suppress(Spent):
        rival(task._replace(walk=walk))
    return np.array(points), np.array(losses)


def random(task: Task) -> None:
    """Draw points about the start."""
    rng = np.random.default_rng(task.seed)
    while True:
        task.walk(task.draw(rng))


def cma_es(task: Task) -> None:
    """Run CMA-ES with the population of its library."""
    require_package("cmaes", "race", "the race")
    from cmaes import CMA

    evolution = CMA(np.zeros(len(task.box)), task.spread, bounds=task.box, seed=task.seed)
    while not evolution.should_stop():
        points = [evolution.ask() for _ in range(evolution.population_size)]
        evolution.tell([(point, task.walk(point)) for point in points])


def lq_cma_es(task: Task) -> None:
    """Run CMA-ES with a linear-quadratic surrogate.

    Source: Hansen, "A global surrogate assisted CMA-ES", GECCO 2019.
    """
    require_package("cma", "race", "the race")
    cma = import_module("cma")
    # seed 0 would be the time
    options = {"bounds": [*task.box.T], "seed": task.seed + 1, "verbose": -9}
    cma.fmin_lq_surr2(task.walk, np.zeros(len(task.box)), task.spread, options)


def differences(task: Task) -> None:
    """Descend along forward differences; a step that raises the loss is halved."""
    rate, loss, at = 4.0 * task.spread, 0.0, np.zeros(len(task.box))
    while rate > 1e-3:
        offsets = np.where(at + _STEP > task.box[:, 1], -_STEP, _STEP)
        slopes = [(task.walk(point) - loss) / _STEP for point in at + np.diag(offsets)]
        gradient = np.sign(offsets) * slopes
        while rate > 1e-3:
            trial = np.clip(at - rate * gradient / np.linalg.norm(gradient), *task.box.T)
            if (value := task.walk(trial)) < loss:
                at, loss, rate = trial, value, 2.0 * rate
                break
            rate /= 2.0


def turbo(task: Task, *, with_model: bool = False) -> None:
    """Run Bayesian optimisation in a trust region, as BoTorch's tutorial of TuRBO does.

    Args:
        task: see `Task`.
        with_model: the prior mean is a Gaussian process fitted to a search on the model.

    Source: Eriksson et al., "Scalable global optimization via local Bayesian optimization",
    NeurIPS 2019.
    """
    require_package("botorch", "race", "the race")
    torch = import_module("torch")
    torch.set_num_threads(1)
    torch.manual_seed(task.seed)
    (low, high), rng = task.box.T, np.random.default_rng(task.seed)
    size, batch = len(task.box), 4
    to_cube = lambda points: torch.tensor((np.asarray(points) - low) / (high - low))  # noqa: E731
    prior_mean = lambda points: torch.zeros(len(points), dtype=torch.double)  # noqa: E731
    if with_model:
        seen, values = search(cma_es, task._replace(walk=task.model), _SOURCES)
        prior = _fitted(to_cube(seen), torch.tensor(-values))
        prior_mean = lambda points: _mean(prior, points)  # noqa: E731
    points = [np.zeros(size), *(task.draw(rng) for _ in range(_FIRST_DRAWS - 1))]
    losses = [0.0, *map(task.walk, points[1:])]
    length, successes, failures = 0.8, 0, 0
    while length > 0.5**7:
        x, y = to_cube(points), -torch.tensor(losses)
        process = _fitted(x, y - prior_mean(x), **_parts(size))
        draws = _candidates(process, x[y.argmax()], length, rng)
        samples = process.posterior(draws).rsample(torch.Size([batch])).detach().squeeze(-1)
        for index in (samples + prior_mean(draws)).argmax(dim=-1):
            points.append(low + (high - low) * draws[index].numpy())
            losses.append(task.walk(points[-1]))
        least = min(losses[:-batch])
        won = min(losses[-batch:]) < least - 1e-3 * abs(least)
        successes, failures = (successes + 1, 0) if won else (0, failures + 1)
        if successes == 10:
            length, successes = min(2.0 * length, 1.6), 0
        elif failures == math.ceil(max(4, size) / batch):
            length, failures = length / 2.0, 0


def _candidates(process: Any, center: Any, length: float, rng: np.random.Generator) -> Any:
    """Draw 200 candidates for each dimension in the trust region, in the cube."""
    torch = import_module("torch")
    lengths = process.covar_module.base_kernel.lengthscale.detach().squeeze()
    sides = length * lengths / lengths.log().mean().exp()
    low, high = (center - sides / 2).clamp(0, 1), (center + sides / 2).clamp(0, 1)
    sobol = torch.quasirandom.SobolEngine(len(center), scramble=True, seed=int(rng.integers(2**31)))
    return low + (high - low) * sobol.draw(200 * len(center), dtype=torch.double)


def _mean(process: Any, points: Any) -> Any:
    return process.posterior(points).mean.detach().squeeze(-1)


def _parts(size: int) -> dict[str, Any]:
    """Return likelihood and kernel of the tutorial."""
    kernels = import_module("gpytorch.kernels")
    within = import_module("gpytorch.constraints").Interval
    likelihood = import_module("gpytorch.likelihoods").GaussianLikelihood
    lengths = {"ard_num_dims": size, "lengthscale_constraint": within(0.005, 4.0)}
    return {
        "likelihood": likelihood(noise_constraint=within(1e-8, 1e-3)),
        "covar_module": kernels.ScaleKernel(kernels.MaternKernel(nu=2.5, **lengths)),
    }


def _fitted(points: Any, values: Any, **parts: Any) -> Any:
    """Fit a Gaussian process, by default with the kernel of BoTorch."""
    process = import_module("botorch.models").SingleTaskGP(points, values[:, None], **parts)
    likelihood = import_module("gpytorch.mlls").ExactMarginalLogLikelihood
    import_module("botorch.fit").fit_gpytorch_mll(likelihood(process.likelihood, process))
    return process


RIVALS: dict[str, Callable[[Task], None]] = {
    "cma-es": cma_es,
    "lq-cma-es": lq_cma_es,
    "turbo": turbo,
    "turbo on model": partial(turbo, with_model=True),
    "differences": differences,
    "random": random,
}
