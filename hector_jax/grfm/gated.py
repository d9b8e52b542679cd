"""The linear part of phi: gated by contact and by the time since the stance last switched.

Three maps, each fitted to what the high-fidelity simulator shows:

- **ground**: the wrench of the ground on a foot is the command itself (zero for a foot planned to
  swing), a bias of the tick since the switch, and terms in the latest changes of the commands.
- **legs**: the push of the moving legs on the trunk, which a rigid body does not have: a bias of
  the tick, and terms in the motion of the base and in the latest changes of the commands.
- **touchdown**: the offset of a foot's landing from plan: a bias, and terms in the motion of
  the base and in the horizontal force commanded on the other feet, which accelerates the base and
  so moves the planned point. A swinging leg sags and lags, so the lever of its force differs from
  the plan. The fit is robust, because a robot that is about to fall lands anywhere.

By construction a constant command is returned unchanged. This is necessary: the walks were recorded
in closed loop, where the controller makes up for any force that the ground did not give, so that
over a step the wrench is what walking needs, whatever was commanded. A regression on the command
itself would read this as a ground that hardly responds, and the rollout's body could not stand on
such ground. Changes of the command within 20 ms are too quick for that loop.

Each foot sees the walk as if it were a left one, so a mirrored window has the mirrored effect. Each
pair of feet has maps of its own.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Key

from hector_jax.core.arrays import Array, contract
from hector_jax.core.trajectory import Load, Wrench
from hector_jax.grfm.dataset import ACROSS, ALONG, Dataset, partners
from hector_jax.grfm.effect import HISTORY, Effect, Phi, Window, in_dtype_of
from hector_jax.grfm.nets import closed_form

MOTION = 3  # terms of the base's motion: yaw rate, forward and sideways velocity
TOUCHDOWN = 1 + MOTION + 2  # constant, motion, force on the other feet (forward and sideways)
GATES = (0.0, 0.01, 0.03, 0.08, 0.19)  # [s] after a switch, knots of the terms of the legs
RIDGE, RIDGE_MOTION = 0.03, 1e-3  # penalty on standardised terms, relative to the number of samples
HUBER, HUBER_ROUNDS = 2.0, 20  # threshold of the linear loss, in medians of the error
_FLOOR = 0.05  # least scale of a change, relative to the largest of its kind


def num_changes(feet: int, axes: int) -> int:
    """Return the number of tick-to-tick changes in a window's commands, over all feet."""
    return axes * feet * (HISTORY - 1)


