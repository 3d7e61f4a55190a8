# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.contract.message import End, Reference
from rti_mpc.contract.status import Mode
from rti_mpc.wire.info import Info, Label
from rti_mpc_service.view.tracking_error import SAID_NS, tracked, tracking_error

UNIX_NS = 1_800_000_000_000_000_000  # as a float, good to 256 ns only
PLANE = (Label("x", "m", role="x", state="x"), Label("y", "m", role="y", state="y"), Label("psi", "rad", True, "heading", "psi"))
INFO = Info(role="controller", states=(*PLANE, Label("u", "m/s")), outputs=(PLANE[2], *PLANE[:2]))


def reference(y: list[list[float]], offset_ns: int = 0) -> Reference:
    return Reference(1, 1, UNIX_NS + offset_ns, 1000, End.HOLD, np.array(y), np.zeros((len(y), 0)))


def error(y: list[list[float]], offset_ns: int, x: list[float]) -> dict[str, float]:
    measured = {i: np.array([x[k]]) for i, k in INFO.tracked}
    errors = tracking_error(INFO, [reference(y)], np.array([UNIX_NS + offset_ns]), measured)
    return {name: float(values[0]) for name, values in errors.items()}


def test_between_rows_the_reference_is_interpolated_at_any_epoch_of_the_clock() -> None:
    result = error([[0.0, 0.0, 0.0], [0.0, 1.0, 2.0]], 250, [0.25, 0.5, 0.0, 9.0])
    assert result == pytest.approx({"x": 0.0, "y": 0.0, "psi": 0.0, "position": 0.0}, abs=1e-12)


def test_after_the_last_row_the_reference_is_held() -> None:
    assert error([[0.0, 0.0, 0.0], [0.0, 1.0, 2.0]], 9000, [1.003, 2.004, 0.0, 0.0])["position"] == pytest.approx(5.0)


def test_before_the_first_row_there_is_no_error() -> None:
    assert np.isnan(error([[0.0, 0.0, 0.0]], -1, [0.0] * 4)["position"])


def test_another_reference_counts_from_its_own_first_row_on() -> None:
    references = [reference([[0.0, 0.0, 0.0]]), reference([[0.0, 1.0, 0.0]], 500)]
    y = {i: np.full(3, 0.0) for i, _ in INFO.tracked}
    assert tracking_error(INFO, references, UNIX_NS + np.array([-1, 499, 500]), y)["position"] == pytest.approx([np.nan, 0.0, 1000.0], nan_ok=True)


def test_a_reference_is_tracked_until_the_controller_is_stopped_or_gone() -> None:
    told = [(0, Mode.TRACKING), (1000, Mode.STOPPED), (2000, Mode.WAITING), (3000, Mode.BRAKING)]
    assert tracked(np.array([-1, 0, 999, 1000, 2500, 3000]), told, 1e-6).tolist() == [True, True, True, False, False, True]
    assert tracked(np.array([4000 + SAID_NS, 4001 + SAID_NS]), told, 1e-6).tolist() == [True, False], "a period more than that"
    for unknown in (np.nan, np.inf):
        assert tracked(np.array([3000 + SAID_NS, 3001 + SAID_NS]), told, unknown).tolist() == [True, False]
    assert tracked(np.array([5, 6]), [], 0.1).all(), "without samples that are heard"


@pytest.mark.parametrize("turns", [-3, 0, 2])
def test_heading_error_is_the_short_way_round(turns: int) -> None:
    assert error([[3.1, 0.0, 0.0]], 0, [0.0, 0.0, -3.1 + 2 * np.pi * turns, 0.0])["psi"] == pytest.approx(2 * np.pi - 6.2)


def test_a_reference_that_crosses_pi_is_interpolated_the_short_way() -> None:
    assert error([[3.1, 0.0, 0.0], [-3.1, 0.0, 0.0]], 500, [0.0, 0.0, np.pi, 0.0])["psi"] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_error_of_an_attitude_does_not_depend_on_the_sign_of_rows_and_measurement(sign: float) -> None:
    parts = tuple(Label(name, state=name) for name in "wijk")
    info = Info(role="controller", states=parts, outputs=parts, quaternions=(tuple("wijk"),))
    level, turned = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.8, 0.0, 0.0, 0.6])
    y = {i: np.array([value]) for i, value in enumerate(sign * (level + turned) / 2)}
    errors = tracking_error(info, [reference([level.tolist(), (-turned).tolist()])], np.array([UNIX_NS + 500]), y)
    assert [float(errors[name][0]) for name in "wijk"] == pytest.approx([0.0] * 4, abs=1e-12)


def test_without_any_output_that_is_known_there_is_no_error() -> None:
    """As long as no telemetry has told the outputs of an arm, which are no states."""
    assert tracking_error(INFO, [reference([[0.0, 0.0, 0.0]])], np.array([UNIX_NS]), {}) == {}
