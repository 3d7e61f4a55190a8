# SPDX-License-Identifier: Apache-2.0
"""Controller process: states in, commands out, standby, operator's requests and live parameters."""
