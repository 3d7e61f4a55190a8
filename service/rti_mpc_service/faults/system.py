# SPDX-License-Identifier: Apache-2.0
"""System under test: a robot and all processes around it, as a user runs them, with ways to break and to observe them."""

from __future__ import annotations

import resource
import signal
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import Enum
from pathlib import Path
from threading import Event
from types import TracebackType
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Reference, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.signals import quantity
from rti_mpc.wire.bus import Bus, new_epoch
from rti_mpc.wire.info import Info, Label
from rti_mpc.wire.keys import Key, Keys
from rti_mpc.wire.session import BusSettings
from rti_mpc_service.config.build import build_model, disturbances_at_rest
from rti_mpc_service.config.schema import Config
from rti_mpc_service.faults.motion import Motion
from rti_mpc_service.faults.observer import RunObserver
from rti_mpc_service.faults.proxy import Proxy
from rti_mpc_service.faults.relay import ROLE as RELAY
from rti_mpc_service.rig import robot_log
from rti_mpc_service.rig.children import Children
from rti_mpc_service.rig.company import CLI_MODULE, START_TIMEOUT_S, WATCHER_NICENESS, Failed, wait
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.rig.robot_log import RobotLog
from rti_mpc_service.rig.scenario import write_files
from rti_mpc_service.rig.witness import Witness

REQUEST_TIMEOUT_S = 2.0
RECORDER = "recorder"
WATCHERS = ("viewer", RECORDER)  # roles that wait while others work
STEADY_NS = 1_000_000_000  # for which an estimate does not change any more that has come to what it estimates
STEADY_SHARE = 1e-3  # of its largest magnitude, by which it may still


class Wiring(Enum):
    """How the processes are linked."""

    PEERS = "peers"  # every process is linked directly with every other one
    ROUTER = "router"  # all are clients of a router, the controller through a link that can be cut
    LINK = "link"  # peers; the controller receives the robot's states through a relay that can change them
    SENSOR = "sensor"  # peers; all processes, also the guard, receive the states through the relay


RELAYED = (Wiring.LINK, Wiring.SENSOR)


