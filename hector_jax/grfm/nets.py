"""The networks of GRFM-Net and their training.

The loss, for forces and moments apart, is the mean square of the standardised error plus
l2/2 |kernels|^2, minimised by Adam (in the paper: 1e-3, 1e-3, 200 epochs). All axes count equally,
as each is divided by its own spread. Several nets of one kind are trained side by side, the kinds
on a core each, and each net keeps the epoch with its least mean square error (N^2, (N m)^2) on
validation walks.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, NamedTuple, TypeVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, Int, Key

from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, SEED, check


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Settings of the fit of a phi's parameters."""

    epochs: Annotated[int, AT_LEAST_ONE] = 200
    batch: Annotated[int, AT_LEAST_ONE] = 512  # samples per step
    learning_rate: Annotated[float, POSITIVE] = 1e-3
    l2: Annotated[float, NOT_NEGATIVE] = 1e-3  # on kernels
    mirror: bool = True  # the paper's variant learns from the mirror image of each sample too
    seed: Annotated[int, SEED] = 0

    def __post_init__(self) -> None:
        check(self)


class History(NamedTuple):
    """Mean square errors in physical units by epoch, mean over the members of an ensemble.

    Training errors are means over the epoch. A fit in closed form has no epochs. Moments of feet
    that have none are zero.
    """

    train_force: Float[np.ndarray, " epochs"]  # [N^2]
    train_moment: Float[np.ndarray, " epochs"]  # [(N m)^2]
    valid_force: Float[np.ndarray, " epochs"]
    valid_moment: Float[np.ndarray, " epochs"]


NO_EPOCHS = History(*np.zeros((4, 0)))
Progress = Callable[[int, History], None]  # called after each epoch, from 1, with the errors so far


def closed_form(fit: Callable[[Any], Any]) -> Callable[..., tuple[Any, History]]:
    """Return the `Phi.fit` of a fit that needs the training samples alone and has no epochs."""
    return lambda config, training, validation, progress: (fit(training), NO_EPOCHS)


ByKind = tuple[Any, ...]
"""A value of the force nets and, unless feet have no moments, one of the moment nets."""


_Params = TypeVar("_Params", bound=Any)


class Samples(NamedTuple):
    """Training samples of the nets, n of them; x and y by kind, or of one kind."""

    x: Any  # inputs (n, ..., inputs)
    y: Any  # standardised labels (n, ..., outputs)
    trust: Any  # (n, ..., 1) factor on the nets' outputs


class Net(nn.Module):
    """Layers of linear, layer normalisation and softsign, then a linear one."""

    hidden: tuple[int, ...]
    outputs: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"]) -> Float[Array, "*batch m"]:
        """Return outputs for inputs, both standardised."""
        for width in self.hidden:
            # the two-pass variance: the fast one loses half the digits that gradient checks need
            x = nn.soft_sign(nn.LayerNorm(use_fast_variance=False)(nn.Dense(width)(x)))
        return nn.Dense(self.outputs)(x)


