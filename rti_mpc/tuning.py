# SPDX-License-Identifier: Apache-2.0
"""
Other weights and bounds for a controller that runs, without a bump.

Weights change from one sample to the next: what the QP may do with an input
is bounded all the same. A bound that an input is beyond is approached as fast
as the slew limits allow: until then it stays just so far out that some plan
keeps it. The first increment keeps the old slew limits and the new ones.
"""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.errors import OcpError
from rti_mpc.linearization import WEIGHTS
from rti_mpc.ocp import Ocp
from rti_mpc.rti import Rti

BOUNDS = ("lbu", "ubu", "lbdu", "ubdu")
STRUCTURE = ("N", "N_u", "dt", "method")
PRESENCE = (*BOUNDS, "lbx", "ubx", "lh", "uh")


class Tuning:
    """
    What an `Rti` is to be tuned to.

    Attributes:
        version: Of the weights and bounds that act; 0 for those it was built with.
    """

    def __init__(self, rti: Rti) -> None:
        self.version = 0
        self._rti = rti
        self._wanted = rti.ocp
        self._wanted_version = 0
        self._bounds = {name: getattr(rti.ocp, name) for name in BOUNDS}  # that act

    def change(self, ocp: Ocp, version: int) -> None:
        """
        Tune to the weights and bounds of an OCP, from the next `follow` on.

        Raises:
            OcpError: Something else of it differs, such as which bounds there are.
        """
        built = self._rti.ocp
        for name in STRUCTURE:
            if getattr(ocp, name) != getattr(built, name):
                raise OcpError(f"{name} must stay {getattr(built, name)}, got {getattr(ocp, name)}: it is compiled in")
        for name in PRESENCE:
            if not np.array_equal(np.isfinite(getattr(ocp, name)), np.isfinite(getattr(built, name))):
                raise OcpError(f"{name} must be finite where it was built so, and only there, got {getattr(ocp, name)}: it is compiled in")
        self._wanted, self._wanted_version = ocp, version

    def follow(self, u_prev: Array) -> None:
        """
        Take the next step there; before a preparation.

        Args:
            u_prev: Input before the plan that is to be prepared, shape ``(nu,)``.
        """
        if not self._wanted_version:
            return
        u, wanted, acting = self._rti.u, self._wanted, self._bounds
        fresh = self.version != self._wanted_version
        lbdu, ubdu = wanted.lbdu, wanted.ubdu
        if fresh:
            lbdu, ubdu = np.maximum(lbdu, acting["lbdu"]), np.minimum(ubdu, acting["ubdu"])
        # What the last plan holds is counted too: after samples that are missed, any of its rows may be the previous input.
        lbu = np.minimum(wanted.lbu, np.minimum(u_prev, u.min(axis=0)) + ubdu)
        ubu = np.maximum(wanted.ubu, np.maximum(u_prev, u.max(axis=0)) + lbdu)
        bounds = dict(zip(BOUNDS, (lbu, ubu, lbdu, ubdu), strict=True))
        if fresh or any(not np.array_equal(bounds[name], acting[name]) for name in BOUNDS):
            self._rti.retune({**{name: getattr(wanted, name) for name in WEIGHTS if fresh}, **bounds})
            np.clip(u, lbu, ubu, out=u)  # a fallback plays these rows
        self._bounds, self.version = bounds, self._wanted_version
