"""The default GRFM-Net: the gated linear part, and nets that learn its residual.

Nets of two layers, 32 wide, add to the ground wrench of each foot the residual of the linear part.
They have the inputs of the linear part, in each foot's view; their output is bounded, and fades
where the inputs are unlike those of the training samples: far from the data this phi is linear.
Four of each kind are trained side by side and their mean is added. The statistics of the training
samples are part of the parameters: a net cannot be used with another net's.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Key

from hector_jax.control.gait import GaitConfig, since_switch
from hector_jax.core.arrays import Array
from hector_jax.grfm import gated, nets
from hector_jax.grfm.dataset import Dataset
from hector_jax.grfm.effect import Effect, Phi, Window, in_dtype_of
from hector_jax.grfm.gated import GATES, MOTION, GatedMap, View, hats, num_changes, views
from hector_jax.grfm.nets import FitConfig, History, Progress, Samples

HIDDEN = (32, 32)
MEMBERS = 4  # nets of each kind
BOUND = 0.5  # most that a net adds, in units of the residual's RMS
FAMILIAR = 0.99  # share of the training samples whose trust is above one half


class FeatureStats(NamedTuple):
    """Statistics of a net's features, by the tick since the switch; kinds are those of a `View`."""

    mean: Float[Array, "kinds ticks terms"]
    scale: Float[Array, "kinds ticks terms"]
    reach: Float[Array, ""]  # mean square of the standardised terms at which trust is one half


class ResidualParams(NamedTuple):
    """Parameters of a GRFM-Net of the residual variant."""

    linear: GatedMap
    force: dict[str, Any]  # of MEMBERS `Net`s, stacked, for one foot
    moment: dict[str, Any]  # the same; empty for feet without moments
    stats: FeatureStats
    residual_rms: Float[Array, " axes"]  # [N], [N m] of the linear part's residual


def init(
    key: Key[Array, ""], feet: int = 2, axes: int = 6, hidden: tuple[int, ...] = HIDDEN
) -> ResidualParams:
    """Draw networks without statistics, in 32 bits; the axis of ticks has length 0."""
    terms = num_changes(feet, axes) + MOTION
    inputs = terms + len(GATES) + feet - 1
    force, moment = nets.init_nets(key, hidden, inputs, outputs=3, members=MEMBERS, axes=axes)
    table = jnp.zeros((feet, 0, terms))
    stats = FeatureStats(table, table, jnp.zeros(()))
    params = ResidualParams(gated.init(key, feet, axes), force, moment, stats, jnp.zeros(axes))
    return jax.tree.map(lambda p: jnp.asarray(p, jnp.float32), params)


def with_statistics(params: ResidualParams, dataset: Dataset) -> ResidualParams:
    """Return the same networks with the linear part and the statistics of a training set."""
    linear = gated.fit_gated(dataset)
    fitted = linear, *_fit_stats(linear, dataset)
    linear, stats, rms = jax.tree.map(lambda p: jnp.asarray(p, jnp.float32), fitted)
    return params._replace(linear=linear, stats=stats, residual_rms=rms)


def _fit_stats(linear: GatedMap, dataset: Dataset) -> tuple[FeatureStats, np.ndarray]:
    """Return statistics of the features, and the RMS of the linear part's residual."""

    def evaluate(window: Window) -> tuple[View, Array, Array]:
        view = views(window, linear.axes)
        ground, *_ = gated.apply_gated(linear, window, view)
        return view, hats(window.since_switch, linear.ticks), ground

    view, tick, ground = jax.tree.map(np.asarray, jax.jit(jax.vmap(evaluate))(dataset.window))
    feet = view.stands.shape[1]
    terms, tick = _terms(view), np.repeat(tick[:, None], feet, axis=1)
    mean, scale = (np.zeros((feet, len(linear.ticks), terms.shape[-1])) for _ in range(2))
    for kind in range(feet):  # there are as many kinds as feet: two of each pair
        rows = view.kind == kind
        weight = tick[rows] / np.maximum(tick[rows].sum(axis=0), 1e-9)
        mean[kind] = weight.T @ terms[rows]
        scale[kind] = np.sqrt(np.maximum(weight.T @ terms[rows] ** 2 - mean[kind] ** 2, 0.0))
    # some terms are constant at some ticks only, such as the change of a swinging foot's command
    scale = np.maximum(scale, 0.05 * np.maximum(scale.max(axis=(0, 1)), 1e-6))
    stats = FeatureStats(mean, scale, np.asarray(1.0))
    z = np.asarray(_standard_terms(stats, terms, view.kind, tick))
    reach = np.quantile(np.mean(z**2, axis=-1), FAMILIAR)
    rms = np.sqrt(np.mean((gated.labels_in_view(dataset) - ground) ** 2, axis=(0, 1)))
    return stats._replace(reach=np.maximum(reach, 1e-6)), np.where(rms > 0.0, rms, 1.0)


