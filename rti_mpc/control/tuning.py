# SPDX-License-Identifier: Apache-2.0
"""
Change of weights and bounds while the controller runs, without a jump of the inputs.

Weights change from one sample to the next, since the bounds limit the inputs anyway. If
the present input is outside a new bound, the bound moves there as fast as the slew
limits allow, so that every plan can keep it. The first increment keeps both the old
slew limits and the new ones.
"""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.control.envelope import INPUT_BOUNDS, Envelope
from rti_mpc.errors import OcpError
from rti_mpc.rti.ocp import WEIGHTS_AND_BOUNDS, Ocp, rest_fault
from rti_mpc.rti.rti import Rti

COMPILED_FIELDS = ("N", "N_u", "blocks", "dt", "method")  # attributes of the Ocp that are compiled in


class Tuning:
    """
    Weights and bounds of an `Rti`, wanted and acting.

    Attributes:
        version: Version of the weights and bounds that act; 0 for those that the `Rti` was built with.
        wanted: Problem with the wanted weights and bounds.
    """

    def __init__(self, rti: Rti, envelope: Envelope | None = None) -> None:
        """
        Begin with the weights and bounds that an `Rti` was built with.

        Args:
            rti: Real-time iteration to be tuned.
            envelope: Envelope that takes the acting bounds of inputs, too.
        """
        self.version = 0
        self._rti = rti
        self._envelope = envelope
        self._changed = rti.ocp.lbu.ndim == 2  # bounds that differ from stage to stage may have to yield at any sample
        self.wanted = rti.ocp
        self._wanted_version = 0
        self._slew = rti.ocp.lbdu, rti.ocp.ubdu  # of this sample
        self._acting = {name: getattr(rti.ocp, name) for name in INPUT_BOUNDS}
        self._written = 0  # version of the weights that act

    def change(self, ocp: Ocp, version: int) -> None:
        """
        Tune to the weights and bounds of an OCP, from the next `begin` on.

        Raises:
            OcpError: Something else differs, such as which bounds are finite, or the bounds exclude the input at rest.
        """
        built = self._rti.ocp
        for name in COMPILED_FIELDS:
            if getattr(ocp, name) != getattr(built, name):
                raise OcpError(f"{name} must stay {getattr(built, name)}, got {getattr(ocp, name)}: it is part of the compiled code")
        for name in WEIGHTS_AND_BOUNDS:
            built.check_compiled(name, getattr(ocp, name))
        if wrong := rest_fault(ocp):
            raise OcpError(wrong)
        self.wanted, self._wanted_version = ocp, version
        self._changed = True

    def begin(self) -> None:
        """Begin the preparation of the next sample."""
        lbdu, ubdu = self.wanted.lbdu, self.wanted.ubdu
        if self.version != self._wanted_version:
            self.version = self._wanted_version
            lbdu, ubdu = np.maximum(lbdu, self._acting["lbdu"]), np.minimum(ubdu, self._acting["ubdu"])
        self._slew = lbdu, ubdu

    def follow(self, u_prev: Array) -> None:
        """
        Move the acting weights and bounds towards the wanted ones as far as the input allows; called before each preparation.

        Args:
            u_prev: Input before the plan, shape ``(nu,)``.
        """
        if not self._changed:
            return
        wanted, (lbdu, ubdu) = self.wanted, self._slew
        lbu, ubu = reachable(wanted.lbu, wanted.ubu, lbdu, ubdu, u_prev)
        bounds = dict(zip(INPUT_BOUNDS, (lbu, ubu, lbdu, ubdu), strict=True))
        fresh = self.version != self._written
        if fresh or any(bound is not self._acting[name] and not np.array_equal(bound, self._acting[name]) for name, bound in bounds.items()):
            self._rti.retune({**{name: getattr(wanted, name) for name in WEIGHTS_AND_BOUNDS if fresh}, **bounds})
            if self._envelope is not None:
                self._envelope.take("lbu", lbu)
                self._envelope.take("ubu", ubu)
        self._acting, self._written = bounds, self.version


def reachable(lbu: Array, ubu: Array, lbdu: Array, ubdu: Array, u_prev: Array) -> tuple[Array, Array]:
    """
    Return the bounds of inputs, moved where the inputs cannot be inside yet, so that every plan can keep them.

    Args:
        lbu: Lower bounds, shape ``(nu,)``, or ``(N_u, nu)`` where they differ from block to block.
        ubu: Upper bounds, likewise.
        lbdu: Lower bounds of the increments, shape ``(nu,)`` or ``(N_u, nu)``.
        ubdu: Upper bounds of the increments.
        u_prev: Input before the plan, shape ``(nu,)``.
    """
    least, most = u_prev + (lbdu if lbdu.ndim == 1 else lbdu[0]), u_prev + (ubdu if ubdu.ndim == 1 else ubdu[0])
    if lbu.ndim == 1:
        return np.minimum(lbu, most), np.maximum(ubu, least)
    if (lbu[0] <= most).all() and (ubu[0] >= least).all():
        return lbu, ubu  # those of the next blocks can be reached from there, as `Ocp` demands
    falling, rising = np.broadcast_to(lbdu, lbu.shape), np.broadcast_to(ubdu, ubu.shape)
    lower, upper = lbu.copy(), ubu.copy()
    for k in range(len(lower)):
        if k:
            least, most = least + falling[k], most + rising[k]
        lower[k], upper[k] = np.minimum(lower[k], most), np.maximum(upper[k], least)
        least, most = np.maximum(least, lower[k]), np.minimum(most, upper[k])
    return lower, upper