class System:
    """
    The processes of one robot, being driven.

    Args:
        config: Its configuration.
        wiring: How they are linked.
        folder: Folder of their files, to be made.
        stop: Ends all waiting.
        reference: Options of `rti-mpc reference`.
        recording: File to record all streams to; None: nothing is recorded.
        tell: Takes what is waited for and what is missing, in words, again and again while that lasts.

    Attributes:
        wiring: How they are linked.
        keys: Keys of all processes except those behind a relay.
        period_ns: Period of the controller.
        children: The processes.
        bus: Bus of this process.
        witness: Collects the controller's messages.
        observer: Follows the robot's states.
        link: Link between controller and router, used with wiring `ROUTER`.
        lives: How often each process was started so far: files that it writes have this number, since none is overwritten.
        motion: What the robot's reaction is measured by.
    """

    def __init__(
        self,
        config: Config,
        wiring: Wiring,
        folder: Path,
        stop: Event,
        reference: Sequence[object] = (),
        recording: Path | None = None,
        tell: Callable[[str], object] = lambda _: None,
    ) -> None:
        folder.mkdir(parents=True)
        self.keys = config.keys()
        self.period_ns = round(1e9 * config.ocp.dt_s)
        self.lives: Counter[str] = Counter()
        self.wiring, self._folder, self._stop, self._reference, self._tell = wiring, folder, stop, reference, tell
        self._robot_keys = Keys(f"{self.keys.prefix}/behind", self.keys.robot) if wiring in RELAYED else self.keys
        self._balanced = disturbances_at_rest(config)
        model = build_model(config)
        self.motion = Motion(model)
        states, inputs = (tuple(Label(signal.name) for signal in signals) for signals in (model.states, model.inputs))
        self._info = Info("robot", states=states, inputs=inputs)
        self._recording = recording
        self._suspended: set[str] = set()
        write_files(folder / "config.toml", config)
        write_files(folder / "robot.toml", config.model_copy(update={"prefix": self._robot_keys.prefix}))
        self._endpoint = free_endpoint()
        self.children = Children(folder)
        try:
            self.link = Proxy(self._endpoint)
            if wiring is Wiring.ROUTER:
                self.start("router")
            client = BusSettings(mode="client", connect=(self._endpoint,))
            settings = client if wiring is Wiring.ROUTER else BusSettings(listen=(self._endpoint,), connect=())
            self.bus = Bus.join(settings, self.keys, timeout_s=START_TIMEOUT_S, stop=stop)
            self.witness = Witness(self.bus)
            self._references = self.bus.publisher(self.keys.reference)
            self.observer = RunObserver(self.bus, self._robot_keys, self.motion)
            if recording is not None:
                self.ensure(RECORDER)
        except BaseException:
            self.children.__exit__(None, None, None)
            raise

    def __enter__(self) -> System:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.resume(*self._suspended)
        self.link.restore()
        if self._recording is not None and kind is None:  # its recorder ends when all others have said their last
            for role in self.children.names:
                if role != RECORDER:
                    self.children.end(role)
        self.children.__exit__(kind, error, traceback)
        self.link.close()
        self.bus.close()

    # Processes.

    def start(self, *roles: str) -> None:
        """Start processes; each start of the robot is a new life with its own record."""
        for role in roles:
            self.lives[role] += 1
            if role == "robot":
                self.observer.forget()
            module, *arguments = self._command(role)
            self.children.start(role, str(module), *arguments, nice=WATCHER_NICENESS if role in WATCHERS else 0)

    def kill(self, *roles: str) -> None:
        """Kill processes by SIGKILL."""
        for role in roles:
            self.children.kill(role)

    def suspend(self, *roles: str) -> None:
        """Suspend processes by SIGSTOP."""
        for role in roles:
            self.children.signal(role, signal.SIGSTOP)
            self._suspended.add(role)

    def resume(self, *roles: str) -> None:
        """Resume processes by SIGCONT."""
        for role in roles:
            self._suspended.discard(role)
            self.children.signal(role, signal.SIGCONT)

    def restart(self, *roles: str) -> None:
        """End processes as Ctrl-C does, those that run, and start them again."""
        for role in roles:
            if self.children.pid(role) is not None:
                self.children.end(role)
            self.start(role)

    def limit_files(self, size: int | None, *roles: str) -> None:
        """Let processes write files up to a size only, in bytes, None for no limit: Python ignores the signal, and sees the write fail."""
        for role in roles:
            if (pid := self.children.pid(role)) is not None:
                _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard if size is None else size, hard))

    def _keys_of(self, role: str) -> Keys:
        """Return the keys of a process: those behind the relay for the robot, and for its guard with wiring `LINK`."""
        return self._robot_keys if role == "robot" or (role == "guard" and self.wiring is Wiring.LINK) else self.keys

    def _command(self, role: str) -> tuple[object, ...]:
        """Return module and arguments of a process."""
        here = self._folder / ("config.toml" if self._keys_of(role) is self.keys else "robot.toml")
        through = self.link.endpoint if self.wiring is Wiring.ROUTER and role == "controller" else self._endpoint
        meeting: tuple[object, ...] = (here, *(("-m", "client") if self.wiring is Wiring.ROUTER else ()), "-e", through)
        commands: dict[str, tuple[object, ...]] = {
            "controller": (CLI_MODULE, "run", *meeting),
            "guard": (CLI_MODULE, "guard", *meeting),
            "reference": (CLI_MODULE, "reference", *meeting, *self._reference),
            "robot": (CLI_MODULE, "sim", *meeting, *(() if "-m" in meeting else ("-l", "tcp/127.0.0.1:0")), "--log", self.log_path),
            "viewer": (CLI_MODULE, "view", *meeting, "--rerun-save", self._folder / f"viewer-{self.lives['viewer']}.rrd"),
            RECORDER: (CLI_MODULE, "record", *meeting, "--out", self._recording),
            "router": (CLI_MODULE, "router", here, "-l", self._endpoint),
            RELAY: ("rti_mpc_service.faults.relay", self._endpoint, self._robot_keys.prefix, self.keys.prefix, self.keys.robot),
        }
        return commands[role]

    # Observation.

    @property
    def log_path(self) -> Path:
        """Record of the robot's present life."""
        return self._folder / f"robot-{self.lives['robot']}.csv"

    def log(self) -> RobotLog:
        """Return the record of the robot's present life, as far as it is written; a guard's own commands are no answers."""
        log = robot_log.read(self.log_path, self._info)
        return replace(log, latency_us=np.where(np.isin(log.seq, list(self.observer.answered)), log.latency_us, np.nan))

    def logged_ns(self) -> int:
        """Return the stamp of the last whole line of that record, -1 if there is none."""
        lines = self.log_path.read_bytes().splitlines(keepends=True)[1:] if self.log_path.exists() else []
        return next((int(line.partition(b",")[0]) for line in reversed(lines) if line.endswith(b"\n")), -1)

    def now_ns(self) -> int:
        """Return robot time now; for a suspended or dead robot, the stamp of its last state."""
        alive = self.children.pid("robot") is not None and "robot" not in self._suspended
        return self.observer.now_ns() if alive else self.observer.stamp_ns

    def last_sample_ns(self) -> int:
        """Return the stamp of the last state that the controller has answered, as far as it has told us."""
        return self.witness.listen().telemetry[-1].state_stamp_ns

    def error_m(self) -> float:
        """Return the distance from the reference now."""
        wanted = self.motion.wanted(self.witness.reference, np.array(self.observer.stamp_ns))
        return float(self.motion.distance(self.observer.position, wanted))

    def reference_left_s(self) -> float:
        """Return how long the reference still lasts."""
        reference = self.reference
        return 1e-9 * (reference.stamp_ns + (len(reference.y) - 1) * reference.period_ns - self.now_ns())

    def driven(self, error_m: float = np.inf) -> bool:
        """Whether the robot is driven, not only adrift, and nearer to its reference than `error_m`."""
        return not self.undriven(error_m)

    def undriven(self, error_m: float = np.inf) -> str:
        """Return, in words, the first of what is missing for the robot to be driven, as `driven` has it; empty if nothing is."""
        witness = self.witness.listen()
        if not witness.begun:
            return "no reference yet" if witness.reference is None else "the controller has sent no plan in time yet"
        if not self.observer.answered:  # the robot in its present life
            return "no state of the robot is answered"
        if (mode := witness.telemetry[-1].mode) is not Mode.TRACKING:
            return f"the controller is {mode.name.lower()}"
        if (speed := self.observer.speed_m_s()) <= self.motion.driven_speed:
            return f"the robot moves by {speed:.2g} {self.motion.unit}/s, and must by {self.motion.driven_speed:g}"
        if (away := self.error_m()) >= error_m:
            return f"the robot is {quantity(away, self.motion.unit, '.2g')} from its reference, and must be within {error_m:g}"
        return ""

    def estimated(self) -> bool:
        """Whether the controller knows what a stop is to balance, a current say: without it, its commands lead to no rest."""
        return steady(self.witness.listen().telemetry, self._balanced)

    def wait(self, condition: Callable[[], object], what: str, patience_s: float = START_TIMEOUT_S, missing: Callable[[], str] = lambda: "") -> None:
        """
        Wait for a condition, or until stopped.

        Args:
            condition: Is asked again and again.
            what: What is waited for, in words.
            patience_s: For how long.
            missing: Returns, in words, what is still missing.

        Raises:
            Failed: It did not come true in time, or a process has ended by itself.
        """

        def met() -> bool:
            if condition():
                return True
            self._tell(f"waiting for {what}{because(missing())}")
            return False

        try:
            wait(met, self.children, self._stop, patience_s, what)
        except Failed as error:
            raise Failed(f"{error}{because(missing())}") from None

    @property
    def stopped(self) -> bool:
        """Whether the run is to stop."""
        return self._stop.is_set()

    def pause(self, duration_s: float) -> None:
        """Wait for a duration, or until stopped."""
        self._stop.wait(duration_s)

    def ensure(self, *roles: str) -> None:
        """Start the processes that do not run, and wait until all are present."""
        self.start(*(role for role in roles if self.children.pid(role) is None))
        others = [role for role in roles if self._keys_of(role) is self.keys]  # a relay passes no presence on, and the robot's states tell
        absent: list[str] = []

        def there() -> bool:
            absent[:] = self.witness.listen().missing(set(others))
            return not absent

        self.wait(there, f"{', '.join(others)} to be there", missing=lambda: f"no {' and no '.join(absent)} yet")

    # Messages to the system.

    def refer(self, reference: Reference) -> None:
        """Publish a reference as a new planner that takes over."""
        reference = replace(reference, epoch=max(new_epoch(), self.reference.epoch + 1), seq=1)
        self._references.put(reference)
        self.witness.reference = reference

    @property
    def reference(self) -> Reference:
        """The reference that is followed."""
        assert self.witness.reference is not None
        return self.witness.reference

    def ask(self, key: Key[Any], **request: Any) -> dict[str, Any]:
        """
        Send a request, and return the answer that grants it.

        Raises:
            Failed: The request is refused, or nobody answers.
        """
        try:
            answer = self.bus.request(key, request, timeout_s=REQUEST_TIMEOUT_S)
        except TimeoutError:
            answer = {"error": f"no answer within {REQUEST_TIMEOUT_S:g} s"}
        if answer.get("ok") is not True:
            raise Failed(f"{key} was asked for {request}: {answer.get('error')}")
        return answer


def because(missing: str) -> str:
    """Return a reason to follow a text; empty if there is none."""
    return f": {missing}" if missing else ""


def steady(samples: Sequence[Telemetry], most: Array) -> bool:
    """Return whether disturbances with largest magnitudes `most`, shape ``(nd,)``, were estimated for a while, and always alike; true of none."""
    if not most.size:
        return True
    if not samples:
        return False
    last = samples[-1]
    begin_ns = last.state_stamp_ns - STEADY_NS
    before = next((i for i in reversed(range(len(samples))) if samples[i].state_stamp_ns <= begin_ns or samples[i].epoch != last.epoch), None)
    if before is None or samples[before].epoch != last.epoch:
        return False
    return bool((np.ptp([sample.d for sample in samples[before:]], axis=0) <= STEADY_SHARE * most).all())
