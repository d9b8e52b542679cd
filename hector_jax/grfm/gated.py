"""The linear part of phi: gated by contact and by the time since the stance last switched.

Three maps, each fitted to what the high-fidelity simulator shows:

- **ground**: what the ground returns to a foot is the command itself (nothing, for a foot planned
  to swing), a bias of the tick since the switch, and terms in the latest changes of the commands.
- **legs**: the push that the moving legs give the trunk, which a rigid body cannot know: a bias of
  the tick, and terms in the motion of the base and in the latest changes of the commands.
- **touchdown**: how far from its planned touchdown a foot lands: a bias, and terms in the motion of
  the base and in the horizontal force commanded on the other foot, which accelerates the base and
  so moves the planned point. A swinging leg sags and lags, so the lever of its force is not the
  planned one. The fit is robust, because a robot that is about to fall lands anywhere.

A command that stays is returned as it is, by construction. It has to be: the walks were recorded in
closed loop, where the controller asks for whatever the ground withheld, so that over a step the
wrench is that which walking needs, whatever was commanded. A regression on the command itself reads
this as a ground that hardly answers, and the body of the rollout cannot hold itself on such ground.
Changes of the command within 20 ms are too quick for that loop.

Each foot sees the walk as if it were the left one, so a mirrored window has the mirrored effect.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Key

from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import Load, Wrench
from hector_jax.grfm.dataset import ACROSS, ALONG, Dataset
from hector_jax.grfm.effect import HISTORY, Effect, Phi, Window, in_dtype_of
from hector_jax.grfm.nets import NO_EPOCHS

CHANGES = 12 * (HISTORY - 1)  # of the commands of both feet from tick to tick
MOTION = 3  # of the base: yaw rate, forward and sideways velocity
TOUCHDOWN = MOTION + 2  # and the force on the other foot, forward and sideways
GATES = (0.0, 0.01, 0.03, 0.08, 0.19)  # [s] after a switch, where the terms of the legs may differ
RIDGE, RIDGE_MOTION = 0.03, 1e-3  # penalty on standardised terms, relative to the number of samples
HUBER, HUBER_ROUNDS = 2.0, 20  # where errors count linearly, in medians of the error
_SIGNS = np.stack([np.ones(6), np.concatenate([ALONG, ACROSS])])  # of force and moment, by foot
_FLOOR = 0.05  # least scale of a change, relative to the largest of its kind


class View(NamedTuple):
    """What a foot sees of a window; the right one sees the mirror image."""

    command: Float[Array, "*batch 6"]  # force and moment on it, newest
    changes: Float[Array, "*batch changes"]  # of the commands, newest first; its own, the other's
    motion: Float[Array, "*batch 3"]  # of the base
    stands: Bool[Array, "*batch"]  # planned
    alone: Bool[Array, "*batch"]  # it stands and the other foot swings


class GatedMap(NamedTuple):
    """The three maps; the axis of 2 is swing, stance, that of 6 force and moment (torque)."""

    ticks: Float[Array, " ticks"]  # [s] after a switch, where a bias is given
    gates: Float[Array, " gates"]  # [s] after a switch, where terms of the legs are given
    bias: Float[Array, "2 ticks 6"]
    changes: Float[Array, "2 changes 6"]
    legs_bias: Float[Array, "ticks 6"]
    legs: Float[Array, "gates terms 6"]  # of motion, then changes
    touchdown: Float[Array, "terms 3"]  # [m] of 1, motion, force on the other foot


def init(key: Key[Array, ""], hidden: tuple[int, ...] = ()) -> GatedMap:
    """A map to nothing; the axis of ticks has length 0."""
    del key, hidden
    return GatedMap(
        ticks=jnp.zeros(0),
        gates=jnp.zeros(len(GATES)),
        bias=jnp.zeros((2, 0, 6)),
        changes=jnp.zeros((2, CHANGES, 6)),
        legs_bias=jnp.zeros((0, 6)),
        legs=jnp.zeros((len(GATES), CHANGES + MOTION, 6)),
        touchdown=jnp.zeros((1 + TOUCHDOWN, 3)),
    )


def views(window: Window) -> View:
    """What the left and the right foot see (leading axis 2) of one window."""
    dtype = window.commands.force.dtype

    def own(foot: int) -> View:
        along, across = (jnp.asarray(s if foot else np.ones(3), dtype) for s in (ALONG, ACROSS))
        both = [
            jnp.concatenate(
                [window.commands.force[:, f] * along, window.commands.moment[:, f] * across], axis=1
            )
            for f in (foot, 1 - foot)
        ]
        base = window.base
        motion = (base.ang_velocity * across)[2:], (base.velocity * along)[:2]
        stands = window.contact[foot]
        return View(
            command=both[0][0],
            changes=jnp.concatenate([(w[:-1] - w[1:]).ravel() for w in both]),
            motion=jnp.concatenate(motion),
            stands=stands,
            alone=stands & ~window.contact[1 - foot],
        )

    return jax.tree.map(lambda *feet: jnp.stack(feet), own(0), own(1))


def hats(time: Float[Array, "*batch"], knots: Float[Array, " knots"]) -> Float[Array, "... knots"]:
    """Piecewise linear functions of the time [s], one at each knot; the ends reach on."""
    before = jnp.concatenate([knots[:1] - 1.0, knots[:-1]])
    after = jnp.concatenate([knots[1:], knots[-1:] + 1.0])
    time = jnp.clip(time, knots[0], knots[-1])[..., None]
    sides = (time - before) / (knots - before), (after - time) / (after - knots)
    return jnp.clip(jnp.minimum(*sides), 0.0, 1.0)


def from_views(values: Float[Array, "2 6"]) -> Wrench:
    """Forces and moments as each foot sees them, back in the yaw frame."""
    back = values * jnp.asarray(_SIGNS, values.dtype)
    return Wrench(back[:, :3], back[:, 3:])


def apply_gated(
    gated: GatedMap, window: Window, view: View
) -> tuple[Float[Array, "2 6"], Load, Float[Array, "2 3"]]:
    """Ground wrench as each foot sees it; load of the legs, error of the touchdown [m], yaw frame.

    Args:
        gated: fitted maps.
        window: one window.
        view: what the feet see of it, `views(window)`.
    """
    stands = view.stands.astype(int)
    tick, gate = hats(window.since_switch, gated.ticks), hats(window.since_switch, gated.gates)
    ground = (
        view.stands[:, None] * view.command
        + jnp.einsum("k,fko->fo", tick, gated.bias[stands])
        + jnp.einsum("fi,fio->fo", view.changes, gated.changes[stands])
    )
    terms = jnp.concatenate([view.motion, view.changes], axis=-1)
    push = tick @ gated.legs_bias + jnp.einsum("g,fi,gio->fo", gate, terms, gated.legs)
    back = from_views(push * view.alone[:, None])
    shift = gated.touchdown[0] + _touchdown_terms(view) @ gated.touchdown[1:]
    shift = shift * jnp.asarray(_SIGNS[:, :3], shift.dtype)
    return ground, Load(back.force.sum(axis=0), back.moment.sum(axis=0)), shift


def apply(gated: GatedMap, window: Window) -> Effect:
    """Effect of the linear part alone for one window."""
    gated, window = in_dtype_of(window, gated), in_dtype_of(window, window)
    ground, legs, shift = apply_gated(gated, window, views(window))
    return Effect(from_views(ground), legs, shift)


def labels_in_view(dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Wrench of the ground and load of the legs (n, 2, 6) each, as each foot sees them."""
    ground = np.concatenate([dataset.label.force, dataset.label.moment], axis=-1)
    legs = np.concatenate([dataset.legs.force, dataset.legs.torque], axis=-1)
    return ground * _SIGNS, legs[:, None] * _SIGNS


