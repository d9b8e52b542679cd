"""GRFM-Net: phi with parameters that are learned from walks. The variants, and their files.

`as_effect` makes a phi of parameters. It computes in the dtype of the window, so that a net trained
in 32 bits has exact derivatives in a rollout of 64, and new parameters need no new compilation.
"""

from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hector_jax.control.controller import WalkConfig, walk_config
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import load_tree, read_card, save_tree
from hector_jax.grfm.effect import Phi
from hector_jax.grfm.gated import GATED
from hector_jax.grfm.paper import LINEAR, PAPER
from hector_jax.grfm.residual import RESIDUAL, plain_net
from hector_jax.robot.model import Robot

VARIANTS = {phi.name: phi for phi in (RESIDUAL, PAPER, GATED, LINEAR)}
"""Every variant by its name. A new one is added here and to the choices in cli/flags.py."""

Params = Any  # of a variant: `Phi.params`


def variant_of(params: Params) -> Phi:
    """Return the variant that parameters belong to."""
    return next(phi for phi in VARIANTS.values() if phi.params is type(params))


def as_effect(params: Params) -> jax.tree_util.Partial:
    """Return the phi of fitted parameters: `Window -> Effect`."""
    return jax.tree_util.Partial(variant_of(params).apply, params)


def effect_of(params: Params | None, config: WalkConfig) -> jax.tree_util.Partial:
    """Return the phi of a net, or of the plain rigid body (None), in one and the same program."""
    axes = config.mpc.contact.axes
    return as_effect(plain_net(config.gait, axes) if params is None else params)


def save_net(path: Path, params: Params, *, robot: Robot, about: dict[str, Any]) -> None:
    """Write a GRFM-Net for one robot; `about` goes on its card.

    Raises:
        WriteError: the file cannot be written.
    """
    phi = variant_of(params)
    facts = {
        "units": "N, N m, m",
        "frames": "yaw frame of the robot at the tick",
        "hidden": list(phi.widths(params)),
    }
    save_tree(path, params, kind=f"grfm-{phi.name}", robot=robot, about={**facts, **about})


def load_net(
    path: Path, robot: Robot, variant: str | None = None
) -> tuple[Params, str, dict[str, Any]]:
    """Read a GRFM-Net: parameters, variant and card.

    Args:
        path: the file.
        robot: the robot in use.
        variant: name of the expected variant; None takes any.

    Raises:
        InputError: one line naming the file: damaged, of another robot, kind, layout or variant, or
            with a number that is not finite.
    """
    kinds, card = {f"grfm-{x}": x for x in ([variant] if variant else VARIANTS)}, read_card(path)
    if (kind := card["kind"]) not in kinds:
        raise InputError(f"{path}: holds {kind}, expected {' or '.join(kinds)}")
    name = kinds[kind]
    like = empty_params(name, tuple(card["about"]["hidden"]), walk_config(robot))
    params, card = load_tree(path, like, kind=kind, robot=robot)
    if not all(np.isfinite(p).all() for p in jax.tree.leaves(params)):
        raise InputError(f"{path}: a parameter of the net is not finite")
    return params, name, card


def empty_params(variant: str, hidden: tuple[int, ...], config: WalkConfig) -> Params:
    """Return zeros in the parameters' shapes, as `load_tree` takes them; an axis of 0 is ticks."""
    feet, axes = len(config.gait.offsets), config.mpc.contact.axes
    shapes = _shapes(VARIANTS[variant], hidden, feet, axes, jnp.result_type(float))
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)


@lru_cache(maxsize=64)
def _shapes(variant: Phi, hidden: tuple[int, ...], feet: int, axes: int, dtype: Any) -> Any:
    """Return the parameters' shapes under JAX's default `dtype`; cached, as it is slow."""
    del dtype  # a part of the cache's key only
    return jax.eval_shape(
        partial(variant.init, feet=feet, axes=axes, hidden=hidden), jax.random.key(0)
    )
