# SPDX-License-Identifier: Apache-2.0
"""The processes a user runs: controller daemon, viewer, demo, command line, configuration."""
