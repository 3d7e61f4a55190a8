# SPDX-License-Identifier: Apache-2.0
"""
Standing orders: an operator's stop and changed parameters, which hold across changes of the leader.

A stop reaches every controller, and each obeys (`rti_mpc_service.operator_stop`). A
change of parameters is granted by the leader and published in its description, from
which the standbys take it over.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Condition
from typing import Any

from rti_mpc.contract.message import Notice, Severity
from rti_mpc.control.call import Call
from rti_mpc.control.controller import Controller
from rti_mpc.errors import ConfigError, RtiMpcError
from rti_mpc.rti.rti import Rti
from rti_mpc.wire import info
from rti_mpc.wire.info import Leader
from rti_mpc_service import injection
from rti_mpc_service.controller.params import Params
from rti_mpc_service.operator_stop import STOP_REQUESTS, OperatorStop
from rti_mpc_service.parameter import to_json


class Orders:
    """The standing orders of one controller."""

    def __init__(
        self,
        controller: Controller,
        rti: Rti,
        params: Params,
        lock: Condition,
        stop: OperatorStop,
        leading: Callable[[], bool],
        tell: Callable[[], None],
        photograph: Callable[[], None],
    ) -> None:
        self._rti = rti
        self._controller = controller
        self._params = params
        self._lock = lock
        self._stop = stop
        self._leading = leading
        self._tell = tell  # publishes the description
        self._photograph = photograph  # asks for a snapshot in the journal

    def orders_info(self) -> dict[str, Any]:
        """Return the orders as a part of the controller's description."""
        return {**self._stop.latch_info(), **info.parameters(self._params.version, to_json(self._params.changes))}

    def answer(self, request: dict[str, Any]) -> dict[str, Any] | None:
        """
        Answer a request of an operator; None if another controller has to answer it.

        Raises:
            ConfigError: The request is refused.
        """
        what = request.get("request")
        if what in STOP_REQUESTS:  # also accepted here, from clients that do not know the stop's own key
            return self._stop.answer(request)
        if what not in ("params", "inject", "snapshot"):
            raise ConfigError(f"request must be stop, enable, params, inject or snapshot, got {what!r}")
        if not self._leading():
            return None
        if what == "snapshot":
            self._photograph()
            return {"ok": True, "request": what}
        if what == "inject":
            return self._inject(request)
        answer = self._params.answer(request)
        if "from_seq" in answer:
            text = ", ".join(f"{key} = {self._params.changes[key]}" for key in request["set"])
            self._say("parameters_changed", f"parameters of version {self._params.version}, from command {answer['from_seq']} on: {text}")
        self._tell()
        return {"ok": True, "request": what, **answer}

    def _inject(self, request: dict[str, Any]) -> dict[str, Any]:
        """Let samples fail, and enter that into the journal, since the controller does not know of it."""
        with self._lock:
            answer = injection.answer(self._rti, request)
            if answer["ok"] and (on_call := self._controller.on_call) is not None:
                on_call(Call("inject", (answer["failure"], answer["samples"]), {}))
        return answer

    def adopt(self, leader: Leader) -> None:
        """Take over the parameters in the leader's description."""
        try:
            version = self._params.version
            self._params.adopt(leader.parameters["version"], dict(leader.parameters["changes"]))
            if self._params.version != version:
                self._say("parameters_changed", f"parameters of version {self._params.version}, taken over from the leader")
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, RtiMpcError) as error:
            self._say("leader_not_understood", f"the leader's description must hold latch and parameters, got a fault at {error}", Severity.WARNING)

    def _say(self, code: str, text: str, severity: Severity = Severity.INFO) -> None:
        self._controller.say(Notice(severity, code, text))
