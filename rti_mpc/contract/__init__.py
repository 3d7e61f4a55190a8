# SPDX-License-Identifier: Apache-2.0
"""The contract between processes as pure decisions: messages, epochs, clocks, schedule, guard and leadership. Never loads CasADi."""
