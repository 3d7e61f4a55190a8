# SPDX-License-Identifier: Apache-2.0
"""Status: a live table of all robots on the bus."""
