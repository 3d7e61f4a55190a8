# SPDX-License-Identifier: Apache-2.0
"""Dry run of one configuration."""
