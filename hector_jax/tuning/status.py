"""Why an iteration was rejected and why a tuning ended."""

from enum import IntEnum

from hector_jax.tuning.evaluate import Evaluation


class StepStatus(IntEnum):
    """Whether an iteration was accepted, or why it was rejected."""

    ACCEPTED = 0
    NOT_FINITE = 1
    FELL = 2
    UNSOLVED = 3  # a QP of the rollout
    ROSE = 4  # the loss, after the paper's ten iterations


class Stop(IntEnum):
    """Why a tuning ended."""

    GOING = 0
    LIMIT = 1  # of iterations
    SMALL_STEP = 2
    NO_GAIN = 3
    BAD_START = 4  # refused


REASONS = {
    StepStatus.NOT_FINITE: "loss or gradient not finite",
    StepStatus.FELL: "the robot fell",
    StepStatus.UNSOLVED: "QP residual",
    StepStatus.ROSE: "the loss rose",
}
"""How the reasons of rejections begin."""


def status_text(status: StepStatus, evaluation: Evaluation) -> str:
    """Why an iteration was rejected; empty for one that was accepted."""
    residual = f" {float(evaluation.residual):.1e} too large"
    return REASONS.get(status, "") + (residual if status == StepStatus.UNSOLVED else "")


def status_of(reason: str) -> StepStatus:
    """Status of an iteration of which only the reason is there, such as from a file."""
    statuses = (status for status, text in REASONS.items() if reason.startswith(text))
    return next(statuses, StepStatus.NOT_FINITE if reason else StepStatus.ACCEPTED)
