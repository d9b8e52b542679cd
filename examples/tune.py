"""Tune the weights of HECTOR's MPC in Python, on the rigid body, and walk with them in MuJoCo."""

import numpy as np

import hector_jax as hj

hj.setup_jax()  # 64 bits, and a cache of compiled programs
robot, command, start = hj.load_robot(), hj.named_command("straight"), hj.nominal()
config = hj.TuneConfig(rollout=hj.RolloutConfig(ticks=200), iterations=5)  # walks of 2 s
ground = hj.last_command  # the ground gives what the MPC wishes; or hj.as_effect(net) of a run
scenario = hj.Scenario(robot, command, hj.standing_anchor(robot), ground)
tuning = hj.tune(config, scenario, start)
print(f"{tuning.reason}; loss by step:", *(f"{x.evaluation.loss:.3g}" for x in tuning.iterations))

for name, weights in {"plain": start, "tuned": tuning.weights}.items():
    job = hj.Job(weights, command, hj.hfs(), seconds=2.0)
    walk = hj.walk(hj.walk_config(robot), robot, job)
    off = np.linalg.norm((walk.state.position - walk.reference.position)[:, :2], axis=1)
    pitch = np.degrees(walk.state.euler - walk.reference.euler)[:, 1]
    rms = 100 * np.sqrt(np.mean(off**2)), np.sqrt(np.mean(pitch**2))
    print(f"{name}: {rms[0]:.1f} cm off, {rms[1]:.1f} degrees in pitch, fell: {walk.fallen.any()}")
