# SPDX-License-Identifier: Apache-2.0
"""
Runner of a module that interrupts it when its parent process has ended.

`python -m rti_mpc_service.rig.leash PARENT MODULE ARGUMENT...` runs `python -m MODULE
ARGUMENT...`. When the parent ends, even by SIGKILL, the kernel sends the module SIGINT
(prctl(2), PR_SET_PDEATHSIG); no thread has to watch or poll. On other systems than
Linux the module runs without this.
"""

from __future__ import annotations

import ctypes
import os
import runpy
import signal
import sys

PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run the module named on the command line."""
    _, parent, module, *arguments = sys.argv
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGINT))
        if os.getppid() != int(parent):  # the parent ended before the call above
            sys.exit(f"{module}: the process that started it is gone")
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