def _terms(view: View) -> Float[Array, "*batch terms"]:
    return jnp.concatenate([view.changes, view.motion], axis=-1)


def _standard_terms(stats: FeatureStats, terms: Any, kind: Any, tick: Any) -> Array:
    lookup = lambda table: jnp.einsum("...k,...ki->...i", tick, table[kind])  # noqa: E731
    return (terms - lookup(stats.mean)) / lookup(stats.scale)


def _inputs(params: ResidualParams, window: Window, view: View) -> tuple[Array, Array]:
    """Return the nets' inputs for one window (feet, n), and the trust in their outputs (feet,)."""
    stats, feet = params.stats, len(view.stands)
    tick, gate = (hats(window.since_switch, k) for k in (params.linear.ticks, params.linear.gates))
    z = _standard_terms(stats, _terms(view), view.kind, jnp.stack([tick] * feet))
    trust = 1.0 / (1.0 + (jnp.mean(z**2, axis=-1) / stats.reach) ** 4)
    kind = view.kind[:, None] == jnp.arange(1, feet)
    return jnp.concatenate([z, jnp.stack([gate] * feet), kind], axis=-1), trust


def _bounded(raw: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return a net's raw output limited smoothly to +-BOUND, both standardised."""
    return BOUND * jnp.tanh(raw / BOUND)


def _output(raw: Array, trust: Array) -> Array:
    return trust * _bounded(raw)


def _samples(params: ResidualParams, dataset: Dataset) -> Samples:
    def evaluate(window: Window) -> tuple[Array, Array, Array]:
        view = views(window, params.linear.axes)
        ground, *_ = gated.apply_gated(params.linear, window, view)
        return ground, *_inputs(params, window, view)

    ground, z, trust = jax.jit(jax.vmap(evaluate))(dataset.window)
    residual = (gated.labels_in_view(dataset) - ground) / params.residual_rms
    y = tuple(np.split(residual, residual.shape[-1] // 3, axis=-1))
    samples = Samples((z,) * len(y), y, trust[..., None])
    return jax.tree.map(lambda w: jnp.asarray(w, jnp.float32), samples)


def fit(
    config: FitConfig, training: Dataset, validation: Dataset, progress: Progress
) -> tuple[ResidualParams, History]:
    """Fit the linear part, then train the nets on its residual; see `nets.fit_nets`."""
    key_init, key_shuffle = jax.random.split(jax.random.key(config.seed))
    params = with_statistics(init(key_init, training.feet, training.axes), training)
    best, history = nets.fit_nets(
        config,
        key_shuffle,
        nets.by_kind(params),
        training=_samples(params, training),
        validation=_samples(params, validation),
        scale=tuple(params.residual_rms.reshape(-1, 3)),
        output=_output,
        progress=progress,
    )
    return nets.with_nets(params, best), history


def apply(params: ResidualParams, window: Window) -> Effect:
    """Return the effect of a trained net for one window."""
    params, window = in_dtype_of(window, params), in_dtype_of(window, window)
    view = views(window, params.linear.axes)
    ground, legs, shift = gated.apply_gated(params.linear, window, view)
    x, trust = _inputs(params, window, view)
    members = jax.vmap(lambda net: _bounded(nets.apply_net(net, x)))
    added = jnp.concatenate([*map(members, nets.by_kind(params))], axis=-1)
    added = trust[:, None] * params.residual_rms * added
    return Effect(gated.from_views(ground + added.mean(axis=0)), legs, shift)


RESIDUAL = Phi(
    "residual", ResidualParams, init, fit, apply, lambda p: nets.widths(p.force), nets.member
)


@cache  # every rollout on the plain rigid body asks for it
def plain_net(gait: GaitConfig, axes: int) -> ResidualParams:
    """Return a net that returns every command unchanged: the rigid body, in the net's program.

    Its parameters have the shapes of a net that was trained on walks of `gait` with feet whose
    wrench has 3 or 6 `axes`.
    """
    ticks = np.unique(np.asarray(since_switch(gait, jnp.arange(gait.cycle))))
    draw = partial(init, feet=len(gait.offsets), axes=axes)

    def zeros(x: Any) -> np.ndarray:
        return np.zeros([len(ticks) if n == 0 else n for n in x.shape], np.float32)

    net = jax.tree.map(zeros, jax.eval_shape(draw, jax.random.key(0)))
    linear = net.linear._replace(ticks=np.float32(ticks), gates=np.array(GATES, np.float32))
    stats = net.stats._replace(scale=net.stats.scale + 1, reach=np.ones((), np.float32))
    return net._replace(linear=linear, stats=stats)
