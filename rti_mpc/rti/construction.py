# SPDX-License-Identifier: Apache-2.0
"""
Construction of a problem, shared by all of its `Rti`: functions, built and compiled once, and the numbers that follow from them.

A service with many robots of one kind, or a benchmark with copies of one controller,
gives the same `Ocp` to each `Rti`. Then only the first one builds expressions.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca

from rti_mpc.array import Array
from rti_mpc.codegen import compiled
from rti_mpc.rti.acceleration import relaxation
from rti_mpc.rti.certificate import certificate
from rti_mpc.rti.linearization import plan_cost, shift
from rti_mpc.rti.nominal import check_stiffness, nominal_state
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.places import Places, places
from rti_mpc.rti.qp.sequential import sequential
from rti_mpc.rti.qp.simultaneous import simultaneous
from rti_mpc.rti.qp.transcription import Transcription
from rti_mpc.rti.turns import largest_steps, unsettled

FORMULATIONS = {"simultaneous": simultaneous, "sequential": sequential}


@dataclass(frozen=True, eq=False)
class Construction:
    """
    Functions of a problem in one formulation, and where its model is regular. It holds no reference to the problem.

    Attributes:
        x_nominal: State around which the model is regular, given or found, shape ``(nx,)``.
        transcriptions: The QPs: without softened bounds and, if there are any, with them.
        structured: Functions of the active-set method and its certificate; None for another solver.
        shift: See `rti_mpc.rti.linearization.shift`.
        relaxation: See `rti_mpc.rti.acceleration.relaxation`.
        cost: See `rti_mpc.rti.linearization.plan_cost`.
        output: Outputs at a node, ``(x, p) -> y``.
        steps: See `rti_mpc.rti.turns.largest_steps`.
        unsettled: See `rti_mpc.rti.turns.unsettled`.
        made: The compiled functions by name.
        normalised: Arrays and factor of the cost by name as the first `Rti` has normalised the problem; empty until then.
    """

    x_nominal: Array
    transcriptions: tuple[Transcription, ...]
    structured: tuple[Places, ca.Function] | None
    shift: ca.Function
    relaxation: ca.Function
    cost: ca.Function
    output: ca.Function
    steps: ca.Function
    unsettled: ca.Function
    made: dict[str, ca.Function]
    normalised: dict[str, Any] = field(default_factory=dict)

    def make(self, function: ca.Function) -> ca.Function:
        """Return a function of these, compiled if it is one of those that are."""
        return self.made.get(function.name(), function)


_constructions: WeakKeyDictionary[Ocp, dict[tuple[str, bool, str | None], Construction]] = WeakKeyDictionary()


def construction(ocp: Ocp, formulation: str, *, structured: bool, build: str | None) -> Construction:
    """
    Return the construction of a problem, built at the first call.

    Args:
        ocp: The problem; one that is equal but another object is constructed again.
        formulation: ``"simultaneous"`` or ``"sequential"``.
        structured: Whether to build the functions of the active-set method.
        build: How to compile, see `rti_mpc.codegen.BUILDS`; None: not at all.

    Raises:
        OcpError: The model is singular wherever it was looked at, or stiff.
    """
    known = _constructions.setdefault(ocp, {})
    key = formulation, structured, build
    if key not in known:
        known[key] = construct(ocp, *key)
    return known[key]


def construct(ocp: Ocp, formulation: str, structured: bool, build: str | None) -> Construction:
    """Build the construction of a problem, as `construction`."""
    x_nominal = nominal_state(ocp)
    check_stiffness(ocp, x_nominal)
    transcriptions = tuple(FORMULATIONS[formulation](ocp, softened=softened) for softened in (False, True)[: 2 if ocp.ng else 1])
    active_set = (places(ocp), certificate(ocp)) if structured else None
    moves, relaxed, cost, output, steps = shift(ocp), relaxation(ocp), plan_cost(ocp), ocp.model.h(), largest_steps(ocp)
    turned = unsettled(ocp, output)
    native = [moves, relaxed, cost, output, steps, turned, *natives(transcriptions, active_set)]
    made = dict(zip((f.name() for f in native), compiled(*native, build=build) if build else native, strict=True))
    return Construction(x_nominal, transcriptions, active_set, moves, relaxed, cost, output, steps, turned, made)


def natives(transcriptions: tuple[Transcription, ...], structured: tuple[Places, ca.Function] | None) -> list[ca.Function]:
    """
    Return the functions of a problem's solver that are worth compiling.

    Behind the active set a QP solver is needed so rarely, or has so much time in the slack, that
    its QP is left to CasADi's virtual machine: compiling it would double the build time.
    """
    if structured is not None:
        return [*vars(structured[0]).values(), structured[1]]
    return [function for transcription in transcriptions for function in (transcription.data, transcription.embed, transcription.step)]
