# SPDX-License-Identifier: Apache-2.0
"""Status process: finds all robots on the bus, listens to each, and shows a table of them."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from threading import Event, Lock
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from rti_mpc.contract.status import DISAGREEMENT
from rti_mpc.errors import ConfigError
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Keys
from rti_mpc_service.console import plain_console, whole_width, widened
from rti_mpc_service.json_text import json_text
from rti_mpc_service.redrawn import Redrawn
from rti_mpc_service.status.survey import Survey

LISTEN_PERIOD_S = 0.05  # resolution of the ages
DRAW_EACH = 5  # of these periods
FIND_S = 1.0  # at least, for robots to be found
MAX_ROBOTS = 100
STALE_S = 1.0  # ages from which on they are marked
GOOD, BAD = ("TRACKING", "HOLDING"), ("BRAKING", "STOPPED", "FALLBACK")
COLUMNS = ("mode", "error", "age of state", "reference", "times p50/max [us]", "leads", "solvers differ", "versions")
ROLES = ("controller", "standby", "robot", "guard", "reference")  # that make a robot; routers, viewers and recorders are there for any

log = logging.getLogger(__name__)


def main(bus_settings: BusSettings, keys: Keys, *, named: bool, once: bool, as_json: bool, timeout_s: float, stop: Event | None = None) -> int:
    """
    Show all robots until stopped, or once.

    Args:
        bus_settings: How to join the bus.
        keys: Keys of one robot; all others below its prefix that show presence are shown as well.
        named: Whether the user has asked for that robot: then it is shown as missing, too.
        once: Whether to show them once and end; so it is without a terminal, too.
        as_json: Whether to print JSON in place of a table.
        timeout_s: How long to wait for robots that have not said everything yet, if once.
        stop: Event that stops the process; None: SIGINT and SIGTERM do.

    Returns:
        Exit status: 1 if no process of any robot is there, or none of that which was named, else 0.
    """
    stop = stop or stop_on_signals()
    with Bus.join(bus_settings, keys, timeout_s=timeout_s, stop=stop) as bus:
        robots, console = Robots(bus, {keys.robot} if named else set()), plain_console()
        with Redrawn(console) as area:
            if once or as_json or not area.live:
                robots.gather(timeout_s, stop)
            periods = 0
            while area.live and not (once or as_json) and not stop.wait(LISTEN_PERIOD_S):
                robots.listen()
                periods += 1
                if periods % DRAW_EACH == 0:
                    area.draw(shown(robots.report(), console))
        report, unconnected = robots.report(), bus.unconnected
    there = [robot for robot, of in report.items() if of["present"]]
    if as_json:
        print(json_text({"prefix": keys.prefix, "robots": report}))
    elif report:
        console = console if console.is_terminal else widened(console)
        console.print(shown(report, console))
    if not there and not as_json:
        print(f"no process of any robot is present at {keys.prefix}/*" + (f": {unconnected}" if unconnected else ""))
    return 0 if there and (not named or keys.robot in there) else 1


class Robots:
    """
    All robots below a prefix.

    Args:
        bus: The bus of any of them.
        named: Robots that are reported also where they are missing.
    """

    def __init__(self, bus: Bus, named: set[str]) -> None:
        self._bus = bus
        self._surveys: dict[str, Survey] = {}
        self._lock = Lock()
        self._named = named
        bus.watch_alive(lambda role, present: self._note(bus.keys.robot, role, present))  # all that an access control list lets through
        bus.watch_robots(self._note)

    def _note(self, robot: str, role: str, present: bool) -> None:
        """Note that a process has come or gone; called in threads of the bus."""
        if role.partition(".")[0] not in ROLES:
            return
        with self._lock:
            if robot not in self._surveys:
                if not present or len(self._surveys) >= MAX_ROBOTS:
                    return
                try:
                    bus = self._bus if robot == self._bus.keys.robot else self._bus.beside(Keys(self._bus.keys.prefix, robot))
                except ConfigError:
                    return
                self._surveys[robot] = Survey(bus)
            survey = self._surveys[robot]
            (survey.present.add if present else survey.present.discard)(role)

    def gather(self, timeout_s: float, stop: Event) -> None:
        """Listen until all processes that are there have said what is shown."""
        began_s = time.monotonic()
        while not stop.wait(LISTEN_PERIOD_S):
            self.listen()
            waited_s = time.monotonic() - began_s
            with self._lock:
                done = waited_s >= min(FIND_S, timeout_s) and self._surveys and all(survey.complete for survey in self._surveys.values())
            if done or waited_s >= timeout_s:
                return

    def listen(self) -> None:
        """Take what has arrived."""
        with self._lock:
            for survey in self._surveys.values():
                survey.listen(time.monotonic_ns())

    def report(self) -> dict[str, Any]:
        """Return the report of each robot by its name, those without any process left out unless they were named."""
        self.listen()
        with self._lock:
            for robot in self._named - self._surveys.keys():
                self._surveys[robot] = Survey(self._bus)
            now_ns = time.monotonic_ns()
            return {robot: survey.report(now_ns) for robot, survey in sorted(self._surveys.items()) if survey.present or robot in self._named}


def shown(reports: Mapping[str, Mapping[str, Any]], console: Console) -> RenderableType:
    """Return the reports with a row for each robot, and their last events below; where the console is too narrow, a line for each value."""
    rows = {robot: cells(report) for robot, report in reports.items()}
    events = {robot: event_text(report["event"]) for robot, report in reports.items()}
    table = Table("robot", *COLUMNS, box=None, padding=(0, 2, 0, 0))
    for robot, row in rows.items():
        table.add_row(robot, *row)
    if whole_width(console, table) <= console.width:
        below = Table.grid(padding=(0, 2, 0, 0))
        for robot, event in events.items():
            below.add_row(f"{robot}:", event or "no event")
        return Group(table, "", below)
    lines = Table.grid(padding=(0, 2, 0, 0))
    for robot, row in rows.items():
        for name, cell in (("robot", Text(robot, "bold")), *zip(COLUMNS, row, strict=True), ("last event", events[robot])):
            if str(cell):
                lines.add_row(name, cell)
        lines.add_row("", "")
    return lines


def cells(report: Mapping[str, Any]) -> list[Text]:
    """Return what is said of a robot in each of the columns."""
    age_s = report["state_age_s"]
    return [
        mode_text(report),
        Text(error_text(report["error"])),
        Text("never" if age_s is None else f"{age_s:.2f} s", "" if age_s is not None and age_s < STALE_S else "red"),
        Text(reference_text(report)),
        Text("\n".join(f"{name} {of['p50']:.0f}/{of['max']:.0f}" for name, of in report["times_us"].items())),
        Text(leader_text(report)),
        agreement_text(report["agreement"]),
        versions_text(report["versions"]),
    ]


def mode_text(report: Mapping[str, Any]) -> Text:
    """Return the mode of the leader, or what is missing."""
    mode: str | None = report["mode"]
    if not report["present"]:
        return Text("not there", "red")
    if mode is None:
        return Text("no sample" if report["leader"] is not None else "no controller", "yellow")
    return Text(mode.lower(), "green" if mode in GOOD else "red" if mode in BAD else "yellow")


def error_text(error: Mapping[str, Any]) -> str:
    """Return the distance in the plane, or the error of each output."""
    if "position" in error:
        return f"{error['position']['value']:.2f} mm"
    return "\n".join(f"{name} {of['value']:+.3g} {'' if of['unit'] == '1' else of['unit']}".rstrip() for name, of in error.items())


def reference_text(report: Mapping[str, Any]) -> str:
    """Return how long the reference lasts."""
    left_s = report["reference_left_s"]
    return "none" if left_s is None else f"{left_s:.0f} s left" if left_s > 0 else "ended"


def leader_text(report: Mapping[str, Any]) -> str:
    """Return who leads, who stands by, and whether a guard is there."""
    leader = [f"controller {report['leader']['owner']}"] if report["leader"] else []
    standbys = [f"{report['standby']} standby"] if report["standby"] else []
    return "\n".join([*leader, *standbys, *(["guard"] if "guard" in report["present"] else []), *(["STOPPED"] if report["stopped"] else [])])


def agreement_text(agreement: Mapping[str, Any]) -> Text:
    """Return how far the solvers' plans differ, and in how many samples they were compared."""
    if (difference := agreement["max_difference"]) is None:
        return Text("not compared")
    return Text(f"{difference:.1g}\n{agreement['judged']} of {agreement['samples']}", "red" if difference > DISAGREEMENT else "")


def versions_text(versions: Mapping[str, str]) -> Text:
    """Return the version of all processes, or of each where they differ."""
    if len(set(versions.values())) < 2:
        return Text("".join(set(versions.values())))
    return Text("\n".join(f"{role} {version}" for role, version in sorted(versions.items())), "red")


def event_text(event: Mapping[str, Any] | None) -> Text:
    """Return an event with its age."""
    if event is None:
        return Text("")
    ago = "" if event["age_s"] is None else f"{event['age_s']:.0f} s ago, "
    return Text(f"{ago}{event['source']}: {event['text']}", {"ERROR": "red", "WARNING": "yellow"}.get(event["severity"], ""))
