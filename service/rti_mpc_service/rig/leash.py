# SPDX-License-Identifier: Apache-2.0
"""
Runs a module of ours, and interrupts it when the process that started it is gone.

`python -m rti_mpc_service.rig.leash PARENT MODULE ARGUMENT...` is `python -m MODULE
ARGUMENT...`, except that SIGKILL of its parent, which nobody can answer, reaches
it as Ctrl-C: the kernel sends the signal (prctl(2), PR_SET_PDEATHSIG), so there
is no thread that watches and nothing to poll. Elsewhere than on Linux it is just
the module.
"""

from __future__ import annotations

import ctypes
import os
import runpy
import signal
import sys

PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run the module named on the command line, on a leash."""
    _, parent, module, *arguments = sys.argv
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGINT))
        if os.getppid() != int(parent):  # gone before we asked to be told
            sys.exit(f"{module}: the process that started it is gone")
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
