"""Did the clock of a walk run evenly and at the walk's pace, and were its plans in time?

The stamps are of one clock: `time` (T,) at the end of each sample, `plan.time` (P,) when a plan
began and `plan.ready` (P,) when it was there [s]. The period of a log is the robot's own time.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter

from hector_jax.core.inputs import InputError, plural
from hector_jax.core.trajectory import Trajectory

# Quartz clocks differ by 1e-4; stamps of whole milliseconds give a pace to 1e-3. Beyond 5 % it is
# not a clock that is wrong, but which clock it is.
DRIFT, OTHER_CLOCK = 2e-3, 0.05  # of a pace from 1
WINDOW, BLOCK = 0.02, 0.5  # [s] in which stamps are compared with their like; for a pace
# A loaded computer wakes up some ms too late now and then; a fifth of a plan in one of twenty
# samples is another delay of the feedback each time.
UNEVEN, MOST_UNEVEN = 0.2, 0.05  # of a plan interval off an even clock; share of the samples
MOST_EQUAL = 0.01  # share of the samples with the stamp of the one before
MOST_LATE, OTHER_RATE = 0.02, 0.1  # share of plans that are late or left out; of their interval
STAMPS = "time", "plan.time", "plan.ready"  # entries of a log
UNITS = {"ms": 1e3, "us": 1e6, "ns": 1e9}


class Stamps(NamedTuple):
    """Stamps of a log [s], from any origin; None: not logged."""

    time: Float[np.ndarray, " n"] | None = None  # of the samples
    plan: Float[np.ndarray, " plans"] | None = None
    ready: Float[np.ndarray, " plans"] | None = None


def read_stamps(path: Path, entries: Mapping[str, np.ndarray], count: int) -> Stamps:
    """Return the stamps among the entries of a log of `count` samples.

    Raises:
        InputError: one line: they are no finite numbers, or of another number.
    """
    plans = len(np.atleast_1d(entries.get("plan.time", entries.get("plan.ready", 0))))
    found, origin = {}, None
    for name, length in zip(STAMPS, (count, plans, plans), strict=True):
        if (x := entries.get(name)) is None:
            continue
        if x.shape != (length,) or x.dtype.kind not in "iuf" or not np.isfinite(x).all():
            text = f"must be {length} finite numbers, got {x.dtype} of shape {x.shape}"
            raise InputError(f"{path}: {name} {text}")
        origin = x[0] if origin is None and len(x) else origin
        found[name] = np.asarray(x - origin, float)  # whole ns since 1970 are no exact floats
    return Stamps(*map(found.get, STAMPS))


def timing_faults(stamps: Stamps, walk: Trajectory, interval: float) -> Iterator[str]:
    """Yield a line for each fault of the stamps.

    Args:
        stamps: of the samples of the walk, and of all plans.
        walk: the samples (numpy).
        interval: expected between plans [s].
    """
    if stamps.time is not None:
        pace = _pace(stamps.time, float(walk.period), WINDOW)
        for unit, factor in UNITS.items():
            if abs(pace / factor - 1.0) < OTHER_CLOCK:
                yield f"time is in {unit}: expected is s"
                return
        lines, pace = _clock(stamps.time, float(walk.period), interval)
        yield from lines
        if abs(pace - 1.0) > OTHER_CLOCK:
            yield _other_pace(pace, walk)
            return  # the times of plans mean nothing
        if abs(pace - 1.0) > DRIFT:
            gains = f"{'gains' if pace > 1.0 else 'loses'} {1e3 * abs(pace - 1.0):.1f} ms"
            yield f"the clock of time {gains} in a second of the samples"
    if stamps.plan is not None and len(stamps.plan) > 2:
        yield from _plans(stamps, stamps.plan, interval)


def _pace(time: np.ndarray, period: float, span: float) -> float:
    """Return how fast a clock runs, the median over spans [s]."""
    count = max(min(round(span / period), len(time) // 2), 1)
    return float(np.median(time[count:] - time[:-count])) / (count * period)


def _clock(time: np.ndarray, period: float, interval: float) -> tuple[list[str], float]:
    """Return a line for each way in which a clock is uneven, and its pace without its gaps."""
    lines, apart, width = [], np.diff(time), max(round(WINDOW / period), 5)
    if back := int(np.sum(apart < 0.0)):
        was = "is" if back == 1 else "are"
        lines.append(f"{plural(back, 'stamp')} of time {was} before that of the sample before")
    if (equal := np.mean(apart == 0.0)) > MOST_EQUAL:
        lines.append(f"{100 * equal:.0f} % of the stamps of time are that of the sample before")
    step = _pace(time, period, 5.0 * WINDOW) * period
    even = median_filter(off := time - step * np.arange(len(time)), 2 * width + 1, mode="nearest")
    noise = np.abs(off - even)
    if (share := np.mean(noise > UNEVEN * interval)) > MOST_UNEVEN:
        worst = 1e3 * np.quantile(noise, 0.95)
        text = f"{100 * share:.0f} % of the stamps of time jitter"
        lines.append(f"{text}, {worst:.1f} ms off an even clock")
    rows = np.arange(len(apart))
    later = even[np.minimum(rows + width, len(apart))] - even[np.maximum(rows - width, 0)]
    excess = apart - step  # of a gap it stays; what was only stamped late is made up for
    gap = (excess > np.maximum(0.75 * step, 4.0 * np.median(noise))) & (later > 0.5 * excess)
    lost = np.where(gap, excess, 0.0)
    if lost.sum() > interval and np.mean(gap) > MOST_UNEVEN:
        text = f"in {100 * np.mean(gap):.0f} % of the samples time runs faster than else"
        lines.append(f"{text}: the simulator is slower there")
    elif lost.sum() > interval:
        longest = f"the longest of {1e3 * lost.max():.0f} ms"
        lines.append(f"{1e3 * lost.sum():.0f} ms of samples are missing, by time, {longest}")
    return lines, _pace(time - np.append(0.0, np.cumsum(lost)), period, BLOCK)


def _other_pace(pace: float, walk: Trajectory) -> str:
    """Return whose fault a pace is: by the velocities, period or the clock tells the robot's."""
    period, velocity = float(walk.period), walk.state.velocity[1:]
    moved = np.sum(np.diff(walk.state.position, axis=0) * velocity)
    robot = moved / max(period * np.sum(velocity**2), 1e-12)
    if abs(robot - pace) < abs(robot - 1.0):
        step = f"{1e3 * period * pace:.3g} ms apart by time and velocity"
        return f"the samples are {step}, period says {1e3 * period:.3g} ms"
    return (
        f"time advances {pace:.2f} s in a second of the walk: the real-time factor of its "
        f"simulator is {1 / pace:.2f}"
    )


