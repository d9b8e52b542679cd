"""DiffTune: weights that minimise a loss of rollouts on the rigid body, by its derivatives.

`rollout` walks a `Scenario` (`parallel_rollout` all ticks at once), `loss` has the terms,
`evaluate` loss and gradient, `curvature` the Gauss-Newton matrix, `step_rules` the steps,
`difftune` the loop of one tuning and `batch` that of many; `variation` draws models, `grounded`
fits one to a walk, `live` steps once from the last seconds of one.
"""
