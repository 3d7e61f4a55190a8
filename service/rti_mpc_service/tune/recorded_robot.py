# SPDX-License-Identifier: Apache-2.0
"""Robot in a recording: its states, the longest time over which it followed references without a break, and the commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from struct import Struct
from typing import TYPE_CHECKING, NamedTuple

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, State, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.errors import ConfigError, MessageError, reason
from rti_mpc.model.model import Model
from rti_mpc.model.path_following import window_place
from rti_mpc.wire.cdr import HEADER_BYTES

if TYPE_CHECKING:
    from rti_mpc.recording.reader import Recorded

FOLLOWING = (Mode.TRACKING, Mode.HOLDING, Mode.FALLBACK)  # modes whose samples follow a reference; a fallback is followed over
MAX_GAP_PERIODS = 2.5  # between two samples of one span
TOLD_MESSAGES = 5000  # each
STAMP, STAMP_BYTES = Struct("<q"), HEADER_BYTES + 16  # of any message, after its epoch and its number


class Followed(NamedTuple):
    """What a study needs of the telemetry of a sample; see there."""

    epoch: int
    stamp_ns: int
    state_stamp_ns: int
    mode: Mode
    y_ref: Array


@dataclass(frozen=True)
class RecordedRobot:
    """
    A robot in a recording.

    Attributes:
        name: The recording.
        nu: Number of inputs.
        begin_ns: Stamp of the first sample of all.
        states: In order.
        span: Samples of one controller that follow a reference, the longest run without a gap.
        commands: Not decoded yet, since a long recording has more than are needed. Of the guard that the robot obeyed, if there was one.
    """

    name: str
    nu: int
    begin_ns: int
    states: Sequence[State]
    span: Sequence[Followed]
    commands: Sequence[Recorded]

    def part(self, part: tuple[float, float], dt_s: float, duration_s: float | None) -> Sequence[Followed]:
        """Return a part of the span, from and to fractions of it, and of that at most the first `duration_s`."""
        begin, end = (round(fraction * len(self.span)) for fraction in part)
        return self.span[begin : end if duration_s is None else min(end, begin + round(duration_s / dt_s))]

    def commands_between(self, begin_ns: int, end_ns: int) -> list[Command]:
        """
        Return the commands with a stamp in an interval.

        Raises:
            ConfigError: One of them is none.
        """
        try:
            decoded = [each.message for each in self.commands if begin_ns <= stamp_of(each.received.payload) <= end_ns]
        except MessageError as error:
            raise ConfigError(f"{self.name} must be a recording: {error}") from error
        return [command for command in decoded if len(command.u) and command.u.shape[1] == self.nu]


def stamp_of(payload: bytes) -> int:
    """Return the stamp of an encoded message, in ns; 0 where it is too short for one."""
    return int(STAMP.unpack_from(payload, STAMP_BYTES)[0]) if len(payload) >= STAMP_BYTES + STAMP.size else 0


def read(name: str, robot: str, model: Model, dt_s: float, tell: Callable[[str], object] = lambda _: None) -> RecordedRobot:
    """
    Read a recording, once.

    Args:
        name: A file ``.mcap``, or the folder of its segments.
        robot: Name of the robot in it.
        model: Its model.
        dt_s: Period of its controller.
        tell: Told from time to time how far it is.

    Raises:
        ConfigError: It is no recording of this robot.
    """
    from rti_mpc_service.opened import opened  # needs the extra `record`

    if window_place(model) is not None:
        raise ConfigError(f"--scenario {name} must be of a robot that follows references in time, {robot} follows a path")
    states: list[State] = []
    samples: list[Followed] = []
    sent: dict[str, list[Recorded]] = {"command": [], "actuation": []}
    try:
        recording = opened(Path(name))
        if robot not in recording.robots:
            raise ConfigError(f"{name} must hold the robot {robot}, got {', '.join(recording.robots) or 'none'}")
        for count, each in enumerate(recording.messages(robot, ("state", "telemetry", *sent))):
            if count % TOLD_MESSAGES == 0:
                tell(f"{count} messages")
            if each.stream in sent:
                sent[each.stream].append(each)
            elif isinstance(message := each.message, State) and len(message.x) == model.nx:
                states.append(message)
            elif isinstance(message, Telemetry) and message.x0.size == model.nx and message.y_ref.shape[-1] == model.ny:
                samples.append(Followed(message.epoch, message.stamp_ns, message.state_stamp_ns, message.mode, message.y_ref))
    except (OSError, MessageError) as error:
        raise ConfigError(f"{name} must be a recording that can be read: {reason(error)}") from error
    if not states or not samples:
        raise ConfigError(f"{name} must hold states of {model.nx} and telemetry of {model.ny} outputs of {robot}, as its file says, got none")
    return RecordedRobot(name, model.nu, samples[0].stamp_ns, states, longest(samples, dt_s), sent["actuation"] or sent["command"])


def longest(samples: Sequence[Followed], dt_s: float) -> list[Followed]:
    """Return the longest run of samples of one controller that follow a reference, in order, without a gap."""
    best: list[Followed] = []
    span: list[Followed] = []
    for sample in samples:
        last = span[-1] if span else None
        joined = last is not None and sample.epoch == last.epoch and 0 < sample.stamp_ns - last.stamp_ns <= 1e9 * MAX_GAP_PERIODS * dt_s
        if sample.mode not in FOLLOWING or not len(sample.y_ref):
            span = []
        elif joined:
            span.append(sample)
        else:
            span = [sample]
        best = span if len(span) > len(best) else best
    return best
