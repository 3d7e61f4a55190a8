# SPDX-License-Identifier: Apache-2.0
"""Outlets of the viewer process: a file or a Rerun viewer, each with its own queue and thread, so that a hung outlet delays no other."""

from __future__ import annotations

import logging
import shutil
import socket
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from urllib.parse import urlsplit

import pyarrow as pa
import rerun as rr

from rti_mpc.contract.message import Notice, Reference, Severity
from rti_mpc.errors import ConfigError, reason
from rti_mpc.wire.info import Info
from rti_mpc.wire.reach import remind
from rti_mpc_service.view.recording import Entry
from rti_mpc_service.view.scene import Scene

RERUN_APPLICATION_ID = "rti_mpc"
MAX_QUEUED_ENTRIES = 8192  # about 50 MB with long horizons
FILE_PERIOD_S = 1.0  # larger chunks make a recording that opens fast
VIEWER_PERIOD_S = 1 / 15
FILE_FLUSH_TIMEOUT_S = 10.0
FILE_CLOSE_TIMEOUT_S = 5.0  # takes milliseconds on a disk that works
VIEWER_FLUSH_TIMEOUT_S = 2.0
VIEWER_CLOSE_TIMEOUT_S = 0.5
PROBE_TIMEOUT_S = 0.2  # of our own attempt to connect: Rerun waits 5 s for a viewer that is not there

log = logging.getLogger(__name__)


class Unavailable(Exception):
    """No viewer is listening now."""


class Outlet:
    """
    Drop-oldest queue in front of one Rerun stream, and the thread that empties it.

    A failed stream is closed and opened again; the new stream first gets the
    present info and reference, then the queued entries.

    Attributes:
        name: Name for the log.
        dropped: Number of entries that the queue had no room for.
        failures: Number of failed streams.
        notices: Faults since the owner last emptied it.
        answered: Whether a stream has ever been open.
        closing: Set once it is being closed.
    """

    def __init__(
        self,
        name: str,
        open_stream: Callable[[], rr.RecordingStream],
        *,
        period_s: float = VIEWER_PERIOD_S,
        flush_s: float = VIEWER_FLUSH_TIMEOUT_S,
        close_s: float = VIEWER_CLOSE_TIMEOUT_S,
        capacity: int = MAX_QUEUED_ENTRIES,
        roots: Sequence[str] = (),
        epitaph: Callable[[], str] = lambda: "closed after a failure, entries not yet written are lost",
    ) -> None:
        self.name = name
        self.dropped = 0
        self.failures = 0
        self.notices: deque[Notice] = deque(maxlen=16)
        self._open_stream = open_stream
        self._period_s = period_s
        self._flush_s = flush_s
        self._close_s = close_s
        self._epitaph = epitaph  # returns the text for a failed stream
        self._queue: deque[Entry] = deque(maxlen=capacity)
        self._context: dict[tuple[str, str], Entry] = {}  # by root and role, which a reference has none of
        self._missed = 0
        self._fault = ""  # the last one that what was received has caused
        self._lock = threading.Lock()
        self._roots = roots
        self._recording: Scene | None = None
        self.answered = False
        self.closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"outlet {name}", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        """Whether a stream is open."""
        return self._recording is not None

    def offer(self, entries: Iterable[Entry]) -> None:
        """Queue entries; a full queue drops its oldest ones. Never waits for the stream."""
        with self._lock:
            missed = self._missed
            for entry in entries:
                if isinstance(entry.message, Info | Reference):
                    self._context[entry.root, entry.message.role if isinstance(entry.message, Info) else ""] = entry
                self._missed += len(self._queue) == self._queue.maxlen
                self._queue.append(entry)
            self.dropped += self._missed - missed

    def close(self) -> bool:
        """Write the queued entries and end the stream within a bounded time; return whether no entry was lost."""
        self.closing.set()
        self._thread.join(min(self._close_s, VIEWER_CLOSE_TIMEOUT_S) if self.failures else self._close_s)
        return not (self._thread.is_alive() or self._queue or self.dropped or self.failures)

    def _run(self) -> None:
        while not self.closing.wait(self._period_s):
            self._pump()
        self._pump(last=True)
        if self._recording is not None:
            self._recording.stream.disconnect()

    def _pump(self, *, last: bool = False) -> None:
        """Send the queued entries, through a new stream if the last one failed; with the last ones also what was held back."""
        try:
            new = self._recording is None
            if self._recording is None:
                self._recording = Scene(self._open_stream(), self._roots)
                self.answered = True
                log.info("%s: open", self.name)
            self._recording.send(self._take(new))
            if last:
                self._recording.finish()
            self._recording.stream.flush(timeout_sec=self._flush_s)
        except Unavailable:
            return
        except RuntimeError as error:
            self._fail(str(error))
        except Exception as error:  # by an entry that cannot be drawn; said once, since each stream begins with the same context
            fault = f"{type(error).__name__}: {error}"
            self._fail(fault if fault != self._fault else "")
            self._fault = fault

    def _take(self, new: bool) -> list[Entry]:
        """Empty the queue; return its entries, after the context if the stream is new or entries were dropped."""
        with self._lock:
            entries, missed = list(self._queue), self._missed
            self._queue.clear()
            self._missed = 0
            queued = {id(entry) for entry in entries}
            context = [entry for entry in self._context.values() if id(entry) not in queued] if new or missed else []
        if missed:
            self._note("outlet_slow", f"too slow, {missed} entries dropped")
        return context + entries

    def _fail(self, why: str) -> None:
        """Count a failed stream and close it; without a reason nothing is said."""
        self.failures += 1
        if why:
            self._note("outlet_failed", f"{self._epitaph()}: {why}")
        self._give_up()

    def _note(self, code: str, text: str) -> None:
        self.notices.append(Notice(Severity.ERROR, code, f"{self.name}: {text}"))

    def _give_up(self) -> None:
        """Close a failed stream; this waits while its receiver hangs, when no other connection would succeed either."""
        recording, self._recording = self._recording, None
        if recording is not None:
            recording.stream.disconnect()