def _plans(stamps: Stamps, plan: np.ndarray, interval: float) -> Iterator[str]:
    time, ready, apart = stamps.time, stamps.ready, np.diff(plan)
    if (apart <= 0.0).any():
        yield "stamps of plan.time do not increase"
        return
    if time is not None and not (plan[0] < time[-1] and time[0] < plan[-1]):
        yield f"plan.time is of another clock than time, {abs(plan[0] - time[0]):.3g} s away"
    every = float(np.median(apart))
    if abs(every / interval - 1.0) > OTHER_RATE:
        yield f"a plan begins every {1e3 * every:.3g} ms, expected are {1e3 * interval:.3g} ms"
    if (share := np.mean(apart > 1.5 * every)) > MOST_LATE:
        yield f"after {100 * share:.0f} % of the plans the next one is left out, by plan.time"
    if ready is None:
        return
    took = ready - plan
    if (took < 0.0).any():
        yield "stamps of plan.ready are before those of plan.time"
    elif (share := np.mean(late := took > interval)) > MOST_LATE:
        by = 1e3 * (np.median(took[late]) - interval)
        allowed = f"{by:.1f} ms after the {1e3 * interval:.3g} ms that it has"
        yield f"{100 * share:.0f} % of the plans are late: the usual one is ready {allowed}"
