# SPDX-License-Identifier: Apache-2.0
"""Coverage of a replay: commands that were heard, and that no entry repeats, are told."""

from __future__ import annotations

from rti_mpc_service.replay.coverage import told, uncovered

HEARD = {(1, seq): seq * 100_000_000 for seq in range(1, 10)}


def test_commands_that_were_heard_and_not_compared_are_told_with_their_times() -> None:
    left = uncovered(HEARD, {(1, seq) for seq in range(4, 9)})
    assert left == [100_000_000, 200_000_000, 300_000_000, 900_000_000]
    assert list(told(left)) == ["not covered: 4 commands that were heard, from 0.100 s to 0.900 s"]
    assert list(told(left[-1:])) == ["not covered: the command that was heard at 0.900 s"]
    assert not list(told([]))


def test_commands_of_a_start_that_was_left_out_on_purpose_are_not_told() -> None:
    assert uncovered(HEARD, {(1, seq) for seq in range(4, 9)}, from_the_first=True) == [900_000_000]
