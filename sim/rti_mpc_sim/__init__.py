# SPDX-License-Identifier: Apache-2.0
"""Simulated robot as a peer on the bus: plant, sensors and actuators."""