def file_outlet(path: Path, name: str, roots: Sequence[str] = ()) -> Outlet:
    """
    Return an outlet that overwrites a file. If the recording fails, for example on a full disk, it ends there.

    Raises:
        ConfigError: The file cannot be written.
    """
    stream = new_stream(name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
        stream.save(path, write_footer=False)  # a footer would make Rerun keep data of every chunk in memory until the end
    except (OSError, RuntimeError) as error:
        raise ConfigError(f"rerun-save must be a file that can be written, got {str(path)!r} ({reason(error)})") from error
    once = iter([stream])

    def open_stream() -> rr.RecordingStream:
        for stream in once:
            return stream
        raise Unavailable

    def epitaph() -> str:
        return f"the recording ends here, with {1e-6 * shutil.disk_usage(path.parent).free:.1f} MB free on its disk"

    return Outlet(
        str(path),
        open_stream,
        period_s=FILE_PERIOD_S,
        flush_s=FILE_FLUSH_TIMEOUT_S,
        close_s=FILE_CLOSE_TIMEOUT_S,
        roots=roots,
        epitaph=epitaph,
    )


def viewer_outlet(url: str, name: str, roots: Sequence[str] = ()) -> Outlet:
    """Return an outlet to the viewer at a URL, which connects whenever a viewer listens there, and says so until the first one does."""
    address = urlsplit(url)
    where = (address.hostname or "127.0.0.1", address.port or 9876)
    recording_id = uuid.uuid4()  # the same for each connection, so that a viewer that only hung continues its recording

    def open_stream() -> rr.RecordingStream:
        try:
            socket.create_connection(where, PROBE_TIMEOUT_S).close()
        except OSError as error:
            raise Unavailable from error
        stream = new_stream(name, recording_id)
        stream.connect_grpc(url)
        return stream

    outlet = Outlet(url, open_stream, roots=roots)
    remind(log.warning, lambda: "" if outlet.answered else f"no viewer answers yet at {url}", outlet.closing)
    return outlet


def load_arrow() -> None:
    """Make the first array of Arrow, which imports pandas where it is installed: seconds, that a recording's end must not be the first to spend."""
    pa.array([])


def new_stream(name: str, recording_id: uuid.UUID | None = None) -> rr.RecordingStream:
    """Return a stream that is not connected yet, named for viewers."""
    rr.unregister_shutdown()  # Rerun's exit function would wait without limit for a hung viewer; `Outlet.close` is bounded
    stream = rr.RecordingStream(RERUN_APPLICATION_ID, recording_id=recording_id)
    stream.send_recording_name(name)
    return stream
