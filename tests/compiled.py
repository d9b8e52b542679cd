"""What tests of the exported C controller share."""

import numpy as np
import pytest
from model import OTHERS, ROBOT

from hector_jax.control.controller import WalkConfig
from hector_jax.control.weights import expert
from hector_jax.export import check
from hector_jax.export.source import controller_source

CONFIG = WalkConfig()
WARNINGS = "-Wall -Wextra -Wconversion -Werror -Wframe-larger-than=16000".split()

# with numbers of the plan and of the legs
TUNED = CONFIG.with_others(
    expert()._replace(others={"footstep_width": np.array(0.1), "foot_height": np.array(0.11)}),
    OTHERS,
)


def needs_cc():
    if check.compiler() is None:
        pytest.skip("there is no C compiler")


def source_of(weights, config=CONFIG, robot=ROBOT):
    return controller_source(config, robot, weights, name="test", content=b"")


def assert_same(found):
    assert max(found.force, found.moment, found.torque) <= 1e-8
    assert found.unsolved == 0
