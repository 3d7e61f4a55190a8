# SPDX-License-Identifier: Apache-2.0
"""Doctor: what this host gives to a control loop."""
