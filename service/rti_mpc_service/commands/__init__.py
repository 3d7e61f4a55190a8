# SPDX-License-Identifier: Apache-2.0
"""Commands of the command line: each turns its options into one call. What it calls is imported when it runs."""
