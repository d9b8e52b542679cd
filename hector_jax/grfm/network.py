"""GRFM-Net: phi as two small networks, one for forces and one for moments; two variants.

**paper**, the paper's form: each net reads the current and the two past commands of both feet (18
numbers), passes them through three layers (linear, layer normalisation, softsign; 64 wide) and
returns what the ground returns at both feet (6).

**residual**: the gated linear part (gated.py) and on top of it nets of two layers, 32 wide, which
add to the ground wrench of each foot what the linear part leaves. They read what it reads, as each
foot sees it, and what they add is bounded, and fades where the inputs are unlike those of the
training samples: far from the data this phi is linear. Four of each kind are trained side by side;
their mean is added and their spread told.

Inputs and outputs are standardised by statistics of the training samples, which are part of the
parameters: a net cannot be used with another's. An affine map of the paper's inputs stands beside
them as the measure of what a net has to beat.

`as_effect` makes parameters a phi. It computes in the dtype of the window, so that a net trained in
32 bits has exact derivatives in a rollout of 64, and new parameters need no new compilation.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from hector_jax.control.gait import GaitConfig, since_switch
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import Range, validation_error
from hector_jax.core.trajectory import Wrench
from hector_jax.core.tree_file import load_tree, read_card, save_tree
from hector_jax.grfm.dataset import Dataset
from hector_jax.grfm.effect import HISTORY, Effect, Window, sure
from hector_jax.grfm.gated import (
    CHANGES,
    GATES,
    MOTION,
    GatedMap,
    View,
    apply_gated,
    fit_gated,
    from_views,
    hats,
    in_dtype_of,
    seen_labels,
    views,
)
from hector_jax.robot.model import Robot

HIDDEN = {"paper": (64, 64, 64), "residual": (32, 32)}  # widths of the layers, by variant
MEMBERS = {"paper": 1, "residual": 4}  # nets of each kind that are trained side by side
VARIANTS = tuple(HIDDEN)
_DEEPEST, _WIDEST = 8, 4096  # hidden layers and their units in a file
BOUND = 0.5  # most that a residual net adds, in units of what the linear part leaves
FAMILIAR = 0.99  # share of the training samples that are nearer than where trust is halved
_FLOOR = 0.01  # least scale of an axis, relative to the largest of its kind


class Scaling(NamedTuple):
    """Mean and spread of each axis of each foot over the training samples."""

    mean: Wrench
    scale: Wrench


class NetParams(NamedTuple):
    """All of a GRFM-Net of the paper's variant."""

    force: dict[str, Any]  # of a `Net`
    moment: dict[str, Any]
    inputs: Scaling  # commands; the same for each age
    outputs: Scaling  # effects


class Usual(NamedTuple):
    """What a residual net reads, by what is usual at a tick; axes of 2: swing, stance."""

    mean: Float[Array, "2 ticks terms"]
    scale: Float[Array, "2 ticks terms"]
    reach: Float[Array, ""]  # mean square of the standardised terms at which trust is one half


class ResidualParams(NamedTuple):
    """All of a GRFM-Net of the residual variant."""

    linear: GatedMap
    force: dict[str, Any]  # of MEMBERS `Net`s, stacked, for one foot
    moment: dict[str, Any]
    usual: Usual
    left: Float[Array, "6"]  # RMS of what the linear part leaves


Params = NetParams | ResidualParams


class LinearMap(NamedTuple):
    """The best affine map of a net's standardised inputs to its standardised outputs."""

    force: Float[Array, "n 6"]  # last row: bias
    moment: Float[Array, "n 6"]
    inputs: Scaling
    outputs: Scaling


LINEAR = jax.tree.structure(LinearMap(0, 0, *[Scaling(Wrench(0, 0), Wrench(0, 0))] * 2))  # pyright: ignore


class Net(nn.Module):
    """Layers of linear, layer normalisation and softsign, then a linear one."""

    hidden: tuple[int, ...]
    outputs: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"]) -> Float[Array, "*batch m"]:
        """Outputs for inputs, both standardised."""
        for width in self.hidden:
            # the two-pass variance: the fast one loses half the digits that gradient checks need
            x = nn.soft_sign(nn.LayerNorm(use_fast_variance=False)(nn.Dense(width)(x)))
        return nn.Dense(self.outputs)(x)


def fit_scaling(wrench: Wrench) -> Scaling:
    """Mean and standard deviation over all leading axes.

    An axis that hardly moves, such as the commanded M_x, is scaled by a hundredth of the largest
    spread of its kind, so that rounding errors are not taken for a signal.
    """

    def scale(w: np.ndarray) -> np.ndarray:
        spread = w.reshape(-1, 2, 3).std(axis=0)
        largest = spread.max()
        return np.maximum(spread, _FLOOR * largest) if largest > 0.0 else np.ones_like(spread)

    return Scaling(
        mean=Wrench(*(np.mean(w.reshape(-1, 2, 3), axis=0) for w in wrench)),
        scale=Wrench(*(scale(w) for w in wrench)),
    )


