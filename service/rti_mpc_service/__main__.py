# SPDX-License-Identifier: Apache-2.0
"""Start of the command line. Loading its modules takes a while, in which Ctrl-C ends the process at once, without a traceback."""

from __future__ import annotations

import signal
from typing import NoReturn


def main() -> NoReturn:
    """Load the command line and run it."""
    interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not if whoever started it has it ignore SIGINT
    if interruptible:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from rti_mpc_service import cli

    if interruptible:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    cli.main()


if __name__ == "__main__":
    main()
