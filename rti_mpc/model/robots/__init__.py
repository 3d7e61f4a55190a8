# SPDX-License-Identifier: Apache-2.0
"""
Robots that ship, one file each, their configurations in ``deploy/robots``.

Each has a function of its own name, the `SOURCE` of its parameters, and `REST`, what it does at rest without feedback: it ``holds``, ``drifts`` or
``falls``, or it ``coasts`` since nothing stops it there.
"""
