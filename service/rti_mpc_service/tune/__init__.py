# SPDX-License-Identifier: Apache-2.0
"""
Tuning of weights by Optuna: `rti-mpc tune`.

`varied` says which keys of the robot's file change, and in which range. `closed_loop` drives
a scenario in lockstep with such values; `recorded` makes one of a recording, which `recorded_robot`
has read, with the robot that `identified` finds in its `windows` by `prediction`; `workers` drives in several processes. `study` lets
Optuna propose values until there are enough trials, `choice` picks one from the Pareto front
of error and effort, and a scenario that the study has not seen decides whether it is better.
`edit` writes it into a copy of the file, `figure` shows what was found.
"""