def fit_gated(dataset: Dataset) -> GatedMap:
    """Ridge regression of the maps; every sample is seen by both feet."""
    window = jax.tree.map(jnp.asarray, dataset.window)
    view = jax.tree.map(np.asarray, jax.jit(jax.vmap(views))(window))
    ticks, gates = np.unique(np.asarray(dataset.window.since_switch)), np.array(GATES)
    tick, gate = (
        np.repeat(np.asarray(jax.jit(hats)(window.since_switch, knots))[:, None], 2, axis=1)
        for knots in (ticks, gates)
    )
    ground, legs = labels_in_view(dataset)
    residual = ground - view.stands[..., None] * view.command
    scale = _scale(view.changes)
    changes = view.changes / scale
    bias, slope = zip(
        *(
            _ridge(RIDGE, tick[rows], changes[rows], residual[rows])
            for rows in (~view.stands, view.stands)
        ),
        strict=True,
    )
    alone = view.alone
    term_scale = np.concatenate([_spread(view.motion[alone]), scale])
    terms = np.concatenate([view.motion, view.changes], axis=-1)[alone] / term_scale
    gated = (gate[alone][:, :, None] * terms[:, None]).reshape(len(terms), -1)
    legs_bias, legs_slope = _ridge(RIDGE_MOTION, tick[alone], gated, legs[alone])
    maps = GatedMap(
        ticks=ticks,
        gates=gates,
        bias=np.stack(bias),
        changes=np.stack(slope) / scale[:, None],
        legs_bias=legs_bias,
        legs=legs_slope.reshape(len(gates), -1, 6) / term_scale[:, None],
        touchdown=_fit_touchdown(view, dataset),
    )
    return jax.tree.map(jnp.asarray, maps)


