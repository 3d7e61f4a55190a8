# SPDX-License-Identifier: Apache-2.0
"""Viewer of a recording: draws it whole, in a Rerun viewer or into a file."""

from __future__ import annotations

from pathlib import Path

import rerun as rr

from rti_mpc.errors import ConfigError, reason
from rti_mpc.recording import Recording
from rti_mpc_service.view.outlet import new_stream
from rti_mpc_service.view.played import played
from rti_mpc_service.view.recording import Entry
from rti_mpc_service.view.scene import Scene

FLUSH_TIMEOUT_S = 60.0
SEND_NS = 10_000_000_000  # of the robot's time that is sent together: in one frame a viewer takes in chunks for some ms alone, however long it draws


def draw_into_file(recording: Recording, path: Path) -> None:
    """
    Write a recording as a file of Rerun, overwritten.

    Raises:
        ConfigError: The file cannot be written.
    """
    stream = new_stream(path.stem)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
        stream.save(path)
    except (OSError, RuntimeError) as error:
        raise ConfigError(f"rerun-save must be a file that can be written, got {str(path)!r} ({reason(error)})") from error
    draw(recording, stream)


def draw_in_viewer(recording: Recording, name: str, url: str) -> None:
    """Send a recording to a viewer that listens at a URL."""
    stream = new_stream(name)
    stream.connect_grpc(url)
    draw(recording, stream)


def draw(recording: Recording, stream: rr.RecordingStream) -> None:
    """Send a whole recording to a stream, and end the stream."""
    robots = recording.robots
    several = len(robots) > 1
    scene = Scene(stream, robots if several else ())
    for robot in robots:
        waiting = list[Entry]()
        for entries in played(recording, robot, root=robot if several else "", begun_ns=recording.start_ns if several else None):
            waiting += entries
            if waiting and waiting[-1].time_ns - waiting[0].time_ns > SEND_NS:
                scene.send(waiting)
                waiting = []
        scene.send(waiting)
    scene.finish()
    stream.flush(timeout_sec=FLUSH_TIMEOUT_S)
    stream.disconnect()
