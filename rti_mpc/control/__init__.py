# SPDX-License-Identifier: Apache-2.0
"""Controller: from state and reference to command, without a clock."""
