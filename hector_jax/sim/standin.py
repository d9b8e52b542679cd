"""The stand-in for hardware: families of plants, one plant per seed, for verdicts only.

No collection, training or tuning reads this module; tests/test_architecture.py
checks that. The plants differ from the hfs in strength and in kind (masses, ground, an estimator
with noise and drift), so that a map learned on the hfs is not tested on its own simulator. Seeds
0-31 are for development; published verdicts walked others, which their files name.

There are two families. `standin` draws masses of 0.95 to 1.08 times the nominal ones, so most of
its plants are heavier; `even` draws them evenly about the nominal ones, and farther from them.
"""

import numpy as np

from hector_jax.robot.description import HECTOR, Description
from hector_jax.sim.world import Estimator, Imperfections


def standin(seed: int, description: Description = HECTOR) -> Imperfections:
    """Draw the plant of a seed of the first family.

    Args:
        seed: number of the plant.
        description: of the robot, HECTOR by default; its sizes scale joint friction and damping
            and the shift of the trunk's centre of mass.
    """
    return _draw(np.random.default_rng([0x57A, seed]), (0.95, 1.08), description)


def even(seed: int, description: Description = HECTOR) -> Imperfections:
    """Draw the plant of a seed of the second family, its masses evenly about the nominal ones.

    Args:
        seed: number of the plant.
        description: of the robot, as for `standin`.
    """
    return _draw(np.random.default_rng([0xE7E, seed]), (0.85, 1.15), description)


FAMILIES = {"standin": standin, "even": even}
"""Every family by its name."""


def _draw(
    rng: np.random.Generator, mass: tuple[float, float], description: Description
) -> Imperfections:
    """Draw a plant, every number independently and uniformly from its range."""
    sizes = description.plants
    draw = lambda low, high, size=(): np.asarray(rng.uniform(low, high, size))  # noqa: E731
    return Imperfections(
        joint_friction=draw(0.3, 0.7) * sizes.joint_friction,
        joint_damping=draw(0.1, 0.4) * sizes.joint_damping,
        armature=draw(0.9, 1.4),
        backlash=draw(0.005, 0.015),
        delay=draw(0.001, 0.005),
        lag=draw(0.002, 0.006),
        torque_gain=draw(0.9, 1.0, len(description.joints)),
        linkage=draw(0.3, 1.0) * (description.linkage is not None),
        contact_time=draw(0.006, 0.02),
        floor_friction=draw(0.65, 1.0),
        mass=draw(*mass),
        trunk_com=draw(-0.015, 0.015, 3) * sizes.trunk_com,
        estimator=Estimator(
            position=np.asarray(0.003),
            velocity=np.asarray(0.03),
            angle=np.asarray(0.005),
            ang_velocity=np.asarray(0.03),
            joint=np.asarray(0.001),
            drift=np.asarray(0.01),
            drift_yaw=np.asarray(0.01),
        ),
    )