def _touchdown_terms(view: View) -> Float[Array, "*batch terms"]:
    """Motion of the base and horizontal force on the other foot, as a foot sees them."""
    across = view.command[..., ::-1, :2] * jnp.array([1.0, -1.0], view.command.dtype)
    return jnp.concatenate([view.motion, across], axis=-1)


def _fit_touchdown(view: View, dataset: Dataset) -> Float[np.ndarray, "terms 3"]:
    """The map of the errors of touchdowns, of the samples in which a foot lands."""
    lands = dataset.lands
    if not lands.any():
        return np.zeros((1 + TOUCHDOWN, 3))
    terms = np.asarray(_touchdown_terms(view))[lands]
    y, scale = np.asarray(dataset.touchdown_error * _SIGNS[:, :3])[lands], _spread(terms)
    bias, slope = np.split(_huber_ridge(terms / scale, y), [1])
    return np.concatenate([bias, slope / scale[:, None]])


def _huber_ridge(terms: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coefficients (1 + terms, outputs) of one and the terms by the Huber loss, penalised.

    Each round weighs the samples by their errors in the round before.
    """
    one = np.ones((len(y), 1))

    def fit(y: np.ndarray, weight: np.ndarray) -> np.ndarray:
        return np.concatenate(_ridge(RIDGE_MOTION, weight, weight * terms, weight * y))

    def robust(y: np.ndarray) -> np.ndarray:
        found = fit(y, one)
        for _ in range(HUBER_ROUNDS):
            error = np.abs(y - found[0] - terms @ found[1:])
            limit = HUBER * np.median(error)
            found = fit(y, np.sqrt(np.minimum(1.0, limit / np.maximum(error, 1e-9))))
        return found

    return np.concatenate([robust(column[:, None]) for column in y.T], axis=1)


def _spread(x: np.ndarray) -> np.ndarray:
    spread = x.reshape(-1, x.shape[-1]).std(axis=0)
    return np.where(spread > 0.0, spread, 1.0)


def _scale(changes: np.ndarray) -> np.ndarray:
    """Spread of each change; one that hardly moves is no signal to be blown up."""
    spread = changes.reshape(-1, 2 * (HISTORY - 1), 2, 3).std(axis=0)
    largest = spread.max(axis=(0, 2), keepdims=True)
    largest = np.where(largest > 0.0, largest, 1.0)
    return np.maximum(spread, _FLOOR * largest).ravel()


def _ridge(
    penalty: float, free: np.ndarray, terms: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the free columns and of the penalised ones, in the mean square."""
    if len(y) == 0:
        return np.zeros((free.shape[1], y.shape[1])), np.zeros((terms.shape[1], y.shape[1]))
    columns = np.concatenate([free, terms], axis=1)
    penalties = np.r_[np.full(free.shape[1], 1e-6), np.full(terms.shape[1], penalty)]
    gram = columns.T @ columns / len(y) + np.diag(penalties)
    coefficients = np.linalg.solve(gram, columns.T @ y / len(y))
    return coefficients[: free.shape[1]], coefficients[free.shape[1] :]


GATED = Phi(
    "gated",
    GatedMap,
    init,
    lambda config, training, validation, progress: (fit_gated(training), NO_EPOCHS),
    apply,
)
