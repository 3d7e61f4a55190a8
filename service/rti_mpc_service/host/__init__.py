# SPDX-License-Identifier: Apache-2.0
"""The host: its machine, its real-time settings, and the witness of its hold-ups."""
