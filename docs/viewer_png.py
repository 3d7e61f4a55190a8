# SPDX-License-Identifier: Apache-2.0
"""
Remake ``docs/viewer.png``: a recording as the viewer shows it, without a screen.

    python docs/viewer_png.py RUN.rrd docs/viewer.png

Needs Vulkan; without a graphics card, ``apt-get install mesa-vulkan-drivers
libvulkan1`` and ``VK_ICD_FILENAMES=/usr/share/vulkan/icd.d/lvp_icd.x86_64.json``.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from pathlib import Path

import rerun_cli
from matplotlib.image import imread, imsave
from rerun.experimental import ViewerClient

from rti_mpc_service.rig.endpoint import free_port

START_S = 20.0
SETTLE_S = 12.0  # until the recording is drawn and the notices have faded
TOP_BAR = 36  # pixels, without anything of ours


def main(recording: Path, image: Path) -> None:
    """Show a recording in a headless viewer and save what it shows."""
    port = free_port()
    binary = Path(rerun_cli.__file__).with_name("rerun")  # the script of that name is a wrapper whose child would be left over
    viewer = subprocess.Popen([binary, "--headless", "--window-size", "1600x900", "--bind", "127.0.0.1", "--port", str(port), recording])
    try:
        _await(port)
        time.sleep(SETTLE_S)
        ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy").save_screenshot(str(image))
    finally:
        viewer.terminate()
        viewer.wait()
    imsave(image, imread(image)[TOP_BAR:])


def _await(port: int) -> None:
    deadline = time.monotonic() + START_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
            return
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
