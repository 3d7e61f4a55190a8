# SPDX-License-Identifier: Apache-2.0
"""The two enumerations that travel on the wire."""

from __future__ import annotations

from rti_mpc.contract.status import Mode, QpStatus


def test_samples_have_a_plan_of_their_own_while_a_reference_is_followed_or_held() -> None:
    assert [mode for mode in Mode if mode.planned] == [Mode.TRACKING, Mode.HOLDING]


def test_plans_are_commanded_up_to_those_that_reached_the_limit_of_iterations() -> None:
    assert [status for status in QpStatus if status.usable] == [QpStatus.SOLVED, QpStatus.INACCURATE, QpStatus.MAX_ITER]
