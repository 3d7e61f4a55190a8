# SPDX-License-Identifier: Apache-2.0
"""References: trajectories, polylines and headings."""
