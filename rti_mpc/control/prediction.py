# SPDX-License-Identifier: Apache-2.0
"""Prediction of the state at which the next command acts."""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled
from rti_mpc.control.sent import Sent
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model


class Prediction:
    """
    Integration of the whole state, speeds as well as pose, over the inputs already sent.

    Attributes:
        x: The state predicted last, shape ``(nx,)``. Overwritten by the next prediction.
        p: Parameters of the prediction, shape ``(np,)``; the model's nominal ones unless set.
        written: The arrays that `predict` writes.
    """

    def __init__(self, model: Model, sent: Sent, *, compile: bool) -> None:
        self.x: Array = np.zeros(model.nx)
        self.p: Array = np.array(model.p_nominal)
        self._sent = sent
        self._span: Array = np.zeros(1)  # s
        self._start: Array = np.zeros(model.nx)
        self._input: Array = np.zeros(model.nu)
        phi = integrator(model)
        integrate = compiled(phi)[0] if compile else phi
        self.written = (self._start, self._input, self._span, self.x)
        self._integrate = bind(integrate, {"x": self._start, "u": self._input, "p": self.p, "dt": self._span}, {"x_next": self.x})

    def predict(self, x: Array, from_ns: int, to_ns: int) -> Array:
        """
        Integrate from one time to another, with one step of the model's integrator per input; `to_ns` may also be a little before `from_ns`.

        Args:
            x: State at `from_ns`, shape ``(nx,)``.
            from_ns: Robot time.
            to_ns: Robot time.
        """
        self.x[:] = x
        for u, span_s in self._sent.spans(from_ns, to_ns):
            self._start[:] = self.x
            self._input[:] = u
            self._span[0] = span_s
            self._integrate()
        return self.x
