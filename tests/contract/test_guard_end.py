# SPDX-License-Identifier: Apache-2.0
"""Guard that is being stopped: it ramps the robot to rest, and goes on until the robot has heard of it."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.contract.message import Command, State
from rti_mpc.contract.status import Mode
from tests.contract.scene import FULL, LIMITS, MS, STEP, Scene


def test_stopped_guard_ramps_to_rest_and_takes_no_command(scene: Scene) -> None:
    scene.drive(1000)
    scene.wait(30)
    scene.guard.stop(scene.local_ns)
    assert not scene.guard.at_rest(scene.local_ns)
    assert scene.send() is None
    while not scene.guard.at_rest(scene.local_ns):
        scene.step()
    scene.wait(400)
    assert not scene.actuator.u.any()
    assert scene.actuator.counters.starved == 0
    _, inputs = scene.trace()
    assert (-np.diff(inputs[-60:], axis=0) <= 0.2 * STEP + 1e-12).all()


def end_late(scene: Scene, late_ms: int, *, always: bool, states_ms: int = 10, lost: int = 0) -> Command:
    """
    Stop a guard and let its process end; return its last command.

    The robot, which reports its inputs, hears of it late, until some time after the stop or always; the first commands are lost.
    """
    scene.drive(1000)
    scene.wait(30)
    scene.guard.stop(scene.local_ns)
    scene.inputs.clear()
    stopped_ns, coming, ended = scene.now_ns, [(scene.now_ns, scene.guard.tick(scene.local_ns))], False
    while coming or not ended:
        for until_ns, u in scene.actuator.play(scene.now_ns, scene.now_ns + 10 * MS):
            scene.inputs.append(u.copy())
            scene.now_ns = until_ns
        scene.local_ns += 10 * MS
        if scene.now_ns % (states_ms * MS) == 0 and not ended:
            scene.states, (epoch, seq) = scene.states + 1, scene.actuator.source
            state = State(scene.epoch, scene.states, scene.now_ns, np.zeros(5), u=u.copy(), command_epoch=epoch, command_seq=seq)
            scene.guard.receive_state(state, scene.local_ns)
        ended |= scene.guard.at_rest(scene.local_ns)  # then its process hears nothing more, whatever comes
        if not ended:
            coming.append((scene.now_ns, scene.guard.tick(scene.local_ns)))
        while coming and scene.now_ns - (coming[0][0] if always else stopped_ns) >= late_ms * MS:
            _, command = coming.pop(0)
            if command is not None and lost:
                lost -= 1
            else:
                scene.publish(command)
    return scene.published[-1]


@pytest.mark.parametrize(("late_ms", "always", "refused"), [(80, False, 0), (110, True, 1)])
def test_stopped_guard_goes_on_until_it_has_told_rest_to_a_robot_that_was_late_to_hear_of_the_ramp(
    scene: Scene, late_ms: int, always: bool, refused: int
) -> None:
    """Where the command to brake is over when it comes, the next one begins where the robot still was; then it reports that it is far ahead."""
    last = end_late(scene, late_ms, always=always)
    assert last.mode is Mode.BRAKING
    assert not last.u[-1].any()
    assert scene.refused == refused
    scene.refused = 0


@pytest.mark.parametrize("lost", [1, 2])
def test_stopped_guard_goes_on_until_the_robot_has_heard_that_it_brakes(scene: Scene, lost: int) -> None:
    """Its reports say that it has not, and then where it is on its own ramp, from where the guard goes on."""
    last = end_late(scene, 0, always=False, lost=lost)
    assert not last.u[-1].any()
    assert scene.actuator.source[1] in (last.seq - 1, last.seq), "it obeys the last command, or the one before until that begins, not its own ramp"


def test_stopped_guard_does_not_wait_for_a_robot_that_has_fallen_silent_to_say_that_it_brakes(scene: Scene) -> None:
    """Its process would be killed by a supervisor that is told how long an end may take; and the whole ramp has been sent."""
    scene.drive(1000)
    reported = State(scene.epoch, scene.states + 1, scene.now_ns + MS, np.zeros(5), u=scene.actuator.u.copy())
    reported.command_epoch, reported.command_seq = scene.actuator.source
    scene.guard.receive_state(reported, scene.local_ns)
    scene.guard.stop(scene.local_ns)
    scene.heard = False
    ramp_s = max(FULL / LIMITS.slew)
    scene.wait(round(1e3 * (LIMITS.stale_s + ramp_s)))
    assert scene.guard.at_rest(scene.local_ns)
    assert not scene.published[-1].u[-1].any()


@pytest.mark.parametrize("states_ms", [10, 50])
@pytest.mark.parametrize("late_ms", [20, 50, 70, 90])
@pytest.mark.parametrize("always", [False, True], ids=["the first one late", "all late"])
def test_inputs_of_a_robot_that_was_late_to_hear_of_the_ramp_do_not_rise_on_it(scene: Scene, late_ms: int, states_ms: int, always: bool) -> None:
    """It reports inputs that still drive while the command to brake is on its way; the guard's next one is not to begin from there."""
    end_late(scene, late_ms, always=always, states_ms=states_ms)
    inputs = np.array(scene.inputs)
    assert (inputs[0] == FULL).all()
    assert (np.diff(inputs, axis=0) <= 1e-12).all(), "rounding"


@pytest.mark.parametrize(("after_ms", "names", "u"), [(20, "brake", 0.3), (20, "ramp", 0.3), (110, "driven", 0.5)])
def test_robot_that_has_heard_of_the_ramp_or_never_will_is_where_it_says(scene: Scene, after_ms: int, names: str, u: float) -> None:
    """It names the command to brake or its own ramp, or still the command before when that to brake is over."""
    begins, since_ns = told_after(scene, after_ms, names, u)
    on_the_ramp = u - LIMITS.slew[0] * 1e-9 * since_ns
    assert begins.u[0, 0] == pytest.approx(on_the_ramp, abs=1.01 * 0.1 * STEP[0]), "a step of the ramp"


@pytest.mark.parametrize("names", ["driven", "of a guard before"])
def test_robot_that_has_not_heard_of_the_ramp_yet_is_where_it_will_be_on_it(scene: Scene, names: str) -> None:
    """It names an older command, by epoch first: a guard before may have sent many more."""
    begins, since_ns = told_after(scene, 20, names, 0.5)
    assert begins.u[0, 0] <= 0.5 - LIMITS.slew[0] * 1e-9 * (since_ns + 20 * MS)


def told_after(scene: Scene, after_ms: int, names: str, u: float) -> tuple[Command, int]:
    """Return what a stopped guard tells a robot that reports an input and names a command, and how long after that report it acts."""
    scene.drive(1000)
    scene.wait(30)
    driven = scene.published[-1]
    scene.guard.stop(scene.local_ns)
    scene.heard = False
    scene.wait(after_ms)
    seq = {"brake": driven.seq + 1, "ramp": 0, "driven": driven.seq, "of a guard before": 100 * driven.seq}[names]
    epoch = driven.epoch - (names == "of a guard before")
    state = State(scene.epoch, scene.states + 1, scene.now_ns, np.zeros(5), u=np.array([u, 0.0]), command_epoch=epoch, command_seq=seq)
    scene.guard.receive_state(state, scene.local_ns)
    told = len(scene.published)
    while len(scene.published) == told:
        scene.step()
    return scene.published[-1], scene.published[-1].stamp_ns - state.stamp_ns
