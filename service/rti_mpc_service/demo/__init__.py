# SPDX-License-Identifier: Apache-2.0
"""Demo: the whole system on this machine, with summary and figure."""
