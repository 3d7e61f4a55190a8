# SPDX-License-Identifier: Apache-2.0
"""Example notebook of a recording, executed on one that a demo has left."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.processes.system import ROOT, rti_mpc

pytestmark = pytest.mark.slow


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::RuntimeWarning", "ignore::UserWarning")  # of the kernel's packages
def test_notebook_of_a_recording_runs_to_its_end(tmp_path: Path) -> None:
    import nbformat
    from nbclient import NotebookClient

    done = rti_mpc("demo", "--duration", 8, "--speed", 4, "--out", tmp_path / "runs" / "eight")
    assert done.returncode == 0, done.stdout + done.stderr
    notebook = nbformat.read(ROOT / "examples" / "recording.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "kept without its outputs"
    NotebookClient(notebook, timeout=120, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}).execute()
    printed = "".join(output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", ()))
    assert "config.toml" in printed
    assert "x.psi[]" in printed
    assert (tmp_path / "recording.png").stat().st_size > 10_000
