# SPDX-License-Identifier: Apache-2.0
"""
Measurement of this host: timer, bus and controller, and the shortest period that a control loop can keep here.

Each part is measured alone for a second: how late a bare timer wakes, how long a
message takes to another process and back, and how long preparation and feedback of
this configuration take after a pause, with caches as cold as in a service.
"""

from __future__ import annotations

import gc
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from rti_mpc.array import Array
from rti_mpc.cache import cache_dir, make_private
from rti_mpc.contract.message import Command, End, Reference, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.cdr import encode
from rti_mpc_service.config.build import build_model, build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.console import table_console
from rti_mpc_service.host import machine, realtime
from rti_mpc_service.host.echo import ROLE as ECHO
from rti_mpc_service.host.echo import Pinger
from rti_mpc_service.host.jitter import bare_timer
from rti_mpc_service.json_text import json_text
from rti_mpc_service.rig.children import Children
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.rig.summary import quantiles
from rti_mpc_service.rig.wave import wave
from rti_mpc_service.warm_up import warm_up

TIMER_PERIOD_S, TIMER_TICKS = 0.001, 1000
PAUSE_S = 0.005  # before each ping and before each sample
PING_COUNT, SAMPLE_COUNT = 200, 200
ECHO_TIMEOUT_S = 10.0  # for the echo process to start
DEFAULT_PRIORITY = 20  # tried where the configuration asks for no priority
PERIOD_MARGIN_FACTOR = 1.5  # the shortest period is this factor times the sum of all p99
CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
TIMER_SLACK = Path("/proc/self/timerslack_ns")
EXTRA_OF_PACKAGE = {"rerun-sdk": "view", "matplotlib": "figure"}


def main(path: Path, json_path: Path | None = None) -> int:
    """Examine this host, print what was found, and return the exit status: 0 if the configuration's period can be kept."""
    config = load(path)
    console = table_console()
    with console.status("measuring"):
        report = examine(config)
    if json_path is not None:
        json_path.write_text(json_text(report) + "\n", encoding="utf-8")
    table = Table("what", "here", "which means", box=None, padding=(0, 2, 0, 0))
    for row in finding_rows(report):
        table.add_row(*row)
    console.print(table)
    loop = report["loop"]
    fits = "can be kept here" if loop["fits"] else "CANNOT be kept here"
    console.print(f"{path}: a period of {1e3 * config.ocp.dt_s:g} ms {fits}, the shortest is {shortest_text(loop)}", soft_wrap=True)
    return 0 if loop["fits"] else 1


def examine(config: Config) -> dict[str, Any]:
    """Measure all parts one after the other, and return the results in JSON; the name of a time ends with its unit."""
    ticks = count()
    report: dict[str, Any] = {
        "machine": machine.machine_info(),
        "realtime": permissions(config),
        "clock": clock_info(),
        "timer_us": quantiles(np.array(1e-3) * bare_timer(TIMER_PERIOD_S, lambda: next(ticks) < TIMER_TICKS)[:, 1]),
        "round_trip_us": quantiles(round_trip_us(config)),
        "compiler": compiler(),
        "cache": cache_info(),
        "extras": {name: installed(name) for name in EXTRA_OF_PACKAGE},
    }
    prepare_us, feedback_us = phases_us(config)
    report |= {"prepare_us": quantiles(prepare_us), "feedback_us": quantiles(feedback_us)}
    return report | {"loop": period_verdict(report, config.ocp.dt_s)}


def period_verdict(report: dict[str, Any], dt_s: float) -> dict[str, Any]:
    """Return the shortest period, `PERIOD_MARGIN_FACTOR` times the sum of all parts at p99, None if one is unknown; and whether `dt_s` is as long."""
    parts = [report[part]["p99"] for part in ("prepare_us", "feedback_us", "timer_us", "round_trip_us")]
    shortest_us = None if None in parts else PERIOD_MARGIN_FACTOR * sum(parts)
    return {"margin": PERIOD_MARGIN_FACTOR, "shortest_period_us": shortest_us, "fits": shortest_us is not None and shortest_us <= 1e6 * dt_s}


def permissions(config: Config) -> dict[str, dict[str, Any]]:
    """Attempt the real-time settings of a controller in a thread that ends afterwards."""
    wanted = config.realtime
    with ThreadPoolExecutor(1) as pool:
        outcomes = pool.submit(realtime.attempt, wanted.priority or DEFAULT_PRIORITY, wanted.cores or realtime.available(), lock_memory=True).result()
    return {outcome.what: asdict(outcome) for outcome in outcomes}


def clock_info() -> dict[str, Any]:
    """Describe the monotonic clock and the timers."""
    began_ns = time.perf_counter_ns()
    readings = [time.monotonic_ns() for _ in range(10_000)]
    took_ns = time.perf_counter_ns() - began_ns
    return {
        "source": CLOCK_SOURCE.read_text().strip() if CLOCK_SOURCE.is_file() else "unknown",
        "resolution_ns": 1e9 * time.get_clock_info("monotonic").resolution,
        "reading_ns": took_ns / len(readings),
        "timer_slack_us": 1e-3 * int(TIMER_SLACK.read_text()) if TIMER_SLACK.is_file() else None,
    }


