# SPDX-License-Identifier: Apache-2.0
"""
End of every command: the way to rest that acts after its plan, and that a stop commands.

A robot that its inputs at rest do not stop is given one with each command
(`rti_mpc.rti.way_to_rest`). After a plan it begins in the state and with the input
predicted for the plan's end. A stop begins one where the robot is, and each following
command follows it from where the robot has come to, so that what pushes the robot aside
does not carry it away; where it is another disturbance that is estimated now, a new way
begins. Its first rows are the plan, the others follow it in the command.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled
from rti_mpc.contract.schedule import BEFORE_ALL_NS
from rti_mpc.control.prediction import Prediction
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import depends_on
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.way_to_rest import StopLaw, WayToRest

MAX_PREDICTION_NS = 1_000_000_000  # that a state is predicted ahead; a robot that was not heard for longer is taken to be on its way
CHANGED_SHARE = 0.05  # share of its largest magnitude by which a disturbance must have changed for the robot to rest elsewhere
NEARER_SHARE = 0.7  # of its distance from the plan's end, within which another rest is aimed at
ESTIMATION_NS = 1_000_000_000  # time that the estimate of a changed disturbance needs to settle
REST_SHARE = 0.01  # share of its range in operation within which a state or an input is at rest

Ending = Mapping[str, Any]  # the fields of a command that hold its way to rest, by their names


class Stopping:
    """
    Ways to rest of one robot.

    Attributes:
        duration_ns: How long a way to rest is; `period_ns`, each of its rows.
        feeds_back: Whether the ways carry a gain, by which whoever plays them corrects them with every state.
        at_rest: Whether the last stop commands a robot that has come to rest.
        rows: All rows of the last plan or way to rest, shape ``(N, nu)``, of which its command has the first ones.
    """

    def __init__(self, ocp: Ocp, law: StopLaw, limits: Mapping[str, Array], prediction: Prediction, valid_ns: int, *, compile: bool) -> None:
        """
        Begin with no way.

        Args:
            ocp: The controller's problem.
            law: What the ways are made with.
            limits: Bounds and slew limits of the inputs by name, owned by the caller, obeyed as they are.
            prediction: What predicts the states in which plans and stops begin.
            valid_ns: How long a command is valid, robot time.
            compile: Whether to machine code.
        """
        nx, nu = ocp.model.nx, ocp.model.nu
        self._law, self._prediction = law, prediction
        self._dt_ns, self.period_ns = round(1e9 * ocp.dt), round(1e9 * law.period_s)
        self._valid_ns, self._limits = valid_ns, limits
        self._way = WayToRest(ocp, law, limits, p=prediction.p, compile=compile)
        self.duration_ns = law.rows * self.period_ns
        self.at_rest = False
        self.rows: Array = np.zeros((ocp.N, nu))
        self.feeds_back = not law.holds
        self._aimed = False  # whether the equilibrium aimed at is near where plans lead
        self._began_ns: int | None = None  # when the way that is followed began; None while none is
        self._x, self._next, self._u, self._span = np.zeros(nx), np.zeros(nx), np.zeros(nu), np.zeros(1)
        phi = integrator(ocp.model)
        step = {"x": self._x, "u": self._u, "p": prediction.p, "dt": self._span}
        self._step = bind(compiled(phi)[0] if compile else phi, step, {"x_next": self._next})
        self._u_rest: Array = np.array(ocp.model.u_rest)
        self._felt = [j for j in range(nx) if depends_on(ocp.model.rate_expr, ocp.model.x[j])]
        self._ended: Ending = {}  # the last way that a plan ended with
        self._d = prediction.p[ocp.model.np_ - len(law.disturbances) :]  # what disturbs the robot now
        self._d_known: Array = np.array(self._d)  # the same when it last became another one
        self._known_ns = BEFORE_ALL_NS  # when its estimate has come to it

    def forget(self) -> None:
        """Forget where the robot was: after a gap, or in another life of it."""
        self._aimed, self._began_ns, self.at_rest, self._known_ns = False, None, False, BEFORE_ALL_NS

    def prepare(self) -> None:
        """
        Aim at where the last way leads, or at the rest near the plan's end if that is clearly nearer; off the path from state to command.

        A boat that turns with its path would otherwise turn all the way back to the heading in which it was to rest first.
        """
        way = self._way
        if not self._aimed:
            return
        if self._law.disturbances.size and self._began_ns is None:
            ahead = self._away(way.x[-1])
            found = way.aim(self._x, self._u_rest) and way.aim(way.x_e, way.u_e)  # from afar, one aim may not lead to a rest yet
            if found and self._away(way.x_e) < NEARER_SHARE * ahead:
                return
        self._aimed = way.aim(way.x[-1], way.u[-1])

    def _away(self, x_e: Array) -> float:
        """Return how far a rest is from the plan's end, relative to ranges in operation, in the states that the dynamics depend on."""
        return float(np.abs((x_e - self._x) / self._law.scale_x)[self._felt].max())

    def after(self, rows: Array, act_ns: int, valid_until_ns: int) -> tuple[Array, Ending]:
        """
        Return the rows of a plan that act, shape ``(n, nu)``, and the way to rest after them.

        Args:
            rows: The plan, shape ``(N, nu)``; it begins in the state predicted last.
            act_ns: When it begins to act, robot time.
            valid_until_ns: When it ends.
        """
        self.rows = rows
        count = min(max(1, -(-(valid_until_ns - act_ns) // self._dt_ns)), len(rows))
        rows = rows[:count]
        last_ns = min(valid_until_ns - act_ns - (count - 1) * self._dt_ns, self._dt_ns)
        self._x[:] = self._prediction.x
        for k, row in enumerate(rows):
            self._u[:], self._span[0] = row, 1e-9 * (self._dt_ns if k < count - 1 else last_ns)
            self._step()
            self._x[:] = self._next
        acted = rows[-2:] if last_ns < self._dt_ns else rows[-1:]  # less than a period before the way begins
        falling, rising = self._limits["lbdu"], self._limits["ubdu"]
        lowest, highest = acted.max(axis=0) + falling, acted.min(axis=0) + rising
        reach = np.array([lowest, lowest + falling]), np.array([highest, highest + rising])
        begun = (self._aimed and self._way.begin(self._x, rows[-1], reach)) or self._way.find(self._x, rows[-1], reach)
        self._aimed, self._began_ns, self.at_rest = begun, None, False
        if begun:
            self._ended = self._ending(0)
        return rows, self._ended

    def stop(self, x: Array, state_ns: int, act_ns: int, u_prev: Array, reach: tuple[Array, Array]) -> tuple[Array, int, Ending]:
        """
        Return rows that bring the robot to rest, shape ``(n, nu)``, for how long they are valid, in ns, their period and the way to rest after them.

        Args:
            x: Last state, shape ``(nx,)``.
            state_ns: Its time, robot time.
            act_ns: When the first row acts, robot time.
            u_prev: Input that acts before it, shape ``(nu,)``.
            reach: Lowest and highest first two rows, each of shape ``(2, nu)``.
        """
        way = self._way
        x0 = self._prediction.predict(x, state_ns, act_ns) if act_ns - state_ns <= MAX_PREDICTION_NS else x
        if np.any(np.abs(self._d - self._d_known) > CHANGED_SHARE * self._law.disturbances):
            self._d_known[:], self._known_ns = self._d, act_ns + ESTIMATION_NS
        if self._began_ns is not None and act_ns <= self._known_ns:
            self._began_ns, self._aimed = None, way.aim(way.x[-1], way.u[-1])
        if self._began_ns is None:
            if (self._aimed and way.begin(x0, u_prev, reach)) or way.find(x0, u_prev, reach):
                self._began_ns = act_ns
        else:
            elapsed = max(0, round((act_ns - self._began_ns) / self.period_ns))
            if act_ns - state_ns > MAX_PREDICTION_NS:
                x0 = way.planned(elapsed)
            way.follow(x0, u_prev, elapsed, reach)
        if not way.finite:
            way.hold(u_prev, reach)
            self.forget()
        self._aimed = False
        law = self._law
        still_to_move = (way.x[0] - way.x[-1]) / law.scale_x, (way.u[0] - way.u[-1]) / law.scale_u
        self.at_rest = bool(max(np.abs(part).max() for part in still_to_move) <= REST_SHARE)
        row = min(max(1, self._valid_ns // self.period_ns), len(way.u) - 1)
        self.rows = way.u[np.minimum(np.arange(len(self.rows)), len(way.u) - 1)]
        return way.u[:row].copy(), min(row * self.period_ns, self._valid_ns), {**self._ending(row), "period_ns": self.period_ns}

    def _ending(self, row: int) -> Ending:
        """Return the fields of a command from a row of the way on."""
        way = self._way
        ending = {"rest_period_ns": self.period_ns, "u_rest": way.u[row:].copy()}
        return {**ending, "x_rest": way.x[row:].copy(), "K": way.K.copy()} if self.feeds_back else ending
