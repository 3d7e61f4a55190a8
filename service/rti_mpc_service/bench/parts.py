# SPDX-License-Identifier: Apache-2.0
"""Parts of a step: timing of its native calls."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter_ns
from typing import Any

from rti_mpc.array import Array
from rti_mpc.rti.qp.qpsolvers import ForeignSolver
from rti_mpc.rti.rti import Rti

PARTS = ("copies in", "evaluation", "matrix update", "vector update", "iterations", "certificate")


class Parts:
    """
    Replaces the native calls of a controller by timed ones, on request.

    Attributes:
        timed: Whether the calls are timed now.
    """

    def __init__(self, rti: Rti) -> None:
        self.timed = False
        self._times: dict[str, int] = {}
        self._swaps: list[tuple[Any, str, Any, Any]] = []  # object, attribute, original call, timed call
        for name in ("y_ref", "p", "u_prev", "x0"):
            array = getattr(rti, name)
            self._swaps.append((rti, name, array, Memory(array, self._timing("copies in", array.__setitem__))))
        self._watch(rti, "evaluation", "advance", "evaluate")
        if (active_set := getattr(rti, "active_set", None)) is not None:
            self._watch(active_set, "evaluation", "linearize", "advance")
            self._watch(active_set, "matrix update", "gain")
            self._watch(active_set, "iterations", "roll_out")
            self._watch(active_set, "certificate", "certify", "refine")
        for solver in rti.solvers:
            self._watch(solver.qp, "evaluation", "linearize", "embed", "step")
            if isinstance(solver, ForeignSolver):
                self._watch(solver, "iterations", "call")
                continue
            workspace = solver.workspace
            calls = {"update_data_mat": "matrix update", "update_data_vec": "vector update", "solve": "iterations"}
            proxy = Workspace(workspace, {name: self._timing(part, getattr(workspace, name)) for name, part in calls.items()})
            self._swaps.append((solver, "workspace", workspace, proxy))

    def _watch(self, owner: Any, part: str, *names: str) -> None:
        """Add calls of an object to one timed part."""
        self._swaps += [(owner, name, getattr(owner, name), self._timing(part, getattr(owner, name))) for name in names]

    def _timing(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return a call that adds its time to a part."""

        def timing(*args: Any, **kwargs: Any) -> Any:
            began = perf_counter_ns()
            result = call(*args, **kwargs)
            self._times[part] += perf_counter_ns() - began
            return result

        return timing

    @contextmanager
    def maybe(self, timed: bool) -> Iterator[dict[str, float]]:
        """Time the parts of the code in the context, if `timed`; the yielded dictionary is filled at its end, in us."""
        times_us: dict[str, float] = {}
        self.timed = timed
        if timed:
            self._times = dict.fromkeys(PARTS, 0)
            self._swap(3)
        yield times_us
        if timed:
            self._swap(2)
            times_us.update((part, 1e-3 * time) for part, time in self._times.items())

    def _swap(self, which: int) -> None:
        """Set the original calls (2) or the timed calls (3)."""
        for swap in self._swaps:
            setattr(swap[0], swap[1], swap[which])


class Memory:
    """Array of the controller that times copies into it."""

    def __init__(self, array: Array, write: Callable[[Any, Any], None]) -> None:
        self._array = array
        self._write = write

    def __setitem__(self, where: Any, values: Any) -> None:
        self._write(where, values)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._array, name)


class Workspace:
    """OSQP's workspace with some calls replaced; it takes no attributes itself."""

    def __init__(self, workspace: Any, calls: dict[str, Callable[..., Any]]) -> None:
        self._workspace = workspace
        self.__dict__.update(calls)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._workspace, name)
