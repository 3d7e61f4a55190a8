# SPDX-License-Identifier: Apache-2.0
"""
Recordings of robots in MCAP files: writer, reader, repair, and their data as frames (the extra ``record``).

    >>> from rti_mpc.recording import Recording
    >>> recording = Recording("run.mcap")
    >>> for recorded in recording.messages(streams=("state",)):
    ...     print(recorded.robot, recorded.local_ns, recorded.message.x)
    >>> samples = frame(recording, "telemetry")
"""

from rti_mpc.recording.frames import export as export
from rti_mpc.recording.frames import frame as frame
from rti_mpc.recording.frames import table as table
from rti_mpc.recording.frames import units as units
from rti_mpc.recording.reader import Recorded as Recorded
from rti_mpc.recording.reader import Recording as Recording
