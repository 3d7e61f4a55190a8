# SPDX-License-Identifier: Apache-2.0
"""Scene: one robot, or several in one view, in a Rerun stream."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from itertools import cycle

import rerun as rr

from rti_mpc.wire.info import Info
from rti_mpc_service.view.blueprint import DRIVEN_COLORS, Frame, common_blueprint
from rti_mpc_service.view.recording import Entry, RerunRecording


class Scene:
    """
    Writer of robots into one stream.

    Attributes:
        stream: The stream.
    """

    def __init__(self, stream: rr.RecordingStream, roots: Sequence[str] = ()) -> None:
        """
        Begin a scene.

        Args:
            stream: Stream of Rerun.
            roots: Roots of the robots, their names; none for a single robot, whose entries have no root.
        """
        self.stream = stream
        self._layouts: dict[str, tuple[Info, Frame | None]] = {}
        colored = list(zip(roots, cycle(DRIVEN_COLORS), strict=False))
        self._drawings = {root: RerunRecording(stream, root, self._layout_of(root), color) for root, color in colored} or {"": RerunRecording(stream)}

    def send(self, entries: Iterable[Entry]) -> None:
        """Write entries of any robots of the scene."""
        groups: defaultdict[str, list[Entry]] = defaultdict(list)
        for entry in entries:
            groups[entry.root].append(entry)
        for root, group in groups.items():
            self._drawings[root].send(group)

    def finish(self) -> None:
        """Write what was held back."""
        for drawing in self._drawings.values():
            drawing.finish()

    def _layout_of(self, root: str) -> Callable[[Info, Frame | None], None]:
        def lay_out(info: Info, frame: Frame | None) -> None:
            self._layouts[root] = info, frame
            self.stream.send_blueprint(common_blueprint(self._layouts))

        return lay_out
