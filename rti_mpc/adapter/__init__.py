# SPDX-License-Identifier: Apache-2.0
"""
Adapters: a robot and a planner of one's own on the bus, in a few lines.

`RobotAdapter` sends states and says which inputs to apply: it plays commands by their
time, approaches them inside the slew limits, and comes to rest where none is valid.
`PlannerAdapter` sends references. Neither needs the model, CasADi or a solver.
"""

from rti_mpc.adapter.planner import PlannerAdapter as PlannerAdapter
from rti_mpc.adapter.robot import RobotAdapter as RobotAdapter

__all__ = ["PlannerAdapter", "RobotAdapter"]
