# SPDX-License-Identifier: Apache-2.0
"""Certificates and access control: who may join the bus of a robot, and what each role may do there."""
