# SPDX-License-Identifier: Apache-2.0
"""Configuration of one robot: schema, file, checks, and what is built from it."""
