# SPDX-License-Identifier: Apache-2.0
"""
Entry of every process: robust standard streams, one line for each refusal, and an end within bounded time.

The interpreter is never finalized. Finalization would unwind threads inside native
calls, to which Zenoh responds with SIGABRT, and would drop sessions, which waits
for hung peers. All sessions are closed before; the end only writes buffered output.
"""

from __future__ import annotations

import atexit
import codecs
import errno
import io
import logging
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterable
from contextlib import suppress
from threading import Thread
from typing import Any, NoReturn

from rti_mpc.errors import RtiMpcError, Stopped

EXIT_REFUSED = 2  # bad input, which a restart does not repair
EXIT_FAILED = 1  # every other failure
EXIT_BY_SIGNAL = 128  # plus the signal's number: ended by a signal
END_TIMEOUT_S = 1.0  # for writing buffered output at the end
MAX_LINE_CHARACTERS = 2000  # of an error message
CONTROL_CHARACTER = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
# Modules of optional dependencies, which a robot does not need.
EXTRA_OF_MODULE = {
    **dict.fromkeys(("rerun", "rerun_cli"), "view"),
    **dict.fromkeys(("mcap", "pandas", "pyarrow"), "record"),
    "matplotlib": "figure",
    "cryptography": "certs",
    "optuna": "tune",
}


class OutputError(Exception):
    """Standard output cannot be written; `errno` is the system's."""

    def __init__(self, error: OSError) -> None:
        self.errno = error.errno
        super().__init__(f"standard output must take what is printed, got: {error.strerror}")


class Output(io.FileIO):
    """Standard output whose errors are told apart from those of other files."""

    def write(self, data: Any) -> int | None:  # type: ignore[override]
        """Write bytes; raise `OutputError` if that fails."""
        try:
            return super().write(data)
        except OSError as error:
            raise OutputError(error) from None


def enter(*steps: Callable[[], object]) -> NoReturn:
    """Run the steps of a process and end it: with a step's own exit status, 2 if a step refuses its input, 0 otherwise."""
    open_standard_streams()
    end(status_of(steps))


def open_standard_streams() -> None:
    """
    Make sure that the standard streams are open and accept every character.

    A closed stream would otherwise be None here, and the next file or socket would
    get its number. A character that the terminal lacks is written as `escape` says.
    """
    codecs.register_error("rti_mpc.escape", escape)
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, this one
    for name, descriptor, raw in (("stdout", 1, Output), ("stderr", 2, io.FileIO)):
        encoding = getattr(getattr(sys, name), "encoding", None)
        buffer = io.BufferedWriter(raw(descriptor, "w", closefd=False))
        line_buffering = name == "stderr" or os.isatty(descriptor)
        setattr(sys, name, io.TextIOWrapper(buffer, encoding, "rti_mpc.escape", line_buffering=line_buffering))


def escape(error: UnicodeError) -> tuple[str | bytes, int]:
    """Replace characters that cannot be encoded: undecodable bytes of a path are written unchanged, all others as escapes."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)


def status_of(steps: Iterable[Callable[[], object]]) -> int:
    """Run the steps and return the exit status; print a refusal as one line."""
    try:
        status = 0
        try:
            for step in steps:
                step()
        except SystemExit as asked:
            status = asked.code if isinstance(asked.code, int) else EXIT_FAILED if asked.code else 0
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:  # Ctrl-C before a handler was installed
        return EXIT_BY_SIGNAL + signal.SIGINT
    except Stopped:
        return 0
    except OutputError as error:
        if error.errno == errno.EPIPE:  # the reader of the pipe has closed it
            return EXIT_BY_SIGNAL + signal.SIGPIPE
        say(str(error))
        return EXIT_FAILED
    except RtiMpcError as error:
        say(str(error))
        return EXIT_REFUSED
    except ModuleNotFoundError as error:
        if error.name not in EXTRA_OF_MODULE:
            traceback.print_exc()
            return EXIT_FAILED
        say(f"{error.name} must be installed for this command: pip install 'rti-mpc[{EXTRA_OF_MODULE[error.name]}]'")
        return EXIT_REFUSED
    except Exception:
        with suppress(OSError):
            traceback.print_exc()
        return EXIT_FAILED


def say(text: str) -> None:
    """Print one line to standard error, ignoring failure; control characters are written as escapes."""
    line = CONTROL_CHARACTER.sub(lambda match: ascii(match[0])[1:-1], text[:MAX_LINE_CHARACTERS])
    with suppress(OSError):
        print(f"rti-mpc: {line}", file=sys.stderr, flush=True)


def end(status: int) -> NoReturn:
    """End the process after writing all buffered output, or after `END_TIMEOUT_S` if somebody does not accept it."""
    writing = Thread(target=write_all, daemon=True)
    writing.start()
    writing.join(END_TIMEOUT_S)
    os._exit(status)


def write_all() -> None:
    """Run the exit functions of other modules, then write buffered output."""
    for write in (atexit._run_exitfuncs, logging.shutdown, sys.stdout.flush, sys.stderr.flush):
        with suppress(Exception):
            write()
