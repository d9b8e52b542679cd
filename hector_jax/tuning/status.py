"""Status of an iteration and reason of the end of a tuning."""

from enum import IntEnum

from hector_jax.tuning.evaluate import Evaluation


class StepStatus(IntEnum):
    """Acceptance of an iteration, or the reason of its rejection."""

    ACCEPTED = 0
    NOT_FINITE = 1
    FELL = 2
    UNSOLVED = 3  # a QP of the rollout
    NO_GAIN = 4  # less than a hundredth of the predicted gain


class Stop(IntEnum):
    """Reason of the end of a tuning."""

    GOING = 0
    LIMIT = 1  # all iterations are done
    SMALL_STEP = 2  # too short to gain: the loss is rougher than its gain, or all is refused
    NO_GAIN = 3  # too little is predicted
    BAD_START = 4  # the start was rejected


REASONS = {
    StepStatus.NOT_FINITE: "loss or gradient not finite",
    StepStatus.FELL: "the robot fell",
    StepStatus.UNSOLVED: "QP residual",
    StepStatus.NO_GAIN: "the loss did not fall as predicted",
}
"""Beginning of the reason of each rejection."""


def status_text(status: StepStatus, evaluation: Evaluation) -> str:
    """Describe why an iteration was rejected; empty if it was accepted."""
    residual = f" {float(evaluation.residual):.1e} too large"
    return REASONS.get(status, "") + (residual if status == StepStatus.UNSOLVED else "")


def status_of(reason: str) -> StepStatus:
    """Return the status of an iteration from its reason, such as that of a file."""
    statuses = (status for status, text in REASONS.items() if reason.startswith(text))
    return next(statuses, StepStatus.NOT_FINITE if reason else StepStatus.ACCEPTED)
