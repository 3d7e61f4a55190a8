# SPDX-License-Identifier: Apache-2.0
"""
Recordings of robots in MCAP files: writer, reader and repair (the extra ``record``).

    >>> from rti_mpc.recording import Recording
    >>> recording = Recording("run.mcap")
    >>> for recorded in recording.messages(streams=("state",)):
    ...     print(recorded.robot, recorded.local_ns, recorded.message.x)
"""

from rti_mpc.recording.reader import Recorded as Recorded
from rti_mpc.recording.reader import Recording as Recording
