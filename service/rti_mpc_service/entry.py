# SPDX-License-Identifier: Apache-2.0
"""
The frame around every process: standard streams that take anything, one line for what is refused, and a bounded end.

The interpreter is never finalized. It would unwind every thread that is inside a
native call, and Zenoh answers that with SIGABRT; and it would drop sessions whose
links are closed for as long as a hung peer lingers. Whatever has to be closed has
been closed by then: the end only writes what still waits to be written.
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
EXTRA_OF_MODULE = {"rerun": "view", "rerun_cli": "view", "matplotlib": "figure"}  # optional dependencies, which a robot does not need


class OutputError(Exception):
    """Standard output does not take what is printed; `errno` is the system's."""

    def __init__(self, error: OSError) -> None:
        self.errno = error.errno
        super().__init__(f"standard output must take what is printed, got: {error.strerror}")


class Output(io.FileIO):
    """Standard output whose failure cannot be taken for any other file's."""

    def write(self, data: Any) -> int | None:  # type: ignore[override]
        """Write bytes; `OutputError` if they are not taken."""
        try:
            return super().write(data)
        except OSError as error:
            raise OutputError(error) from None


def enter(*steps: Callable[[], object]) -> NoReturn:
    """Run the steps of a process and end it: with the status that one exits with, 2 for what one refuses, 0 otherwise."""
    open_standard_streams()
    end(status_of(steps))


def open_standard_streams() -> None:
    """
    Make sure that standard streams are there, and take every character.

    A closed one would otherwise be None here, and its number the next file's or
    socket's. A character that the terminal lacks is written as `escape` says.
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
    """Write the bytes of a path as they are, whatever they mean, and other characters that cannot be written as escapes."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)


def status_of(steps: Iterable[Callable[[], object]]) -> int:
    """Run the steps and return the exit status; say in one line what was refused."""
    try:
        status = 0
        try:
            for step in steps:
                step()
        except SystemExit as asked:
            status = asked.code if isinstance(asked.code, int) else EXIT_FAILED if asked.code else 0
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:  # before it could be answered
        return EXIT_BY_SIGNAL + signal.SIGINT
    except Stopped:
        return 0
    except OutputError as error:
        if error.errno == errno.EPIPE:  # whoever reads has read enough
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
    """Print one line to standard error, if anybody takes it; characters that steer a terminal are written as escapes."""
    line = CONTROL_CHARACTER.sub(lambda match: ascii(match[0])[1:-1], text[:MAX_LINE_CHARACTERS])
    with suppress(OSError):
        print(f"rti-mpc: {line}", file=sys.stderr, flush=True)


def end(status: int) -> NoReturn:
    """End the process, once what still waits is written; within `END_TIMEOUT_S`, whoever may not take it."""
    writing = Thread(target=write_all, daemon=True)
    writing.start()
    writing.join(END_TIMEOUT_S)
    os._exit(status)


def write_all() -> None:
    """Do what was left for the end: of others' first, then ours."""
    for write in (atexit._run_exitfuncs, logging.shutdown, sys.stdout.flush, sys.stderr.flush):
        with suppress(Exception):
            write()