def init_params(
    key: Key[Array, ""],
    dataset: Dataset,
    variant: str = "residual",
    hidden: tuple[int, ...] | None = None,
) -> Params:
    """Fresh networks with the statistics of a training set, in 32 bits.

    Args:
        key: of the initial kernels.
        dataset: training samples; the residual variant fits its linear part to them.
        variant: see the top of this file.
        hidden: widths of the layers; None takes the variant's own.

    Raises:
        InputError: no such variant.
    """
    if variant not in VARIANTS:
        raise InputError(f"unknown variant {variant!r} of the net; known: {', '.join(VARIANTS)}")
    inputs, outputs = _sizes(variant)
    net, x = Net(hidden or HIDDEN[variant], outputs), jnp.zeros(inputs)
    draw = jax.jit(jax.vmap(lambda k: net.init(k, x)["params"]))
    force, moment = (draw(jax.random.split(k, MEMBERS[variant])) for k in jax.random.split(key))
    if variant == "paper":
        first = partial(jax.tree.map, lambda p: p[0])
        scalings = fit_scaling(dataset.window.commands), fit_scaling(dataset.label)
        params = NetParams(first(force), first(moment), *scalings)
    else:
        linear = fit_gated(dataset)
        params = ResidualParams(linear, force, moment, *_fit_usual(linear, dataset))
    return jax.tree.map(lambda p: jnp.asarray(p, jnp.float32), params)


def _sizes(variant: str) -> tuple[int, int]:
    """Inputs and outputs of each net."""
    return (6 * HISTORY, 6) if variant == "paper" else (CHANGES + MOTION + len(GATES) + 1, 3)


