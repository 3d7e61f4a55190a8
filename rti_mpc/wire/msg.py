# SPDX-License-Identifier: Apache-2.0
"""Writer of the ``.msg`` files: ``python -m rti_mpc.wire.msg FOLDER``, as `make msg` runs it."""

from __future__ import annotations

import sys
from pathlib import Path

from rti_mpc.wire.layout import LAYOUTS, msg_text

if __name__ == "__main__":
    for cls in LAYOUTS:
        (Path(sys.argv[1]) / f"{cls.__name__}.msg").write_text(msg_text(cls))
