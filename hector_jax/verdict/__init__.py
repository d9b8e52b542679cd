"""Whether one weight set walks better than another.

`judging` walks the sets on plants and keeps the scores; `metrics` compares them, paired over plants
and scenes, with intervals; `matrix` does so over engines and models of the robot; `stopping` says
when enough plants have walked.
"""
