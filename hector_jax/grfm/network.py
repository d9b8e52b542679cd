"""GRFM-Net: phi as two small networks, one for forces and one for moments.

The paper's form: each net reads the current and the two past commands of both feet (18 numbers),
passes them through three layers (linear, layer normalisation, softsign; 64 wide) and returns what
the ground returns at both feet (6). Inputs and outputs are standardised by statistics of the
training samples, which are part of the parameters: a net cannot be used with another's. A linear
map of the same inputs stands beside it as the measure of what a net has to beat.

`as_effect` makes parameters a phi. It computes in the dtype of the window, so that a net trained in
32 bits has exact derivatives in a rollout of 64, and new parameters need no new compilation.
"""

from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from hector_jax.grfm.dataset import Dataset
from hector_jax.model.effect import HISTORY, Effect, Window
from hector_jax.robot import Robot
from hector_jax.storage import load_tree, read_card, save_tree
from hector_jax.trajectory import Wrench

VARIANTS = ("paper",)
HIDDEN = (64, 64, 64)  # the paper's layers
_FLOOR = 0.01  # least scale of an axis, relative to the largest of its kind


class Scaling(NamedTuple):
    """Mean and spread of each axis of each foot over the training samples."""

    mean: Wrench
    scale: Wrench


class NetParams(NamedTuple):
    """All of a GRFM-Net."""

    force: dict[str, Any]  # of a `Net`
    moment: dict[str, Any]
    inputs: Scaling  # commands; the same for each age
    outputs: Scaling  # effects


class LinearMap(NamedTuple):
    """The best affine map of a net's standardised inputs to its standardised outputs."""

    force: Float[Array, "n 6"]  # last row: bias
    moment: Float[Array, "n 6"]
    inputs: Scaling
    outputs: Scaling


class Net(nn.Module):
    """Layers of linear, layer normalisation and softsign, then a linear one."""

    hidden: tuple[int, ...] = HIDDEN
    outputs: int = 6

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
    key: Key[Array, ""], dataset: Dataset, hidden: tuple[int, ...] = HIDDEN
) -> NetParams:
    """Fresh networks with the statistics of a training set, in 32 bits."""
    key_force, key_moment = jax.random.split(key)
    x = jnp.zeros(6 * HISTORY, jnp.float32)
    net = Net(hidden)
    scalings = fit_scaling(dataset.window.commands), fit_scaling(dataset.label)
    params = NetParams(
        net.init(key_force, x)["params"], net.init(key_moment, x)["params"], *scalings
    )
    return jax.tree.map(lambda p: jnp.asarray(p, jnp.float32), params)


def apply_net(params: dict[str, Any], x: Float[Array, "*batch n"]) -> Float[Array, "*batch 6"]:
    """Standardised outputs of one net, whose widths are read off its parameters."""
    hidden = tuple(params[f"Dense_{i}"]["kernel"].shape[1] for i in range(len(params) // 2))
    return Net(hidden).apply({"params": params}, x)


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


def as_effect(params: NetParams, variant: str = "paper") -> jax.tree_util.Partial:
    """Phi of a GRFM-Net: `Window -> Effect`, with no spread.

    Raises:
        ValueError: no such variant.
    """
    if variant not in VARIANTS:
        raise ValueError(
            f"unknown variant {variant!r} of the net; there are: {', '.join(VARIANTS)}"
        )
    return jax.tree_util.Partial(_net_effect, params)


def _net_effect(params: NetParams, window: Window) -> Effect:
    dtype = window.commands.force.dtype
    params = jax.tree.map(lambda p: jnp.asarray(p, dtype), params)
    x = features(params.inputs, window.commands)
    flat = Wrench(apply_net(params.force, x.force), apply_net(params.moment, x.moment))
    return _effect(params.outputs, flat)


def _effect(scaling: Scaling, flat: Wrench) -> Effect:
    wrench = physical(scaling, jax.tree.map(lambda w: w.reshape(*w.shape[:-1], 2, 3), flat))
    return Effect(wrench, jax.tree.map(jnp.zeros_like, wrench))


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
    dtype = window.commands.force.dtype
    linear = jax.tree.map(lambda p: jnp.asarray(p, dtype), linear)
    x = features(linear.inputs, window.commands)
    flat = Wrench(
        x.force @ linear.force[:-1] + linear.force[-1],
        x.moment @ linear.moment[:-1] + linear.moment[-1],
    )
    return _effect(linear.outputs, flat)


def save_net(
    path: Path, params: NetParams, *, robot: Robot, about: dict[str, Any], variant: str = "paper"
) -> None:
    """Write a GRFM-Net for one robot; `about` goes on its card.

    Raises:
        OSError: where the file cannot be written.
    """
    widths = [params.force[f"Dense_{i}"]["kernel"].shape[1] for i in range(len(params.force) // 2)]
    facts = {"units": "N, N m", "frames": "yaw frame of the robot at the tick", "hidden": widths}
    save_tree(path, params, kind=f"grfm-{variant}", robot=robot, about={**facts, **about})


def load_net(path: Path, robot: Robot) -> tuple[NetParams, str, dict[str, Any]]:
    """Read a GRFM-Net: parameters, variant and card.

    Raises:
        ValueError: one line naming the file: damaged, of another robot, kind, layout or variant, or
            with a number that is not finite.
    """
    card = read_card(path)
    kinds = {f"grfm-{variant}": variant for variant in VARIANTS}
    if card["kind"] not in kinds:
        raise ValueError(f"{path}: holds {card['kind']}, expected one of: {', '.join(kinds)}")
    like = _like(tuple(card["about"]["hidden"]))
    params, card = load_tree(path, like, kind=card["kind"], robot=robot)
    if not all(np.isfinite(p).all() for p in jax.tree.leaves(params)):
        raise ValueError(f"{path}: a parameter of the net is not finite")
    return params, kinds[card["kind"]], card


def _like(hidden: tuple[int, ...]) -> NetParams:
    """Layout of the parameters; nothing is computed."""
    shapes = jax.eval_shape(Net(hidden).init, jax.random.key(0), jnp.zeros(6 * HISTORY))
    net = jax.tree.map(lambda leaf: np.zeros(leaf.shape), shapes["params"])
    wrench = Wrench(np.zeros((2, 3)), np.zeros((2, 3)))
    return NetParams(net, net, Scaling(wrench, wrench), Scaling(wrench, wrench))
