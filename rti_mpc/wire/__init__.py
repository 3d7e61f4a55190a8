# SPDX-License-Identifier: Apache-2.0
"""Wire: CDR bytes, keys, one source per key, and the bus. `session` and `zenoh_session` alone import zenoh."""
