"""Agreement of a model's gradient with the simulator's: numbers and tables of transfer.py.

All gradients are those of L in the logarithms of 18 weights: each of Q, and each of R, which the
two feet share. Rows of a matrix are start phases. Two gradients are compared by the cosine between
their means over phases; intervals redraw the same phases for model and simulator. With a
handful of phases such an interval is narrow rather than wide, and it says nothing of other
commands.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import spearmanr

from hector_jax.control.weights import Weights, direction_names, directions, weights_to_vector
from hector_jax.report.report import markdown_table
from hector_jax.verdict.metrics import Interval, bootstrap

SAG = ("Q_z", "Q_vz", "R_Fz")
"""The weights that a rigid body that sinks, or a robot that floats, depends on most."""

BEYOND_SAG = np.array([name not in SAG for name in direction_names()])
STEP = float(np.log(1.05))  # of the central differences, in log-weights


class Row(NamedTuple):
    """A phi against the simulator, at a weight set and trajectory."""

    cosine: Interval
    beyond_sag: Interval  # cosine without the directions of SAG
    gain: Interval | None  # cosine less that of the command itself; None for the command
    gain_beyond_sag: Interval | None
    wrong: str  # the weight whose entry differs most between the unit gradients
    share: float  # of the squared distance between the unit gradients, due to that weight
    entries: tuple[float, float]  # of that weight, in the unit gradients of model and simulator
    sizes: tuple[float, float]  # norms of the mean gradients of model and simulator
    phases: int  # with finite gradients in all


Rows = Mapping[tuple[str, str], Row | None]  # by trajectory and phi, of one weight set


def as_directions(weights: Weights, gradient: Weights) -> Float[np.ndarray, "18"]:
    """Convert a gradient in weights to the 18 directions."""
    logs = np.asarray(weights_to_vector(gradient)) * np.asarray(weights_to_vector(weights))
    return directions() @ logs


def slopes(losses: Float[np.ndarray, "*batch 18 2"]) -> Float[np.ndarray, "*batch 18"]:
    """Compute central differences of losses a STEP up and a STEP down."""
    return (losses[..., 0] - losses[..., 1]) / (2.0 * STEP)


def cosine(
    a: Float[np.ndarray, "*batch n"], b: Float[np.ndarray, "*batch n"]
) -> np.ndarray | float:
    """Compute the cosine of the angle between vectors."""
    return np.sum(a * b, axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))


def compare(
    model: Float[np.ndarray, "P 18"],
    command: Float[np.ndarray, "P 18"] | None,
    simulator: Float[np.ndarray, "P 18"],
) -> Row | None:
    """Compare a model's gradients with the simulator's, and with those of the command itself.

    Phases with a number that is not finite are left out in all.

    Args:
        model: through a phi.
        command: through the command itself; None if this is the model.
        simulator: central differences.

    Returns:
        The row, or None if no phase is left.
    """
    base = model if command is None else command
    finite = np.isfinite(model + base + simulator).all(axis=1)
    if not finite.any():
        return None
    model, base, simulator = model[finite], base[finite], simulator[finite]

    def agreement(m: np.ndarray, s: np.ndarray) -> np.ndarray | float:
        return cosine(m.mean(axis=-2), s.mean(axis=-2))

    def gain(m: np.ndarray, b: np.ndarray, s: np.ndarray) -> np.ndarray | float:
        return agreement(m, s) - agreement(b, s)

    cosines, gains = [], []
    for mask in (np.ones(len(direction_names()), bool), BEYOND_SAG):
        m, b, s = model[:, mask], base[:, mask], simulator[:, mask]
        cosines.append(bootstrap(agreement, m, s))
        gains.append(None if command is None else bootstrap(gain, m, b, s))
    means = model.mean(axis=0), simulator.mean(axis=0)
    sizes = float(np.linalg.norm(means[0])), float(np.linalg.norm(means[1]))
    a, b = means[0] / sizes[0], means[1] / sizes[1]
    distances = (a - b) ** 2  # sums to 2 (1 - cosine)
    worst = int(np.argmax(distances))
    return Row(
        *cosines,
        *gains,
        wrong=direction_names()[worst],
        share=float(distances[worst] / max(distances.sum(), 1e-12)),
        entries=(float(a[worst]), float(b[worst])),
        sizes=sizes,
        phases=int(finite.sum()),
    )


def rank_correlation(
    model: Float[np.ndarray, " sets"], simulator: Float[np.ndarray, " sets"]
) -> float:
    """Return Spearman's, over weight sets with a finite loss in both; NaN for fewer than three."""
    finite = np.isfinite(model + simulator)
    if finite.sum() < 3:
        return float("nan")
    result = spearmanr(model[finite], simulator[finite])
    return float(np.asarray(result)[0])


def _text(value: Interval | None) -> str:
    return "" if value is None else value.text("{:.2f}".format)


def gradient_table(rows: Rows) -> str:
    """Return the table of a weight set, by trajectory and phi."""
    head = ("trajectory", "phi", "cosine", "without z, R_Fz", "more than command")
    head += ("more, without z, R_Fz", "most wrong")
    lines = []
    for key, row in rows.items():
        cells = ("no phase to compare", *[""] * 4)
        if row is not None:
            values = (row.cosine, row.beyond_sag, row.gain, row.gain_beyond_sag)
            cells = (*map(_text, values), f"{row.wrong}, {row.share:.0%}")
        lines.append((*key, *cells))
    return markdown_table(head, lines, words=2)


def wrong_sentence(trajectory: str, kind: str, row: Row) -> str:
    """Name the weight with the most wrong gradient, and its error."""
    model, simulator = row.entries
    sign = "too weakly" if abs(model) < abs(simulator) else "too strongly"
    if model * simulator < 0.0:
        sign = "the wrong way"
    return (
        f"{trajectory}, {kind}: the weight that is most wrong is {row.wrong}. It has {model:+.2f} "
        f"of the model's unit gradient and {simulator:+.2f} of the simulator's, pulls {sign} and "
        f"makes {row.share:.0%} of the distance between the two; the model's gradient is "
        f"{row.sizes[0] / row.sizes[1]:.2f} times as long."
    )


def rank_table(ranks: Mapping[tuple[str, str], Mapping[str, float]]) -> str:
    """Return the table of rank correlations, by trajectory and phi, and by factor of the draws."""
    factors = next(iter(ranks.values()), {})
    rows = [(*key, *(f"{value:.3f}" for value in row.values())) for key, row in ranks.items()]
    head = ("trajectory", "phi", *(f"within x/{factor}" for factor in factors))
    return markdown_table(head, rows, words=2)


def summary(rows: Rows, kind: str) -> str:
    """Compare the cosines of the gradients through a phi with those through the command."""
    gains = {t: row for (t, k), row in rows.items() if k == kind and row is not None and row.gain}
    if not gains:
        return f"No comparison of {kind} with the command could be made."
    better = sum(row.gain is not None and row.gain.low > 0.0 for row in gains.values())
    least = min(row.cosine.value for row in gains.values())
    texts = "; ".join(f"{t} {_text(row.gain)}" for t, row in gains.items())
    return (
        f"Cosine with the {kind} less that with the command itself: {texts}. The interval is above "
        f"zero on {better} of {len(gains)}; the least cosine is {least:.2f}."
    )


def as_result(row: Row | None) -> dict[str, Any] | None:
    """Return a row as JSON values."""
    if row is None:
        return None
    return {k: v._asdict() if isinstance(v, Interval) else v for k, v in row._asdict().items()}
