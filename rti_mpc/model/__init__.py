# SPDX-License-Identifier: Apache-2.0
"""Robots as CasADi expressions: names, units, bounds, integrators, obstacles and disturbances."""