def signs(feet: int) -> Float[np.ndarray, "feet 6"]:
    """Return the signs of force and moment in each foot's view: right feet are mirrored."""
    return np.tile(np.stack([np.ones(6), np.concatenate([ALONG, ACROSS])]), (feet // 2, 1))


class View(NamedTuple):
    """A window as one foot sees it; a right foot sees the mirror image."""

    command: Float[Array, "*batch axes"]  # newest force and moment on the foot
    others: Float[Array, "*batch 2"]  # total force on the other feet, forward and sideways
    changes: Float[Array, "*batch changes"]  # of commands, newest first: own foot, partner, others
    motion: Float[Array, "*batch 3"]  # of the base
    stands: Bool[Array, "*batch"]  # planned stance
    alone: Bool[Array, "*batch"]  # the foot stands and its partner swings
    kind: Int[Array, "*batch"]  # 2 * pair + stance: swing and stance of the first pair, then next


class GatedMap(NamedTuple):
    """The three maps; kinds are those of a `View`.

    Axes are those of a foot's wrench: force and moment, or the force alone if it has no moment.
    """

    ticks: Float[Array, " ticks"]  # [s] after a switch, knots of the biases
    gates: Float[Array, " gates"]  # [s] after a switch, knots of the terms of the legs
    bias: Float[Array, "kinds ticks axes"]
    changes: Float[Array, "kinds changes axes"]
    legs_bias: Float[Array, "ticks pushes"]  # force and torque, 6 pushes per pair
    legs: Float[Array, "gates terms pushes"]  # terms: motion, then changes; 6 pushes per pair
    touchdown: Float[Array, "terms shifts"]  # terms: 1, motion, force on others; 3 [m] per pair

    @property
    def axes(self) -> int:
        """Number of axes of a foot's wrench, 3 or 6."""
        return self.bias.shape[-1]


def init(
    key: Key[Array, ""], feet: int = 2, axes: int = 6, hidden: tuple[int, ...] = ()
) -> GatedMap:
    """Return maps of zeros; the axis of ticks has length 0."""
    del key, hidden
    pairs, changes = feet // 2, num_changes(feet, axes)
    return GatedMap(
        ticks=jnp.zeros(0),
        gates=jnp.zeros(len(GATES)),
        bias=jnp.zeros((feet, 0, axes)),
        changes=jnp.zeros((feet, changes, axes)),
        legs_bias=jnp.zeros((0, pairs * 6)),
        legs=jnp.zeros((len(GATES), changes + MOTION, pairs * 6)),
        touchdown=jnp.zeros((TOUCHDOWN, pairs * 3)),
    )


def views(window: Window, axes: int) -> View:
    """Return each foot's view of one window, of 3 or 6 axes; the feet are the leading axis."""
    dtype, feet = window.commands.force.dtype, len(window.contact)
    commands = jnp.concatenate(window.commands, axis=-1)[..., :axes]  # (HISTORY, feet, axes)

    def view_of(foot: int) -> View:
        sign = jnp.asarray(signs(feet)[foot], dtype)
        # the foot's own pair first, and in each pair first the foot on its own side
        order = (np.arange(feet) ^ foot % 2).reshape(-1, 2)
        order = np.roll(order, -(foot // 2), axis=0).ravel()
        wrenches, base = commands[:, order] * sign[:axes], window.base
        motion = (base.ang_velocity * sign[3:])[2:], (base.velocity * sign[:3])[:2]
        stands = window.contact[foot]
        return View(
            command=wrenches[0, 0],
            others=wrenches[0, 1:, :2].sum(axis=0),
            changes=jnp.swapaxes(wrenches[:-1] - wrenches[1:], 0, 1).ravel(),
            motion=jnp.concatenate(motion),
            stands=stands,
            alone=stands & ~window.contact[partners(feet)[foot]],
            kind=foot // 2 * 2 + stands.astype(int),
        )

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(view_of, range(feet)))


@partial(jax.jit, static_argnums=1)
def _views(windows: Window, axes: int) -> View:
    return jax.vmap(partial(views, axes=axes))(windows)


def hats(time: Float[Array, "*batch"], knots: Float[Array, " knots"]) -> Float[Array, "... knots"]:
    """Return piecewise linear hat functions of the time [s], 1 at their knot, constant beyond."""
    before = jnp.concatenate([knots[:1] - 1.0, knots[:-1]])
    after = jnp.concatenate([knots[1:], knots[-1:] + 1.0])
    time = jnp.clip(time, knots[0], knots[-1])[..., None]
    rising, falling = (time - before) / (knots - before), (after - time) / (after - knots)
    return jnp.clip(jnp.minimum(rising, falling), 0.0, 1.0)


def from_views(values: Float[Array, "feet axes"]) -> Wrench:
    """Return forces and moments of the feet's views in the yaw frame; of 3 axes, no moments."""
    values = jnp.pad(values, ((0, 0), (0, 6 - values.shape[-1])))
    wrench = values * jnp.asarray(signs(len(values)), values.dtype)
    return Wrench(wrench[:, :3], wrench[:, 3:])


def apply_gated(
    gated: GatedMap, window: Window, view: View
) -> tuple[Float[Array, "feet axes"], Load, Float[Array, "feet 3"]]:
    """Return the ground wrench in each foot's view, and legs' load and touchdown error [m].

    Load and touchdown error are in the yaw frame.

    Args:
        gated: fitted maps.
        window: one window.
        view: views of that window, `views(window, gated.axes)`.
    """
    feet = len(view.stands)
    pairs = feet // 2
    tick, gate = hats(window.since_switch, gated.ticks), hats(window.since_switch, gated.gates)
    ground = (
        view.stands[:, None] * view.command
        + contract("k,fko->fo", tick, gated.bias[view.kind])
        + contract("fi,fio->fo", view.changes, gated.changes[view.kind])
    )
    legs_bias, legs, touchdown = (
        table.reshape(*table.shape[:-1], pairs, -1)
        for table in (gated.legs_bias, gated.legs, gated.touchdown)
    )
    terms = jnp.concatenate([view.motion, view.changes], axis=-1)
    terms, touchdown_terms = (x.reshape(pairs, 2, -1) for x in (terms, _touchdown_terms(view)))
    push = contract("k,kpo->po", tick, legs_bias)[:, None]
    push = push + contract("g,psi,gipo->pso", gate, terms, legs)
    pushes = from_views(push.reshape(feet, -1) * view.alone[:, None])
    shift = touchdown[0][:, None] + contract("psi,ipo->pso", touchdown_terms, touchdown[1:])
    shift = shift.reshape(feet, -1) * jnp.asarray(signs(feet)[:, :3], shift.dtype)
    return ground, Load(pushes.force.sum(axis=0), pushes.moment.sum(axis=0)), shift


def apply(gated: GatedMap, window: Window) -> Effect:
    """Return the effect of the linear part alone for one window."""
    gated, window = in_dtype_of(window, gated), in_dtype_of(window, window)
    ground, legs, shift = apply_gated(gated, window, views(window, gated.axes))
    return Effect(from_views(ground), legs, shift)


def labels_in_view(dataset: Dataset) -> Float[np.ndarray, "n feet axes"]:
    """Return the labels, wrenches of the ground, in each foot's view."""
    ground = np.concatenate([dataset.label.force, dataset.label.moment], axis=-1)
    return (ground * signs(dataset.feet))[..., : dataset.axes]


def fit_gated(dataset: Dataset) -> GatedMap:
    """Fit the maps by ridge regression; every sample counts once in the view of each foot."""
    axes, since_switch = dataset.axes, dataset.window.since_switch
    view = jax.tree.map(np.asarray, _views(dataset.window, axes))
    ticks, gates = np.unique(since_switch), np.array(GATES)
    tick, gate = (np.asarray(jax.jit(hats)(since_switch, knots)) for knots in (ticks, gates))
    feet = view.stands.shape[1]
    residual = labels_in_view(dataset) - view.stands[..., None] * view.command
    scale = _scale(view.changes.reshape(-1, view.changes.shape[-1] // axes, axes // 3, 3))
    changes = view.changes / scale
    tick_by_foot = np.repeat(tick[:, None], feet, axis=1)

    def fit_kind(kind: int) -> tuple[np.ndarray, np.ndarray]:
        rows = view.kind == kind
        return _ridge(RIDGE, tick_by_foot[rows], changes[rows], residual[rows])

    bias, slope = map(np.stack, zip(*map(fit_kind, range(feet)), strict=True))
    maps = GatedMap(
        ticks=ticks,
        gates=gates,
        bias=bias,
        changes=slope / scale[:, None],
        **_fit_legs(view, dataset, tick, gate, scale),
        touchdown=_fit_touchdown(view, dataset),
    )
    return jax.tree.map(jnp.asarray, maps)


def _fit_legs(
    view: View, dataset: Dataset, tick: np.ndarray, gate: np.ndarray, scale: np.ndarray
) -> dict[str, np.ndarray]:
    """Fit the maps of the legs' push, a sum over the feet whose partner swings; by field name.

    In the view of right feet three of the six axes are mirrored: they are fitted apart.
    """
    rows, feet = view.alone.any(axis=1), view.alone.shape[1]
    pairs = feet // 2
    load = np.concatenate([dataset.legs.force, dataset.legs.torque], axis=-1)[rows]
    term_scale = np.concatenate([_spread(np.asarray(view.motion)[view.alone]), scale])
    terms = np.concatenate([view.motion, view.changes], axis=-1)[rows] / term_scale
    gated = gate[rows][:, None, :, None] * terms[:, :, None]  # (n, feet, gates, terms)
    tick_by_foot = np.repeat(tick[rows][:, None], feet, axis=1)
    legs_bias = np.zeros((tick.shape[1], pairs, 6))
    legs = np.zeros((gate.shape[1], terms.shape[-1], pairs, 6))
    for axes in (signs(2)[1] > 0.0, signs(2)[1] < 0.0):
        sign = np.asarray(view.alone)[rows] * signs(feet)[:, axes][:, 0]  # 0 for feet not alone
        sign = sign.reshape(-1, pairs, 2)

        def sum_pairs(x: np.ndarray, sign: np.ndarray = sign) -> np.ndarray:
            by_pair = x.reshape(*sign.shape, -1)
            return np.einsum("nps,npsi->nip", sign, by_pair).reshape(len(x), -1)

        bias, slope = _ridge(RIDGE_MOTION, sum_pairs(tick_by_foot), sum_pairs(gated), load[:, axes])
        legs_bias[..., axes] = bias.reshape(*legs_bias.shape[:2], -1)
        legs[..., axes] = slope.reshape(*legs.shape[:3], -1)
    legs /= term_scale[:, None, None]
    flat = lambda x: x.reshape(*x.shape[:-2], -1)  # noqa: E731
    return {"legs_bias": flat(legs_bias), "legs": flat(legs)}


def _touchdown_terms(view: View) -> Float[Array, "*batch terms"]:
    """Return motion of the base and horizontal force on the other feet, as a foot sees them."""
    return jnp.concatenate([view.motion, view.others], axis=-1)


def _fit_touchdown(view: View, dataset: Dataset) -> Float[np.ndarray, "terms shifts"]:
    """Fit the map of touchdown errors on the samples in which a foot lands."""
    all_terms, error = np.asarray(_touchdown_terms(view)), dataset.touchdown_error
    maps = []
    for first in range(0, dataset.feet, 2):
        pair = slice(first, first + 2)
        lands = dataset.lands[:, pair]
        if not lands.any():
            maps.append(np.zeros((TOUCHDOWN, 3)))
            continue
        terms = all_terms[:, pair][lands]
        y, scale = np.asarray(error[:, pair] * signs(2)[:, :3])[lands], _spread(terms)
        bias, slope = np.split(_huber_ridge(terms / scale, y), [1])
        maps.append(np.concatenate([bias, slope / scale[:, None]]))
    return np.concatenate(maps, axis=1)


def _huber_ridge(terms: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return coefficients (1 + terms, outputs) of a constant and the terms by Huber loss and ridge.

    Each round weighs the samples by their errors in the round before.
    """
    constant = np.ones((len(y), 1))

    def fit(y: np.ndarray, weight: np.ndarray) -> np.ndarray:
        return np.concatenate(_ridge(RIDGE_MOTION, weight, weight * terms, weight * y))

    def robust(y: np.ndarray) -> np.ndarray:
        coefficients = fit(y, constant)
        for _ in range(HUBER_ROUNDS):
            error = np.abs(y - coefficients[0] - terms @ coefficients[1:])
            limit = HUBER * np.median(error)
            coefficients = fit(y, np.sqrt(np.minimum(1.0, limit / np.maximum(error, 1e-9))))
        return coefficients

    return np.concatenate([robust(column[:, None]) for column in y.T], axis=1)


def _spread(x: np.ndarray) -> np.ndarray:
    spread = x.reshape(-1, x.shape[-1]).std(axis=0)
    return np.where(spread > 0.0, spread, 1.0)


def _scale(changes: Float[np.ndarray, "n changes parts 3"]) -> Float[np.ndarray, " terms"]:
    """Return the spread of each change, at least `_FLOOR` of the largest of its kind."""
    spread = changes.std(axis=0)
    largest = spread.max(axis=(0, 2), keepdims=True)
    largest = np.where(largest > 0.0, largest, 1.0)
    return np.maximum(spread, _FLOOR * largest).ravel()


def _ridge(
    penalty: float, free: np.ndarray, terms: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve least squares (mean square) for the coefficients of free and of penalised columns."""
    if len(y) == 0:
        return np.zeros((free.shape[1], y.shape[1])), np.zeros((terms.shape[1], y.shape[1]))
    columns = np.concatenate([free, terms], axis=1)
    penalties = np.r_[np.full(free.shape[1], 1e-6), np.full(terms.shape[1], penalty)]
    gram = columns.T @ columns / len(y) + np.diag(penalties)
    coefficients = np.linalg.solve(gram, columns.T @ y / len(y))
    return coefficients[: free.shape[1]], coefficients[free.shape[1] :]


GATED = Phi("gated", GatedMap, init, closed_form(fit_gated), apply)
