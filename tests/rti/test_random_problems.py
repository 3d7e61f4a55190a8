# SPDX-License-Identifier: Apache-2.0
"""Random linear problems in any units, against two oracles: `make problems` for 10,000 of them."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.rti import Rti
from tests.rti.random_problems import Truth, in_units, parameters, problem, random_data, random_structure

SEED = 1
LEAST_SOLVED = 0.9995  # share of the problems
MAX_EXCESS = 1e-5  # of a plan that is SOLVED: cost above the least one, relative
MAX_BROKEN = 1e-6  # by it: dynamics, and bounds on inputs and increments, as a share of their range
MAX_DIFFERENCE = 1e-6  # of the oracles' costs, relative; otherwise the plan is judged by optimality conditions in extended precision, and listed


def test_random_problems_are_solved_and_no_plan_is_wrong(request: pytest.FixtureRequest) -> None:
    structures, sets = request.config.getoption("--structures"), request.config.getoption("--sets")
    seen: Counter[str] = Counter()
    wrong, disputed, unsolved = [], [], []
    for number in range(structures):
        rng = np.random.default_rng([SEED, number])
        structure = random_structure(rng)
        data = random_data(structure, rng)
        rti = Rti(problem(structure, data), iterations=1, compile=False)
        for which in range(sets):
            if which:
                data = random_data(structure, rng)
                rti.retune({name: value for name, value in in_units(structure, data).items() if structure.nh or not name.endswith("h")})
            x0 = data.x0 * structure.unit_x
            rti.reset(x0, data.u_prev * structure.unit_u)
            rti.prepare(data.y_ref * structure.unit_y, np.tile(parameters(structure, data), (structure.N + 1, 1)), shift=False)
            status = rti.feedback(x0)
            seen[status.name] += 1
            if status is not QpStatus.SOLVED:
                unsolved.append(f"{number}, {which} by {type(rti.solver).__name__}: {status.name} after {rti.solver.iterations} iterations")
                continue
            truth, x, u = Truth(structure, data), rti.x / structure.unit_x, rti.u / structure.unit_u
            solutions = truth.solutions()
            costs, cost = truth.costs(solutions), truth.cost(x, u)
            least = min(costs)
            if not max(costs) - least <= MAX_DIFFERENCE * least:
                excess = min(truth.excess(u, found[1]) for found in solutions if found is not None) / cost
                disputed.append((number, which, costs, cost, excess))
            if truth.broken(x, u) > MAX_BROKEN or not cost <= (1.0 + MAX_EXCESS) * least:
                wrong.append((number, which, truth.broken(x, u), cost, costs))
    print(f"\n{structures} structures of {sets} problems: {dict(seen)}")
    print(*unsolved, sep="\n")
    for number, which, costs, cost, excess in disputed:
        proved = "at most" if excess <= MAX_EXCESS else "not proved to be less than"
        print(f"the oracles differ on {number}, {which}: {costs}; the plan costs {cost}, {proved} {excess:.1e} of it above the least")
    assert wrong == []
    assert seen["SOLVED"] >= LEAST_SOLVED * structures * sets
