# SPDX-License-Identifier: Apache-2.0
"""Recording of a recorded drive and the same one in closed loop, as two robots on one axis of time."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import rti_mpc
from rti_mpc.array import Array
from rti_mpc.errors import ConfigError
from rti_mpc.recording.reader import STREAM_OF_NAME, Recorded, Recording
from rti_mpc.recording.writer import RecordingWriter
from rti_mpc.wire.cdr import encode
from rti_mpc.wire.keys import Key, Keys
from rti_mpc_service.description import controller_info
from rti_mpc_service.replay.drive import Drive, Passage
from rti_mpc_service.replay.rebuild import Journaled

SUFFIX = "_closed_loop"  # of the name of the robot that was driven in closed loop
COPIED = ("state", "command", "actuation", "telemetry", "event")  # streams of the recorded robot during the drive
CACHED = ("info", "reference", "anchored")  # those of which the last message from before counts, too
Message = tuple[int, str, Key[Any], bytes]  # local time, robot, key and payload


def write_both(out: Path, path: Path, journal: Journaled, recorded: Passage, driven: Drive) -> None:
    """
    Write both drives into one file, overwritten, which `rti-mpc view` draws as two robots.

    Args:
        out: File to write.
        path: The recording.
        journal: The controller.
        recorded: Its drive as it was, of which the recorded messages are copied.
        driven: Its drive in closed loop; its robot is called as the recorded one, with `SUFFIX`.

    Raises:
        OSError: The file cannot be written.
        ConfigError: The file is the recording itself, or this has no state of the robot in this drive, so that nothing says when its messages came.
    """
    if out.exists() and out.samefile(path):
        raise ConfigError(f"--out must be a folder in which {out.name} is not the recording itself, got {out.parent}")
    recording = Recording(path)
    copied = [*recording.messages(journal.robot, (*COPIED, *CACHED))]
    heard = [(each.message.stamp_ns, each.local_ns) for each in copied if each.stream == "state" and each.message.epoch == recorded.states[0].epoch]
    if not heard:
        raise ConfigError(f"--out must have a recording with the states of {journal.robot}, got {path} with its journal alone")
    stamps, locals_ns = (np.array(column, np.float64) for column in zip(*sorted(heard), strict=True))
    begin_ns, end_ns = (float(np.interp(state.stamp_ns, stamps, locals_ns)) for state in (recorded.states[0], recorded.states[-1]))
    messages = [*of_recorded(copied, begin_ns, end_ns), *of_driven(copied, journal, driven, stamps, locals_ns)]
    writer = RecordingWriter(out, round(begin_ns), recording.unix_offset_ns, rti_mpc.__version__)
    for local_ns, robot, key, payload in sorted(messages, key=lambda message: message[0]):
        writer.add(robot, key, local_ns, payload)
    writer.finish({})


def of_recorded(copied: list[Recorded], begin_ns: float, end_ns: float) -> list[Message]:
    """Return what the recorded robot's streams say during the drive."""
    found, last = list[Message](), dict[str, Message]()
    for each in copied:
        key = Keys(each.received.key.partition(f"/{each.robot}/")[0], each.robot).of(STREAM_OF_NAME[each.stream], each.role)
        message = max(each.local_ns, round(begin_ns)), each.robot, key, each.received.payload
        if begin_ns <= each.local_ns <= end_ns:
            found.append(message)
        elif each.stream in CACHED and each.local_ns < begin_ns:
            last[key] = message
    return [*last.values(), *found]


def of_driven(copied: list[Recorded], journal: Journaled, driven: Drive, stamps: Array, locals_ns: Array) -> Iterator[Message]:
    """
    Yield what the streams of the robot in closed loop would have said.

    Args:
        copied: Messages of the recorded robot.
        journal: The controller.
        driven: The drive in closed loop.
        stamps: Stamps of the recorded states, ns of the robot, ascending.
        locals_ns: When they arrived.
    """
    passage, controller = driven.passage, driven.controller
    name = f"{journal.robot}{SUFFIX}"
    prefix = copied[0].received.key.partition(f"/{journal.robot}/")[0]
    keys = Keys(prefix, name)

    def at(stamp_ns: int) -> int:
        return round(float(np.interp(stamp_ns, stamps, locals_ns)))

    begin_ns, epoch = at(passage.states[0].stamp_ns), passage.commands[0].epoch
    about = {"role": "controller", "epoch": epoch, "seq": 1, **controller_info(controller.wanted, controller.np_, controller.scales)}
    yield begin_ns, name, keys.info("controller"), json.dumps(about).encode()
    for seq, (place, reference) in enumerate(passage.references, 1):
        yield at(passage.states[place].stamp_ns), name, keys.anchored, encode(replace(reference, epoch=epoch, seq=seq))
    for state in passage.states:
        yield at(state.stamp_ns), name, keys.state, encode(state)
    for command in passage.commands:
        yield at(command.state_stamp_ns), name, keys.command, encode(command)
    for sample in passage.samples:
        yield at(sample.state_stamp_ns), name, keys.telemetry, encode(sample)
    for event in passage.events:
        yield at(event.stamp_ns), name, keys.event("controller"), encode(event)