def round_trip_us(config: Config) -> Array:
    """Return round-trip times of a state to another process and a message of a command's size back; empty if that process did not start."""
    model, keys, endpoint = build_model(config), config.keys(), free_endpoint()
    command = Command(0, 0, 0, 0, 0, 0, 0, 0, Mode.TRACKING, QpStatus.SOLVED, 0, np.zeros((config.ocp.N, model.nu)))
    with (
        tempfile.TemporaryDirectory() as folder,
        Bus.join(BusSettings(listen=(endpoint,), connect=()), keys) as bus,
        Children(Path(folder)) as children,
    ):
        pinger = Pinger(bus, State(0, 0, 0, np.zeros(model.nx)))
        children.start("echo", "rti_mpc_service.host.echo", endpoint, keys.prefix, keys.robot, len(encode(command)))
        if bus.is_alive(ECHO, ECHO_TIMEOUT_S):
            for _ in paced(PING_COUNT):
                pinger.ping()
    return np.array(pinger.round_trip_us)


def phases_us(config: Config) -> tuple[Array, Array]:
    """Control a robot that follows the plan exactly, with a pause before each sample; return the times of preparation and of feedback."""
    rti, x = build_rti(config), np.array(robot_settings(config)["x0"])
    warm_up(rti)
    dt_ns = round(1e9 * config.ocp.dt_s)
    y = wave(rti.ocp, x, np.random.default_rng(1))(np.arange(SAMPLE_COUNT + config.ocp.N + 1))
    controller = Controller(rti, Timing())
    controller.receive_reference(Reference(1, 1, 0, dt_ns, End.HOLD, y, np.empty((len(y), 0))))
    prepare_us, feedback_us = np.zeros(SAMPLE_COUNT), np.zeros(SAMPLE_COUNT)
    gc.collect()
    gc.freeze()
    gc.disable()
    seq = 0

    def answer() -> Command | None:
        """Answer the next state; None while the rate of the robot's clock is not known."""
        nonlocal seq
        seq += 1
        return controller.receive_state(State(1, seq, seq * dt_ns, x), seq * dt_ns)

    while (command := answer()) is None:
        pass
    controller.commit(command)
    controller.prepare()
    for k in paced(SAMPLE_COUNT):
        arrival_ns = time.monotonic_ns()
        command = answer()
        assert command is not None
        encode(command)
        commanded_ns = time.monotonic_ns()
        controller.commit(command, commanded_ns)
        controller.prepare()
        prepare_us[k], feedback_us[k] = 1e-3 * (time.monotonic_ns() - commanded_ns), 1e-3 * (commanded_ns - arrival_ns)
        x = rti.x[1].copy()
    gc.enable()
    return prepare_us, feedback_us


def paced(number: int) -> Iterator[int]:
    """Yield the numbers from 0 on, each after a pause."""
    for k in range(number):
        time.sleep(PAUSE_S)
        yield k


def compiler() -> str | None:
    """Return the first line of the C compiler's version, None if there is no compiler."""
    path = shutil.which("cc")
    return subprocess.run([path, "--version"], capture_output=True, text=True, check=False).stdout.partition("\n")[0] if path else None


def cache_info() -> dict[str, Any]:
    """Return the folder of compiled code, or the error that prevents its use."""
    try:
        folder = cache_dir()
        make_private(folder)
    except OSError as error:
        return {"path": None, "error": str(error)}
    return {"path": str(folder), "error": None}


def installed(name: str) -> str | None:
    """Return the version of a package, None if it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def finding_rows(report: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield each finding as a row: what, its value here, what it means."""
    host, clock_info, loop, cache_info = report["machine"], report["clock"], report["loop"], report["cache"]
    slack = "unknown" if clock_info["timer_slack_us"] is None else f"{clock_info['timer_slack_us']:g} us"
    yield "processor", f"{host['processor']}, {host['cores']} cores, load {host['load']}", "robot and controller want a core each"
    yield "governor", host["governor"], "performance keeps times even"
    for what, outcome in report["realtime"].items():
        yield what.replace("_", " "), outcome["text"], f"realtime.{what} {'would be granted' if outcome['granted'] else 'would be refused'}"
    yield "clock", f"{clock_info['source']}, {clock_info['resolution_ns']:g} ns, {clock_info['reading_ns']:.0f} ns a reading", ""
    yield "timer slack", slack, "what the kernel may add to a sleep"
    yield "bare timer loop", quantiles_text(report["timer_us"]), f"how late it wakes, every {1e3 * TIMER_PERIOD_S:g} ms"
    yield "Zenoh round trip", quantiles_text(report["round_trip_us"]), "a state out, a command in, nothing between"
    yield "compiler", report["compiler"] or "none", "what it compiled is cached" if report["compiler"] else "preparation takes several times longer"
    yield "cache", cache_info["path"] or "none", "is kept" if cache_info["error"] is None else f"compiles at EVERY start: {cache_info['error']}"
    for name, found in report["extras"].items():
        yield name, found or "not installed", f"pip install 'rti-mpc[{EXTRA_OF_PACKAGE[name]}]'" if found is None else ""
    yield "versions", ", ".join(f"{name} {found}" for name, found in {"python": host["python"], **host["packages"]}.items()), host["system"]
    yield "preparation", quantiles_text(report["prepare_us"]), f"of {SAMPLE_COUNT} samples, {1e3 * PAUSE_S:g} ms apart"
    yield "feedback", quantiles_text(report["feedback_us"]), ""
    yield "shortest period", shortest_text(loop), f"{loop['margin']:g} times preparation, feedback, timer and round trip at p99"


def shortest_text(loop: dict[str, Any]) -> str:
    """Return the shortest period as text."""
    return "unknown" if loop["shortest_period_us"] is None else f"{1e-3 * loop['shortest_period_us']:.1f} ms"


def quantiles_text(times: dict[str, float]) -> str:
    """Return quantiles as text."""
    return "not measured" if times["p50"] is None else f"p50 {times['p50']:.0f}, p99 {times['p99']:.0f}, max {times['max']:.0f} us"
