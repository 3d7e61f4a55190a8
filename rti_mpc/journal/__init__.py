# SPDX-License-Identifier: Apache-2.0
"""A controller's journal: the calls that its commands depend on, snapshots of its state, and their replay on another controller."""
