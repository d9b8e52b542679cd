"""Does the model's gradient point where the better simulator's does? The pure part of the report.

All gradients are those of L in the logarithms of 18 weights: each of Q, and each of R, which the
two feet share. Rows of a matrix are start phases. Two gradients are compared by the cosine between
their means over phases; intervals redraw the phases, the same ones for model and simulator. With a
handful of phases such an interval is narrow rather than wide, and it tells nothing of other
commands.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import spearmanr

from hector_jax.control.weights import DIRECTION_NAMES as NAMES
from hector_jax.control.weights import Weights, directions, moved, weights_to_vector
from hector_jax.report.report import markdown_table
from hector_jax.runs.metrics import Interval, bootstrap

SAG = ("Q_z", "Q_vz", "R_Fz")
"""What a rigid body that sinks, or a robot that floats, pulls at."""

BEYOND_SAG = np.array([name not in SAG for name in NAMES])
STEP = float(np.log(1.05))  # of the central differences, in log-weights


class Row(NamedTuple):
    """One phi against the simulator, at one weight set and trajectory."""

    cosine: Interval
    beyond_sag: Interval  # cosine without the directions of SAG
    gain: Interval | None  # cosine less that of the command itself; None for the command
    gain_beyond_sag: Interval | None
    wrong: str  # the weight whose entry differs most between the unit gradients
    share: float  # of the squared distance between the unit gradients, that it makes
    entries: tuple[float, float]  # of that weight, in the unit gradients of model and simulator
    sizes: tuple[float, float]  # norms of the mean gradients of model and simulator
    phases: int  # in which all that is compared could be believed


def as_directions(weights: Weights, gradient: Weights) -> Float[np.ndarray, "18"]:
    """A gradient in weights as one in the 18 directions."""
    logs = np.asarray(weights_to_vector(gradient)) * np.asarray(weights_to_vector(weights))
    return directions() @ logs


def disturbed(weights: Weights, factor: float, count: int) -> list[Weights]:
    """Weight sets drawn log-uniformly within x/factor, the same ones every time."""
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(NAMES)))
    return [moved(weights, np.log(factor) * row) for row in draws]


def slopes(losses: Float[np.ndarray, "P 18 2"]) -> Float[np.ndarray, "P 18"]:
    """Central differences of losses a STEP up and a STEP down."""
    return (losses[..., 0] - losses[..., 1]) / (2.0 * STEP)


def cosine(
    a: Float[np.ndarray, "*batch n"], b: Float[np.ndarray, "*batch n"]
) -> np.ndarray | float:
    """Of the angle between vectors."""
    return np.sum(a * b, axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))


def over_phases(
    statistic: Callable[..., np.ndarray | float], *gradients: Float[np.ndarray, "P n"]
) -> Interval:
    """A statistic of mean gradients, with its percentile interval when the phases are redrawn."""
    return bootstrap(lambda *drawn: statistic(*(g.mean(axis=-2) for g in drawn)), *gradients)


def compare(
    model: Float[np.ndarray, "P 18"],
    command: Float[np.ndarray, "P 18"] | None,
    simulator: Float[np.ndarray, "P 18"],
) -> Row | None:
    """A model's gradients against the simulator's, and against those of the command itself.

    Phases with a number that is not finite are left out for all.

    Args:
        model: through a phi.
        command: through the command itself; None where the model is that.
        simulator: central differences.

    Returns:
        The row, or None where no phase is left.
    """
    base = model if command is None else command
    kept = np.isfinite(model + base + simulator).all(axis=1)
    if not kept.any():
        return None
    model, base, simulator = model[kept], base[kept], simulator[kept]

    def gain(model: np.ndarray, base: np.ndarray, simulator: np.ndarray) -> np.ndarray | float:
        return cosine(model, simulator) - cosine(base, simulator)

    def told(chosen: Bool[np.ndarray, "18"]) -> tuple[Interval, Interval | None]:
        m, b, s = model[:, chosen], base[:, chosen], simulator[:, chosen]
        both = over_phases(cosine, m, s)
        return both, None if command is None else over_phases(gain, m, b, s)

    (whole, more), (rest, more_rest) = told(np.ones(len(NAMES), bool)), told(BEYOND_SAG)
    means = model.mean(axis=0), simulator.mean(axis=0)
    sizes = tuple(float(np.linalg.norm(mean)) for mean in means)
    a, b = (mean / size for mean, size in zip(means, sizes, strict=True))
    apart = (a - b) ** 2  # sums to 2 (1 - cosine)
    worst = int(np.argmax(apart))
    return Row(
        cosine=whole,
        beyond_sag=rest,
        gain=more,
        gain_beyond_sag=more_rest,
        wrong=NAMES[worst],
        share=float(apart[worst] / max(apart.sum(), 1e-12)),
        entries=(float(a[worst]), float(b[worst])),
        sizes=sizes,
        phases=int(kept.sum()),
    )


def rank_correlation(
    model: Float[np.ndarray, " sets"], simulator: Float[np.ndarray, " sets"]
) -> float:
    """Spearman's, over the weight sets with a finite loss in both; NaN for fewer than three."""
    kept = np.isfinite(model + simulator)
    if kept.sum() < 3:
        return float("nan")
    return float(spearmanr(model[kept], simulator[kept]).statistic)


def _told(value: Interval | None) -> str:
    return "" if value is None else value.text("{:.2f}".format)


def gradient_table(rows: Mapping[tuple[str, str], Row | None]) -> str:
    """The rows of one weight set, by trajectory and phi."""
    head = ("trajectory", "phi", "cosine", "without z, R_Fz", "more than command")
    head += ("more, without z, R_Fz", "most wrong")
    lines = []
    for (trajectory, kind), row in rows.items():
        if row is None:
            lines.append((trajectory, kind, "no phase to compare", "", "", "", ""))
            continue
        cells = (row.cosine, row.beyond_sag, row.gain, row.gain_beyond_sag)
        lines.append((trajectory, kind, *map(_told, cells), f"{row.wrong}, {row.share:.0%}"))
    return markdown_table(head, lines, words=2)


def wrong_sentence(trajectory: str, kind: str, row: Row) -> str:
    """Which weight's gradient is wrong, and by how much."""
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
    """Rank correlations by trajectory and phi, and by how far the weights were disturbed."""
    factors = next(iter(ranks.values()), {})
    rows = [(*key, *(f"{value:.3f}" for value in row.values())) for key, row in ranks.items()]
    head = ("trajectory", "phi", *(f"within x/{factor}" for factor in factors))
    return markdown_table(head, rows, words=2)


def verdict(rows: Mapping[tuple[str, str], Row | None], kind: str) -> str:
    """Whether a phi makes the gradients of one weight set point better than the command does."""
    found = {t: row for (t, k), row in rows.items() if k == kind and row is not None and row.gain}
    if not found:
        return f"No comparison of {kind} with the command could be made."
    better = sum(row.gain is not None and row.gain.low > 0.0 for row in found.values())
    least = min(row.cosine.value for row in found.values())
    each = "; ".join(f"{t} {_told(row.gain)}" for t, row in found.items())
    return (
        f"Cosine with the {kind} less that with the command itself: {each}. The interval is above "
        f"zero on {better} of {len(found)}; the least cosine is {least:.2f} (asked for: 0.7)."
    )


def as_result(row: Row | None) -> dict[str, Any] | None:
    """A row as names and values."""
    if row is None:
        return None
    return {k: v._asdict() if isinstance(v, Interval) else v for k, v in row._asdict().items()}