def init_nets(
    key: Key[Array, ""],
    hidden: tuple[int, ...],
    inputs: int,
    *,
    outputs: int,
    members: int,
    axes: int,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Draw parameters of force nets and moment nets, `members` of each stacked.

    There are no moment nets, an empty dictionary, if a foot's wrench has 3 `axes` and not 6.
    """
    keys = (jax.random.split(k, members) for k in jax.random.split(key)[: axes // 3])
    force, *moment = (_draw(Net(hidden, outputs), inputs, k) for k in keys)
    return force, moment[0] if moment else {}


def by_kind(params: Any) -> ByKind:
    """Return the nets that the parameters of a variant have, see `init_nets`."""
    return tuple(net for net in (params.force, params.moment) if net)


def with_nets(params: _Params, nets: ByKind) -> _Params:
    """Return parameters of a variant with other nets of the kinds that they have."""
    return params._replace(**dict(zip(("force", "moment"), nets, strict=False)))


def member(params: _Params, number: int) -> _Params:
    """Return parameters of a variant with copies of one member in the place of all members."""

    def copies(stacked: Any) -> np.ndarray:
        return np.broadcast_to(stacked[number % len(stacked)], np.shape(stacked))

    return with_nets(params, tuple(jax.tree.map(copies, net) for net in by_kind(params)))


@partial(jax.jit, static_argnums=(0, 1))
def _draw(net: Net, inputs: int, keys: Key[Array, " members"]) -> Any:
    return jax.vmap(lambda k: net.init(k, jnp.zeros(inputs))["params"])(keys)


def widths(net: dict[str, Any]) -> tuple[int, ...]:
    """Return the widths of the hidden layers of a net, read off its parameters."""
    return tuple(net[f"Dense_{i}"]["kernel"].shape[-1] for i in range(len(net) // 2))


def apply_net(params: dict[str, Any], x: Float[Array, "*batch n"]) -> Float[Array, "*batch m"]:
    """Return the standardised outputs of one net."""
    hidden = widths(params)
    outputs = params[f"Dense_{len(hidden)}"]["kernel"].shape[-1]
    y: Any = Net(hidden, outputs).apply({"params": params}, x)
    return y


class _Carry(NamedTuple):
    """State of the training of the nets of one kind, stacked."""

    nets: Any  # parameters
    optimiser: Any  # its state
    best: Any  # parameters of each member's epoch with the least validation error
    best_error: Float[Array, " members"]  # that error


def fit_nets(
    config: FitConfig,
    key: Key[Array, ""],
    nets: ByKind,
    *,
    training: Samples,
    validation: Samples,
    scale: ByKind,
    output: Callable[[Array, Array], Array],
    progress: Progress,
) -> tuple[ByKind, History]:
    """Train force nets and moment nets in 32 bits.

    Args:
        config: settings; the same settings and data give the same bytes on a CPU.
        key: for the order of the samples.
        nets: parameters to start from, members stacked along the first axis.
        training: samples to learn from.
        validation: samples of other walks, which choose the epoch.
        scale: physical unit of each standardised output, in N and N m.
        output: `(output of a net, trust) -> standardised prediction`, a module-level function.
        progress: see `Progress`.

    Returns:
        The best parameters of each member, and the errors by epoch.

    Raises:
        InputError: no epoch has a finite validation error.
    """
    infinite = jnp.full(len(jax.tree.leaves(nets)[0]), jnp.inf, jnp.float32)
    # traced: another rate needs no new compilation
    rates, rows = (config.learning_rate, config.l2), []
    optimiser = _optimiser(rates)
    carries = [_Carry(net, optimiser.init(net), net, infinite) for net in nets]

    def train(kind: int, key: Key[Array, ""]) -> Float[np.ndarray, "2"]:
        """Train the nets of a kind for an epoch."""
        carries[kind], row = _train_epoch(
            carries[kind],
            key,
            output=output,
            size=config.batch,
            rates=rates,
            scale=scale[kind],
            training=_of_kind(training, kind),
            validation=_of_kind(validation, kind),
        )
        return jax.device_get(row)

    with ThreadPoolExecutor(len(nets)) as threads:
        for epoch, key_epoch in enumerate(jax.random.split(key, config.epochs), start=1):
            row = np.array([*threads.map(partial(train, key=key_epoch), range(len(nets)))]).T
            rows.append(np.pad(row, ((0, 0), (0, 2 - len(nets)))).ravel())
            progress(epoch, History(*np.array(rows).T))
    if not all(np.isfinite(carry.best_error).all() for carry in carries):
        raise InputError("training diverged: no epoch has a finite validation error")
    return tuple(carry.best for carry in carries), History(*np.array(rows).T)


def _of_kind(samples: Samples, kind: int) -> Samples:
    return samples._replace(x=samples.x[kind], y=samples.y[kind])


def _optimiser(rates: tuple[Any, Any]) -> optax.GradientTransformation:
    learning_rate, l2 = rates

    def kernels(nets: Any) -> Any:
        return jax.tree_util.tree_map_with_path(lambda path, _: path[-1].key == "kernel", nets)

    return optax.chain(optax.add_decayed_weights(l2, mask=kernels), optax.adam(learning_rate))


def _squares(
    output: Callable[[Array, Array], Array], nets: Any, samples: Samples
) -> Float[Array, "members outputs"]:
    """Return the mean square of the standardised error of nets of one kind."""

    def square(net: Any) -> Array:
        error = output(apply_net(net, samples.x), samples.trust) - samples.y
        return jnp.mean(error**2, axis=tuple(range(samples.y.ndim - 1)))

    return jax.vmap(square)(nets)


@partial(jax.jit, static_argnames=("output", "size"))
def _train_epoch(
    carry: _Carry,
    key: Key[Array, ""],
    *,
    output: Callable[[Array, Array], Array],
    size: int,
    rates: tuple[Any, Any],  # numbers or tracers
    scale: Float[Array, " outputs"],
    training: Samples,
    validation: Samples,
) -> tuple[_Carry, Float[Array, "2"]]:
    """Return the next state, and the errors of training and validation, means over the members."""
    count = len(training.x)
    batch = min(size, count)
    order = jax.random.permutation(key, count)[: count // batch * batch].reshape(-1, batch)
    optimiser = _optimiser(rates)

    def loss(nets: Any, samples: Samples) -> tuple[Float[Array, ""], Array]:
        squares = _squares(output, nets, samples)
        return squares.mean(axis=1).sum(), squares

    def step(state: tuple[Any, Any], rows: Int[Array, " batch"]) -> tuple[tuple[Any, Any], Array]:
        nets, opt_state = state
        samples = jax.tree.map(lambda a: a[rows], training)
        gradient, squares = jax.grad(loss, has_aux=True)(nets, samples)
        update, opt_state = optimiser.update(gradient, opt_state, nets)
        return (optax.apply_updates(nets, update), opt_state), squares

    (nets, opt_state), squares = jax.lax.scan(step, (carry.nets, carry.optimiser), order)
    train_error, error = (
        jnp.mean(x * jnp.square(scale), axis=-1)
        for x in (squares.mean(axis=0), _squares(output, nets, validation))
    )
    keep_best = partial(jax.vmap(jnp.where), error < carry.best_error)
    best = jax.tree.map(keep_best, nets, carry.best)
    best_error = jnp.fmin(error, carry.best_error)
    return _Carry(nets, opt_state, best, best_error), jnp.array([train_error.mean(), error.mean()])
