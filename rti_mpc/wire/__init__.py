# SPDX-License-Identifier: Apache-2.0
"""The wire: CDR bytes, keys, one source a key, and the bus. Leaf of the library; `bus` alone imports zenoh."""