def widths(net: dict[str, Any]) -> tuple[int, ...]:
    """Widths of the hidden layers of a net, read off its parameters."""
    return tuple(net[f"Dense_{i}"]["kernel"].shape[-1] for i in range(len(net) // 2))


def apply_net(params: dict[str, Any], x: Float[Array, "*batch n"]) -> Float[Array, "*batch m"]:
    """Standardised outputs of one net."""
    hidden = widths(params)
    outputs = params[f"Dense_{len(hidden)}"]["kernel"].shape[-1]
    return Net(hidden, outputs).apply({"params": params}, x)


def bounded(y: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """What a residual net adds for its raw output, both standardised."""
    return BOUND * jnp.tanh(y / BOUND)


def standardised(scaling: Scaling, wrench: Wrench) -> Wrench:
    """Wrenches in units of their spread, about their mean."""
    return jax.tree.map(lambda w, m, s: (w - m) / s, wrench, scaling.mean, scaling.scale)


def physical(scaling: Scaling, wrench: Wrench) -> Wrench:
    """The inverse of `standardised`."""
    return jax.tree.map(lambda w, m, s: w * s + m, wrench, scaling.mean, scaling.scale)


def features(scaling: Scaling, commands: Wrench) -> Wrench:
    """Inputs of force net and moment net, (*batch, 18) each, from the commands of windows."""
    flat = lambda w: w.reshape(*w.shape[:-3], 6 * HISTORY)  # noqa: E731
    return jax.tree.map(flat, standardised(scaling, commands))


def _fit_usual(linear: GatedMap, dataset: Dataset) -> tuple[Usual, np.ndarray]:
    """What is usual at each tick, and the RMS of what the linear part leaves."""

    def look(window: Window) -> tuple[View, Array, Array]:
        seen = views(window)
        return seen, hats(window.since_switch, linear.ticks), apply_gated(linear, window, seen)[0]

    window = jax.tree.map(jnp.asarray, dataset.window)
    seen, tick, ground = jax.tree.map(np.asarray, jax.jit(jax.vmap(look))(window))
    terms, tick = _terms(seen), np.repeat(tick[:, None], 2, axis=1)
    mean, scale = (np.zeros((2, len(linear.ticks), terms.shape[-1])) for _ in range(2))
    for stands in (0, 1):
        rows = seen.stands == stands
        weight = tick[rows] / np.maximum(tick[rows].sum(axis=0), 1e-9)
        mean[stands] = weight.T @ terms[rows]
        scale[stands] = np.sqrt(np.maximum(weight.T @ terms[rows] ** 2 - mean[stands] ** 2, 0.0))
    # a term that rests at some ticks only, such as the change of a swinging foot's command
    scale = np.maximum(scale, 0.05 * np.maximum(scale.max(axis=(0, 1)), 1e-6))
    usual = Usual(mean, scale, np.asarray(1.0))
    z = np.asarray(_standard_terms(usual, terms, seen.stands.astype(int), tick))
    reach = np.quantile(np.mean(z**2, axis=-1), FAMILIAR)
    left = np.sqrt(np.mean((seen_labels(dataset)[0] - ground) ** 2, axis=(0, 1)))
    return usual._replace(reach=np.maximum(reach, 1e-6)), np.where(left > 0.0, left, 1.0)


def _terms(seen: View) -> Float[Array, "*batch terms"]:
    return jnp.concatenate([seen.changes, seen.motion], axis=-1)


def _standard_terms(usual: Usual, terms: Any, stands: Any, tick: Any) -> Array:
    at = lambda table: jnp.einsum("...k,...ki->...i", tick, table[stands])  # noqa: E731
    return (terms - at(usual.mean)) / at(usual.scale)


def residual_inputs(params: ResidualParams, window: Window, seen: View) -> tuple[Array, Array]:
    """What the nets read for each foot of one window (2, n), and how far they are trusted (2,)."""
    stands, usual = seen.stands.astype(int), params.usual
    tick, gate = (hats(window.since_switch, k) for k in (params.linear.ticks, params.linear.gates))
    z = _standard_terms(usual, _terms(seen), stands, jnp.stack([tick, tick]))
    trust = 1.0 / (1.0 + (jnp.mean(z**2, axis=-1) / usual.reach) ** 4)
    return jnp.concatenate([z, jnp.stack([gate, gate]), seen.stands[:, None]], axis=-1), trust


def as_effect(params: Params) -> jax.tree_util.Partial:
    """Phi of a GRFM-Net of either variant: `Window -> Effect`; the paper's has no spread."""
    paper = isinstance(params, NetParams)
    return jax.tree_util.Partial(_net_effect if paper else _residual_effect, params)


def plain_net(gait: GaitConfig) -> ResidualParams:
    """A net that returns every command as it is: the plain rigid body, in the program of the net.

    Its parameters have the shapes of a net that was trained on walks of `gait`.
    """
    ticks = np.unique(np.asarray(since_switch(gait, jnp.arange(gait.cycle))))
    zeros = lambda x: np.zeros([len(ticks) if n == 0 else n for n in x.shape], np.float32)  # noqa: E731
    net = jax.tree.map(zeros, layout("residual", HIDDEN["residual"]))
    knots = net.linear._replace(ticks=np.float32(ticks), gates=np.array(GATES, np.float32))
    one = np.ones((), np.float32)
    return net._replace(linear=knots, usual=Usual(net.usual.mean, net.usual.scale + one, one))


def effect_of(params: Params | None, gait: GaitConfig) -> jax.tree_util.Partial:
    """Phi of a net, or of the plain rigid body (None), which needs no program of its own."""
    return as_effect(plain_net(gait) if params is None else params)


def member_effects(params: ResidualParams) -> jax.tree_util.Partial:
    """Phi of each member of the residual nets' ensembles alone, stacked on a first axis."""
    count = MEMBERS["residual"]
    alone = lambda p: jnp.asarray(p)[:, None]  # noqa: E731  each an ensemble of one
    shared = lambda p: jnp.broadcast_to(jnp.asarray(p), (count, *jnp.shape(p)))  # noqa: E731
    nets = {name: jax.tree.map(alone, getattr(params, name)) for name in ("force", "moment")}
    return as_effect(jax.tree.map(shared, params)._replace(**nets))


def _residual_effect(params: ResidualParams, window: Window) -> Effect:
    params, window = in_dtype_of(window, params), in_dtype_of(window, window)
    seen = views(window)
    ground, legs = apply_gated(params.linear, window, seen)
    x, trust = residual_inputs(params, window, seen)
    members = jax.vmap(lambda net: bounded(apply_net(net, x)))
    added = jnp.concatenate([members(params.force), members(params.moment)], axis=-1)
    added = trust[:, None] * params.left * added
    spread = jnp.sqrt(jnp.mean((added - added.mean(axis=0)) ** 2, axis=0) + 1e-12)
    return Effect(
        wrench=from_views(ground + added.mean(axis=0)),
        spread=jax.tree.map(jnp.abs, from_views(spread)),
        legs=legs,
    )


def _net_effect(params: NetParams, window: Window) -> Effect:
    params = in_dtype_of(window, params)
    x = features(params.inputs, window.commands)
    flat = Wrench(apply_net(params.force, x.force), apply_net(params.moment, x.moment))
    return _effect(params.outputs, flat)


def _effect(scaling: Scaling, flat: Wrench) -> Effect:
    wrench = physical(scaling, jax.tree.map(lambda w: w.reshape(*w.shape[:-1], 2, 3), flat))
    return sure(wrench)


def fit_linear(dataset: Dataset) -> LinearMap:
    """Least squares from the nets' inputs to the label."""
    inputs, outputs = fit_scaling(dataset.window.commands), fit_scaling(dataset.label)
    x = features(inputs, dataset.window.commands)
    y = standardised(outputs, dataset.label)

    def fit(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        with_bias = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        return np.linalg.lstsq(with_bias, y.reshape(len(y), 6), rcond=1e-6)[0]

    return LinearMap(fit(x.force, y.force), fit(x.moment, y.moment), inputs, outputs)


def linear_effect(linear: LinearMap) -> jax.tree_util.Partial:
    """Phi of a linear map: `Window -> Effect`, with no spread."""
    return jax.tree_util.Partial(_linear_effect, linear)


def _linear_effect(linear: LinearMap, window: Window) -> Effect:
    linear = in_dtype_of(window, linear)
    x = features(linear.inputs, window.commands)
    flat = Wrench(
        x.force @ linear.force[:-1] + linear.force[-1],
        x.moment @ linear.moment[:-1] + linear.moment[-1],
    )
    return _effect(linear.outputs, flat)


def save_net(path: Path, params: Params, *, robot: Robot, about: dict[str, Any]) -> None:
    """Write a GRFM-Net for one robot; `about` goes on its card.

    Raises:
        WriteError: where the file cannot be written.
    """
    variant = "paper" if isinstance(params, NetParams) else "residual"
    facts = {
        "units": "N, N m",
        "frames": "yaw frame of the robot at the tick",
        "hidden": list(widths(params.force)),
    }
    save_tree(path, params, kind=f"grfm-{variant}", robot=robot, about={**facts, **about})


def read_net_card(path: Path, variant: str | None = None) -> tuple[str, dict[str, Any]]:
    """Variant and card of the GRFM-Net in a file; see `load_net`.

    Raises:
        InputError: one line naming the file: damaged, no net, or a net of another variant.
    """
    card = read_card(path)
    kinds = {f"grfm-{name}": name for name in ([variant] if variant else VARIANTS)}
    if card["kind"] not in kinds:
        held = short_repr(card["kind"])[1:-1]
        raise InputError(f"{path}: holds {held}, expected {' or '.join(kinds)}")
    hidden = card["about"].get("hidden")
    sizes = hidden if isinstance(hidden, list) and 1 <= len(hidden) <= _DEEPEST else [None]
    if any(validation_error(size, int, Range(1, _WIDEST)) for size in sizes):
        raise InputError(
            f"{path}: about.hidden must be 1 to {_DEEPEST} whole numbers from 1 to {_WIDEST}, "
            f"got {short_repr(hidden)}"
        )
    return kinds[card["kind"]], card


def load_net(
    path: Path, robot: Robot, variant: str | None = None
) -> tuple[Params, str, dict[str, Any]]:
    """Read a GRFM-Net: parameters, variant and card.

    Args:
        path: the file.
        robot: the body in use.
        variant: the one that is expected; None takes any.

    Raises:
        InputError: one line naming the file: damaged, of another robot, kind, layout or variant, or
            with a number that is not finite.
    """
    found, card = read_net_card(path, variant)
    like = layout(found, tuple(card["about"]["hidden"]))
    params, card = load_tree(path, like, kind=card["kind"], robot=robot)
    if not all(np.isfinite(p).all() for p in jax.tree.leaves(params)):
        raise InputError(f"{path}: a parameter of the net is not finite")
    return params, found, card


def layout(variant: str, hidden: tuple[int, ...]) -> Params:
    """Zeros of the shapes of the parameters, as `load_tree` wants them; an axis 0 is of ticks."""
    inputs, outputs = _sizes(variant)
    shapes = jax.eval_shape(Net(hidden, outputs).init, jax.random.key(0), jnp.zeros(inputs))
    stack = (MEMBERS[variant],) if variant == "residual" else ()
    net = jax.tree.map(lambda leaf: np.zeros((*stack, *leaf.shape)), shapes["params"])
    if variant == "paper":
        wrench = Wrench(np.zeros((2, 3)), np.zeros((2, 3)))
        return NetParams(net, net, Scaling(wrench, wrench), Scaling(wrench, wrench))
    terms, gates = CHANGES + MOTION, len(GATES)
    linear = GatedMap(
        ticks=np.zeros(0),
        gates=np.zeros(gates),
        bias=np.zeros((2, 0, 6)),
        changes=np.zeros((2, CHANGES, 6)),
        legs_bias=np.zeros((0, 6)),
        legs=np.zeros((gates, terms, 6)),
    )
    usual = Usual(np.zeros((2, 0, terms)), np.zeros((2, 0, terms)), np.zeros(()))
    return ResidualParams(linear, net, net, usual, np.zeros(6))
