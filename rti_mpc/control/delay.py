# SPDX-License-Identifier: Apache-2.0
r"""
The delay from a state to the time at which its command acts, measured from how the robot responds.

With each candidate delay :math:`d_j` every command that was sent would have begun to
act at its stamp, or :math:`d_j` after the state that it answers if that is later. The
step from one state to the next is predicted with each candidate, and the squared
errors are summed with exponential forgetting,

.. math::

    J_j \leftarrow \gamma J_j + \sum_i \left( \frac{x_i - \phi(x^-, u(\cdot; d_j))_i}{\sigma_i} \right)^2,

with :math:`\sigma_i^2` the mean squared error of state `i` under the best candidate
of each step, from noise and from errors of the model. Where the inputs do not change, all
candidates have the same error: such a step is not informative, and nothing is forgotten.
The estimate is the minimum of a parabola through the best candidate and its neighbours.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled
from rti_mpc.contract.message import Command
from rti_mpc.contract.schedule import end_ns
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model

CANDIDATES_PER_PERIOD = 4
FORGETTING_FACTOR = 0.98  # gamma, applied at each informative step: about the last fifty of them count
MIN_ERROR_SPREAD = 0.1  # a step is informative if the normalised squared errors of the candidates differ by more than this
MIN_COST_ADVANTAGE = 20.0  # another candidate is taken if its cost J is lower by this much: noise alone would have to be 4.5 sigma
MAX_STATE_ERROR = 1e6  # relative to the scale of the state: a prediction error this large is not used
CONFIRMED_REPORTS = 10  # after this many confirmed reports in a row the estimate is kept as a good one
MIN_STATE_DEVIATION = 1e-4  # lower limit of sigma_i, relative to the scale of the state: smaller errors do not tell candidates apart


class DelayEstimator:
    """
    Comparison of candidate delays over recent commands and states.

    Attributes:
        delay_ns: The estimate, ns.
        p: Parameters of the model, shape ``(np,)``; nominal unless written.
    """

    def __init__(self, model: Model, dt_ns: int, most_ns: int, *, scale: Array, measured: Sequence[int] | None = None, compile: bool) -> None:
        """
        Begin with no delay.

        Args:
            model: The model to predict with.
            dt_ns: Period of the commands.
            most_ns: Largest delay.
            scale: Scale of each state, see `rti_mpc.rti.scale`, shape ``(nx,)``: what its errors are relative to.
            measured: Indices of the states by which candidates are compared; None: all.
            compile: Whether to compile the integrator.
        """
        self.delay_ns = 0
        self._measured = list(range(model.nx) if measured is None else measured)
        self._scale: Array = scale[self._measured]
        self._dt_ns = dt_ns
        self._candidates = [round(j * dt_ns / CANDIDATES_PER_PERIOD) for j in range(CANDIDATES_PER_PERIOD * most_ns // dt_ns + 1)]  # ns
        self._costs: Array = np.zeros(len(self._candidates))
        self._variance: Array = np.zeros(len(self._measured))
        self._u_rest: Array = np.array(model.u_rest)
        self._commands: deque[Command] = deque(maxlen=5 + most_ns // dt_ns)
        self._last: tuple[Array, int] | None = None  # state and its stamp
        self._kept: tuple[Array, Array, int] | None = None  # costs, variances and estimate while commands acted as believed
        self._interrupted = False  # whether they do not any more
        self._x: Array = np.zeros(model.nx)
        self._next: Array = np.zeros(model.nx)
        self._u: Array = np.zeros(model.nu)
        self._span: Array = np.zeros(1)  # s
        phi = integrator(model)
        integrate = compiled(phi)[0] if compile else phi
        self.p: Array = np.array(model.p_nominal)
        inputs = {"x": self._x, "u": self._u, "p": self.p, "dt": self._span}
        self._integrate = bind(integrate, inputs, {"x_next": self._next})

    def sent(self, command: Command) -> None:
        """Remember the last command that was sent, if it is a new one."""
        if not self._commands or self._commands[-1] is not command:
            self._commands.append(command)

    def clear(self) -> None:
        """Forget states and commands, for another life of the robot; the estimate is kept."""
        self._commands.clear()
        self._last = None

    def learn(self, x: Array, stamp_ns: int, command: Command | None, confirmed: int) -> int:
        """
        Learn from one sample, and return the estimate, ns.

        Args:
            x: Its state, as `observe` takes it.
            stamp_ns: Stamp of that state.
            command: The last command that acts, None if there is none.
            confirmed: As `restore_if_lost` takes it.
        """
        self.restore_if_lost(confirmed)
        self.observe(x, stamp_ns)
        if command is not None:
            self.sent(command)
        return self.delay_ns

    def restore_if_lost(self, confirmed: int) -> None:
        """
        Restore the last good estimate after commands were lost: what was learnt meanwhile is wrong.

        Args:
            confirmed: Consecutive reports of the robot that have named the expected command; 0 where it does not report.
        """
        if confirmed >= CONFIRMED_REPORTS:
            self._kept = self._costs.copy(), self._variance.copy(), self.delay_ns
        elif self._kept is None:
            return
        elif not confirmed:
            self._interrupted = True
        elif self._interrupted:
            self._costs[:], self._variance[:], self.delay_ns = self._kept
            self._kept, self._interrupted = None, False
            self.clear()

    def observe(self, x: Array, stamp_ns: int) -> None:
        """
        Improve the estimate with a state.

        Args:
            x: State, shape ``(nx,)``, each angle within half a turn of the last state's. What is measured must be as it was measured: an estimate
                was predicted with the delay that is believed, and would confirm it.
            stamp_ns: Its stamp.
        """
        last, self._last = self._last, (x.copy(), stamp_ns)
        if last is None or not 0 < stamp_ns - last[1] <= 2 * self._dt_ns:
            return
        errors = self._errors(*last, x, stamp_ns)
        squared = np.where(np.abs(errors) < MAX_STATE_ERROR, errors, np.nan) ** 2
        played = np.flatnonzero(np.isfinite(squared.sum(axis=1)))
        if not len(played):
            return
        squared = np.where(
            np.isfinite(squared), squared, squared[played].max(axis=0)
        )  # with this delay the robot would have had to brake, so it cannot be the delay
        self._variance += (1.0 - FORGETTING_FACTOR if self._variance.any() else 1.0) * (squared.min(axis=0) - self._variance)
        step = (squared / np.maximum(self._variance, MIN_STATE_DEVIATION**2)).sum(axis=1)
        if np.ptp(step) <= MIN_ERROR_SPREAD:
            return
        self._costs *= FORGETTING_FACTOR
        self._costs += step
        self._estimate()

    def _errors(self, x: Array, from_ns: int, x_next: Array, to_ns: int) -> Array:
        """Return the relative errors of the candidates over one step, shape ``(candidates, measured)``; NaN where no plan would have acted."""
        known: dict[tuple[int, ...], Array] = {}
        errors = []
        for delay_ns in self._candidates:
            starts = tuple(max(command.stamp_ns, command.state_stamp_ns + delay_ns) for command in self._commands)
            if starts not in known:
                known[starts] = x_next - self._x if self._play(starts, x, from_ns, to_ns) else np.full_like(x, np.nan)
            errors.append(known[starts])
        return np.array(errors)[:, self._measured] / self._scale

    def _play(self, starts: tuple[int, ...], x: Array, t_ns: int, to_ns: int) -> bool:
        """Predict with commands that begin to act at these times; return whether one of them acted all the time."""
        self._x[:] = x
        while t_ns < to_ns:
            newest = next((i for i in range(len(starts) - 1, -1, -1) if starts[i] <= t_ns), -1)
            until_ns = min((to_ns, *starts[newest + 1 :]))
            if newest >= 0:
                command = self._commands[newest]
                if t_ns >= end_ns(command):
                    return False
                row = (t_ns - command.stamp_ns) // command.period_ns
                until_ns = min(until_ns, command.stamp_ns + (row + 1) * command.period_ns, end_ns(command))
                self._u[:] = command.u[row]
            elif len(starts) == self._commands.maxlen:
                return False
            else:
                self._u[:] = self._u_rest  # the first of them are still on their way
            self._span[0] = 1e-9 * (until_ns - t_ns)
            self._integrate()
            self._x[:] = self._next
            t_ns = until_ns
        return True

    def _estimate(self) -> None:
        """Move to the best candidate, if it is better by enough."""
        costs, step_ns = self._costs, self._dt_ns / CANDIDATES_PER_PERIOD
        best, now = int(costs.argmin()), min(round(self.delay_ns / step_ns), len(costs) - 1)
        if best != now and costs[now] - costs[best] < MIN_COST_ADVANTAGE:
            return
        offset = 0.0
        if 0 < best < len(costs) - 1:
            before, least, after = costs[best - 1 : best + 2]
            if (bend := before - 2.0 * least + after) > 0.0:
                offset = 0.5 * (before - after) / bend
        self.delay_ns = round(step_ns * (best + offset))
