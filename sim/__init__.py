# SPDX-License-Identifier: Apache-2.0
"""The robot as a peer on the bus: plant, sensors, actuators, faults, and a reference source."""
