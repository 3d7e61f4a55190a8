# SPDX-License-Identifier: Apache-2.0
"""Settings of a simulated robot, as plain values."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments
from rti_mpc.errors import ConfigError
from rti_mpc.model.model import Model


@dataclass(frozen=True, eq=False)
class RobotSettings:
    """
    Plant, actuators and sensors of one robot. Sizes and ranges are checked here, once.

    Attributes:
        model: Model of the plant, with the plant's own parameters.
        x0: Initial state, shape ``(nx,)``.
        slew: Largest rate of each input while braking on its own, shape ``(nu,)``, in the input's unit per s; infinite by default.
        lbu: Least of each input that the actuators do, whatever is commanded, shape ``(nu,)``; without a limit by default.
        ubu: Most of each input.
        increments: Slew limits inside which it approaches what is commanded, from what really acts; None: it plays rows as they come.
        reports_inputs: Whether its states tell which inputs act, and whose command they come from.
        state_period_s: Time between states.
        substeps: Steps of the model's integrator a state period is cut into.
        noise_std: Standard deviation of the measured states, shape ``(nx,)``; zero by default.
        sensor_delay_s: Time from measuring a state to sending it; its stamp is that of the measurement.
        dropout: Share of states that are lost on the way.
        actuator_delay_s: Time from the arrival of a command to the instant from which it can act.
        actuator_lag_s: Time constant of the inputs, first order; 0: none.
        seed: Seed of noise and dropout.
        rates: How fast each state changes in operation, shape ``(nx,)``, per s, by which is judged whether it stands; 1 in its unit by default.

    Raises:
        ConfigError: A size or a number does not fit.
        OcpError: What must be numbers, or a model, is none.
    """

    model: Model
    x0: Array
    slew: Array = field(default_factory=lambda: np.empty(0))
    lbu: Array = field(default_factory=lambda: np.empty(0))
    ubu: Array = field(default_factory=lambda: np.empty(0))
    increments: Increments | None = None
    reports_inputs: bool = True
    state_period_s: float = 0.1
    substeps: int = 20
    noise_std: Array = field(default_factory=lambda: np.empty(0))
    sensor_delay_s: float = 0.0
    dropout: float = 0.0
    actuator_delay_s: float = 0.0
    actuator_lag_s: float = 0.0
    seed: int = 1
    rates: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        """Fill in defaults that depend on the model, and check."""
        nx, nu = given.instance("model", self.model, Model).nx, self.model.nu
        lengths = (("x0", nx, 0.0), ("slew", nu, np.inf), ("lbu", nu, -np.inf), ("ubu", nu, np.inf), ("noise_std", nx, 0.0), ("rates", nx, 1.0))
        for name, length, default in lengths:
            values = np.array(given.numbers(name, getattr(self, name)))
            value = values if values.size or name == "x0" else np.full(length, default)
            if value.shape != (length,) or np.isnan(value).any():
                raise ConfigError(f"{name} must be {length} numbers, got {values.tolist()}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        for name in ("state_period_s", "substeps", "sensor_delay_s", "dropout", "actuator_delay_s", "actuator_lag_s"):
            given.number(name, getattr(self, name))
        for name, right, fits in (
            ("x0", "finite", bool(np.isfinite(self.x0).all())),
            ("slew", "above 0", bool((self.slew > 0.0).all())),
            ("lbu", "at most the input at rest, and that at most ubu", self._reach_rest()),
            ("noise_std", "finite and at least 0", bool(np.isfinite(self.noise_std).all() and (self.noise_std >= 0.0).all())),
            ("rates", "finite and above 0", bool(np.isfinite(self.rates).all() and (self.rates > 0.0).all())),
            ("state_period_s", "from 0.0001 to 10 s", 1e-4 <= self.state_period_s <= 10.0),
            ("substeps", "from 1 to 1000", 1 <= self.substeps <= 1000),
            ("sensor_delay_s", "from 0 to 10 s", 0.0 <= self.sensor_delay_s <= 10.0),
            ("dropout", "from 0 to below 1", 0.0 <= self.dropout < 1.0),
            ("actuator_delay_s", "from 0 to 10 s", 0.0 <= self.actuator_delay_s <= 10.0),
            ("actuator_lag_s", "from 0 to 10 s", 0.0 <= self.actuator_lag_s <= 10.0),
        ):
            if not fits:
                raise ConfigError(f"{name} must be {right}, got {getattr(self, name)}")

    def _reach_rest(self) -> bool:
        return bool((self.lbu <= np.array(self.model.u_rest)).all() and (self.ubu >= np.array(self.model.u_rest)).all())

    @property
    def state_period_ns(self) -> int:
        """Time between states, in ns."""
        return round(1e9 * self.state_period_s)
