"""Training of a phi, and its errors in comparison with the raw command and other variants."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.core.inputs import InputError
from hector_jax.core.settings import check
from hector_jax.grfm.dataset import Dataset
from hector_jax.grfm.effect import Effect, Window
from hector_jax.grfm.nets import FitConfig, History, Progress
from hector_jax.grfm.network import VARIANTS, Params


@dataclass(frozen=True)
class TrainConfig(FitConfig):
    """Variant of phi to train, and settings of its fit."""

    variant: str = "residual"  # of network.VARIANTS

    def __post_init__(self) -> None:
        check(self, variant=tuple(VARIANTS))


class Errors(NamedTuple):
    """Mean square errors of a phi: axes are F_x F_y F_z [N^2], M_x M_y M_z [(N m)^2]."""

    force: float  # over all axes, feet and phases
    moment: float
    stance: Float[np.ndarray, "6"]  # per axis, of feet planned to stand
    swing: Float[np.ndarray, "6"]  # of feet planned to swing
    # forward and sideways [cm^2], of feet that land; zero if no touchdowns are learned
    touchdown: Float[np.ndarray, "2"]


def train(
    config: TrainConfig,
    training: Dataset,
    validation: Dataset,
    progress: Progress = lambda epoch, history: None,
) -> tuple[Params, History]:
    """Fit the parameters of a variant of phi.

    Args:
        config: variant and settings; the same settings and data give the same bytes on a CPU.
        training: samples to learn from; their statistics become part of the parameters.
        validation: samples of other walks, which choose the epoch of a net.
        progress: called after each epoch with its number, from 1, and the errors so far.

    Returns:
        Parameters, and the errors by epoch.

    Raises:
        InputError: no samples, or the training diverged.
    """
    for name, dataset in (("training", training), ("validation", validation)):
        if len(dataset.walk) == 0:
            raise InputError(f"the {name} set has no samples")
    params, history = VARIANTS[config.variant].fit(config, training, validation, progress)
    return jax.device_get(params), history


@jax.jit
def predict(effect: jax.tree_util.Partial, window: Window) -> Effect:
    """Return the effects of a phi for a batch of windows."""
    return jax.vmap(effect)(window)


def errors(effect: jax.tree_util.Partial, dataset: Dataset) -> Errors:
    """Return the mean square errors of a phi on a dataset."""
    effects = predict(effect, dataset.window)
    squares = jax.tree.map(lambda p, y: np.asarray((p - y) ** 2), effects.wrench, dataset.label)
    axes = np.concatenate(squares, axis=-1)  # (n, feet, 6)
    touchdown = (effects.touchdown_error - dataset.touchdown_error)[dataset.lands]
    return Errors(
        force=float(squares.force.mean()),
        moment=float(squares.moment.mean()),
        stance=axes[dataset.window.contact].mean(axis=0),
        swing=axes[~dataset.window.contact].mean(axis=0),
        touchdown=1e4 * np.square(touchdown[:, :2]).sum(axis=0) / max(len(touchdown), 1),
    )


def errors_by_phi(
    effects: Mapping[str, jax.tree_util.Partial], dataset: Dataset
) -> dict[str, dict[str, Any]]:
    """Return the errors of several phi on one dataset, as JSON values, by their names."""
    return {
        name: jax.tree.map(lambda x: np.asarray(x).tolist(), errors(effect, dataset)._asdict())
        for name, effect in effects.items()
    }
